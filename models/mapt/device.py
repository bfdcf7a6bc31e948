"""Torch's device, its number of threads and its random seed."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mapt.errors import InvalidConfig


def resolve_device(name: str) -> torch.device:
    """The device called `name`; "auto" is CUDA if it is available, else the CPU.

    Raises:
        InvalidConfig: if the device does not exist or is not available.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InvalidConfig(f"device is {name!r}; it must be auto, cpu or cuda.", "device") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InvalidConfig(f"device is {name!r}, but no CUDA device is available; use auto or cpu.", "device")
    return device


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Seed torch's global generators within the context, for initial weights and dropout, and restore them after it."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


@contextmanager
def torch_threads(n_threads: int) -> Iterator[None]:
    """Limit torch to `n_threads` threads within the context; 0 leaves the number unchanged."""
    before = torch.get_num_threads()
    torch.set_num_threads(n_threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
