from pathlib import Path

import pytest
import torch

from mapt.benchmarks.recorded_dataset import RecordedDataset
from unit.benchmarks.tiny_replay import write_replay


@pytest.fixture
def replay(tmp_path: Path) -> RecordedDataset:
    return write_replay(tmp_path / "replay")


@pytest.fixture(autouse=True)
def use_one_torch_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
