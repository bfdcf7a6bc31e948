"""Torch's device, its number of threads, its random seed and its memory."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mapt.errors import InvalidConfig

# Parameters of the GNU C library's mallopt, from its malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
# Allocations above this are always returned when freed: datasets, not activations.
_KEPT_BYTES = 1 << 27
# The values to which the library by itself raises its thresholds in a process that frees large blocks.
_DEFAULT_MMAP_THRESHOLD, _DEFAULT_TRIM_THRESHOLD = 1 << 25, 1 << 26


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


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Keep memory that is freed within the context for later allocations, and return it to the system at the end.

    Without it, the C library returns the activations of every step to the system, and the next step gets them page by
    page: a fifth of the time of a training step (`bench_rewards.py --rows passes`). Applies to the whole process, with
    the GNU C library; with others, nothing happens.
    """
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):
        yield
        return
    library.mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
    library.mallopt(_TRIM_THRESHOLD, 2**31 - 1)
    try:
        yield
    finally:
        library.mallopt(_MMAP_THRESHOLD, _DEFAULT_MMAP_THRESHOLD)
        library.mallopt(_TRIM_THRESHOLD, _DEFAULT_TRIM_THRESHOLD)
        library.malloc_trim(0)
