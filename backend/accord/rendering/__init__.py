"""Clips by `mapt.rendering`, made in processes of their own. Never imports torch."""
