from pathlib import Path

import pytest
import torch

from mapt.benchmarks.recorded_dataset import RecordedDataset
from unit.benchmarks.tiny_dataset import write_dataset


@pytest.fixture
def recorded(tmp_path: Path) -> RecordedDataset:
    return write_dataset(tmp_path / "recorded")


@pytest.fixture(autouse=True)
def use_one_torch_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
