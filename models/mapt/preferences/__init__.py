"""Preferences between segments: the Bradley-Terry loss, datasets, scripted teachers, query selection.

Import the submodules: only `mapt.preferences.loss` needs torch.
"""
