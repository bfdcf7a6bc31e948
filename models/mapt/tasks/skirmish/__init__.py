"""Skirmishes between two small armies: SMAC's maps 3m, 3s5z, 6h_vs_8z and MMM2 without StarCraft II."""
