"""Make clips with `mapt.rendering` in child processes. Does not import torch."""
