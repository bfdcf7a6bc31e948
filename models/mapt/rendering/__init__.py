"""Simulator states to frames, and frames to H.264. Never imports torch."""
