"""The compiled model equals gymnasium's bit for bit, without its deprecated attribute."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mapt.tasks import load_model
from mapt.tasks.mujoco_definition import asset_path


def test_scaling_the_mass_after_compilation_gives_equal_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # MuJoCo writes its warning about the attribute into the working directory.
    monkeypatch.chdir(tmp_path)
    published = mujoco.MjModel.from_xml_path(str(asset_path("half_cheetah.xml")))
    ours = load_model("HalfCheetah-6x1")
    names = [name for name in dir(published) if isinstance(getattr(published, name), np.ndarray)]
    assert "body_mass" in names
    for name in names:
        np.testing.assert_array_equal(getattr(ours, name), getattr(published, name), err_msg=name)
