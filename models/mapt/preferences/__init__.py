"""Preferences between segments: the Bradley-Terry loss, datasets, scripted teachers, query selection, file formats.

Import the submodules. Only `mapt.preferences.loss` imports torch.
"""
