"""Torch's device, its number of threads and its random seed."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.errors import InvalidConfig
from mapt.processes import worker_slot


def resolve_device(name: str) -> torch.device:
    """The device called `name`; "auto" is CUDA if it is available, else the CPU.

    Args:
        name: a device of torch, such as cuda:1, or several separated by commas, of which the worker processes of
            `mapt.processes` and of the service take turns: the nth worker has the nth one.

    Raises:
        InvalidConfig: if one of the devices does not exist.
    """
    devices = [_existing(each.strip(), name) for each in name.split(",")]
    return devices[worker_slot() % len(devices)]


def _existing(name: str, setting: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    known = existing_devices()
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or str(device) not in known | {each.partition(":")[0] for each in known}:
        raise InvalidConfig(
            f"device is {setting!r}, but here is no device {name!r}. This machine has {', '.join(sorted(known))}; auto "
            "uses CUDA if there is any.",
            "device",
        )
    return device


def existing_devices() -> set[str]:
    """Names of the devices that torch can compute on: cpu, and every accelerator by its number."""
    accelerator = torch.accelerator.current_accelerator(check_available=True)
    if accelerator is None:
        return {"cpu"}
    return {"cpu", *(f"{accelerator.type}:{number}" for number in range(torch.accelerator.device_count()))}


def to_device(array: NDArray[np.generic], device: torch.device) -> Tensor:
    """An array as a tensor on `device`: on the CPU the same memory, on CUDA a copy that does not block.

    The memory of the array may be changed once this returns.
    """
    tensor = torch.from_numpy(array)
    # CUDA reads pinned memory without a copy of its own, while this thread goes on.
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


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
