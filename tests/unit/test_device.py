"""Devices by name, lists of them that worker processes share, and copies to a device."""

import numpy as np
import pytest
import torch

from mapt import device
from mapt.device import existing_devices, resolve_device, to_device
from mapt.errors import InvalidConfig
from mapt.policies import PolicyConfig
from mapt.processes import WORKER_SLOT_VARIABLE


@pytest.fixture
def two_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names only: nothing is computed on them."""
    monkeypatch.setattr(device, "existing_devices", lambda: {"cpu", "cuda:0", "cuda:1"})


@pytest.mark.parametrize("name", ["abacus", "meta", "cuda:17", "cpu,cuda:17", "cpu:3", ""])
def test_a_device_that_is_not_there_is_refused(name: str) -> None:
    with pytest.raises(InvalidConfig) as raised:
        resolve_device(name)
    assert raised.value.field == "device"
    assert all(existing in str(raised.value) for existing in existing_devices())


def test_workers_take_turns_on_a_list_of_devices(two_gpus: None, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for slot in range(4):
        monkeypatch.setenv(WORKER_SLOT_VARIABLE, str(slot))
        found.append(str(resolve_device("cuda:0, cuda:1")))
    assert found == ["cuda:0", "cuda:1", "cuda:0", "cuda:1"]
    monkeypatch.delenv(WORKER_SLOT_VARIABLE)
    assert resolve_device("cuda:1,cuda:0") == torch.device("cuda:1")
    with pytest.raises(InvalidConfig):
        resolve_device("cuda:0,cuda:2")


@pytest.mark.parametrize("name", ["auto", "cpu", "cuda", "cuda:1", "cuda:0,cuda:1", "mps", "xpu:0"])
def test_settings_accept_devices_and_lists_of_them(name: str) -> None:
    assert PolicyConfig(device=name).device == name


@pytest.mark.parametrize("name", ["", "tpu", "cuda:", "cuda:0,", "cuda:0;cuda:1", "cpu:0"])
def test_settings_refuse_other_texts(name: str) -> None:
    with pytest.raises(InvalidConfig) as raised:
        PolicyConfig(device=name)
    assert raised.value.field == "device"


def test_an_array_is_not_copied_to_the_cpu_and_is_to_another_device() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    assert to_device(array, torch.device("cpu")).data_ptr() == array.ctypes.data
    elsewhere = to_device(array, torch.device("meta"))
    assert (elsewhere.device.type, elsewhere.shape, elsewhere.dtype) == ("meta", (2, 3), torch.float32)
