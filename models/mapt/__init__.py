"""MAPT: preference-based reward learning for cooperative multi-agent reinforcement learning.

Import the subpackages: `tasks`, `preferences`, `rewards`, `policies`, `training`, `benchmarks` and `rendering`. Every
exception derives from `mapt.errors.MaptError`.
"""
