"""Atomic writes: the old file or the new one, nothing else in the folder."""

import os
from pathlib import Path

import pytest

from mapt.io import atomic_path, atomic_write, delete_partial


def test_write_replaces_the_file_and_leaves_no_other(tmp_path: Path) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["file"]


def test_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")

    def no_space(_descriptor: int) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space left"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_block_that_raises_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_path(tmp_path / "file") as temporary:
            temporary.write_bytes(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert os.listdir(tmp_path) == []


def test_partial_files_of_a_killed_process_are_deleted(tmp_path: Path) -> None:
    path = tmp_path / "clip[1].mp4"
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"half")
        delete_partial(path, os.getpid() + 1)
        assert temporary.exists()
        delete_partial(path, os.getpid())
        assert not temporary.exists()
        temporary.write_bytes(b"whole")
    assert path.read_bytes() == b"whole"
