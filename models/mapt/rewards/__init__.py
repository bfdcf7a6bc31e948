"""Reward models learned from preferences: MAPT, its training, its checkpoints, and rewards of whole rollouts."""
