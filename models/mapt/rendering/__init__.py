"""Render simulator states to frames and encode frames to H.264. Does not import torch."""
