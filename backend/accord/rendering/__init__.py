"""Simulator states to frames to H.264 clips, in processes of their own. Never imports torch."""
