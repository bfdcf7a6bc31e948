"""Encoded clips: frames, times, key frames, colours and failures."""

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from mapt.errors import ClipNotWritten
from mapt.rendering.encode import write_clip
from mapt.rendering.settings import CodecSettings, RenderSettings

SETTINGS = RenderSettings(width=96, height=64, codec=CodecSettings(keyframe_interval_frames=4))


def grey_ramp(count: int, settings: RenderSettings = SETTINGS) -> list[NDArray[np.uint8]]:
    """Frames with distinct shades."""
    shades = np.linspace(20, 230, count).astype(np.uint8)
    return [np.full((settings.height, settings.width, 3), shade, np.uint8) for shade in shades]


def decoded(path: Path) -> list[av.VideoFrame]:
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


def test_clip_decodes_to_the_encoded_frames(tmp_path: Path) -> None:
    clip = write_clip(grey_ramp(50), tmp_path / "clip.mp4", SETTINGS)
    assert (clip.frames, clip.seconds, clip.width, clip.height) == (50, 2.5, 96, 64)
    assert clip.size_bytes == (tmp_path / "clip.mp4").stat().st_size
    shades = [frame.to_ndarray(format="rgb24").mean() for frame in decoded(clip.path)]
    np.testing.assert_allclose(shades, [frame.mean() for frame in grey_ramp(50)], atol=3)


@pytest.mark.parametrize("rate", [20.0, 12.5, 1 / 0.03])
def test_every_frame_starts_at_its_exact_time(tmp_path: Path, rate: float) -> None:
    settings = RenderSettings(width=96, height=64, frame_rate_hz=rate)
    clip = write_clip(grey_ramp(30), tmp_path / "clip.mp4", settings)
    np.testing.assert_allclose([frame.time for frame in decoded(clip.path)], np.arange(30) / rate, atol=1e-4)
    with av.open(str(clip.path)) as container:
        assert container.duration / av.time_base == pytest.approx(clip.seconds, abs=1e-3)


def test_seek_decodes_few_frames(tmp_path: Path) -> None:
    clip = write_clip(grey_ramp(20), tmp_path / "clip.mp4", SETTINGS)
    keys = [number for number, frame in enumerate(decoded(clip.path)) if frame.key_frame]
    assert keys == [0, 4, 8, 12, 16]


def test_index_precedes_the_frames(tmp_path: Path) -> None:
    data = write_clip(grey_ramp(5), tmp_path / "clip.mp4", SETTINGS).path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_clip_is_h264_with_a_pixel_format_that_browsers_play(tmp_path: Path) -> None:
    clip = write_clip(grey_ramp(5), tmp_path / "clip.mp4", SETTINGS)
    with av.open(str(clip.path)) as container:
        codec = container.streams.video[0].codec_context
        assert (codec.name, codec.pix_fmt) == ("h264", "yuv420p")


@pytest.mark.parametrize("colour", [(230, 159, 0), (0, 114, 178), (213, 94, 0)])
def test_colours_are_preserved_and_tagged(tmp_path: Path, colour: tuple[int, int, int]) -> None:
    frames = [np.full((64, 96, 3), colour, np.uint8)] * 5
    frame = decoded(write_clip(frames, tmp_path / "clip.mp4", SETTINGS).path)[0]
    assert frame.colorspace == 1  # BT.709 in ISO 23091-2
    np.testing.assert_allclose(frame.to_ndarray(format="rgb24").mean(axis=(0, 1)), colour, atol=4)


def test_error_between_frames_leaves_no_file(tmp_path: Path) -> None:
    def broken() -> Iterator[NDArray[np.uint8]]:
        yield from grey_ramp(8)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_clip(broken(), tmp_path / "clip.mp4", SETTINGS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("frames", [[], [np.zeros((64, 64, 3), np.uint8)]])
def test_no_frames_or_wrong_size_is_rejected(tmp_path: Path, frames: list[NDArray[np.uint8]]) -> None:
    with pytest.raises(ClipNotWritten):
        write_clip(frames, tmp_path / "clip.mp4", SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_failure_keeps_an_existing_clip(tmp_path: Path) -> None:
    path = write_clip(grey_ramp(5), tmp_path / "clip.mp4", SETTINGS).path
    before = path.read_bytes()
    with pytest.raises(ClipNotWritten):
        write_clip([], path, SETTINGS)
    assert path.read_bytes() == before


def test_error_of_a_missing_folder_names_the_clip(tmp_path: Path) -> None:
    with pytest.raises(ClipNotWritten) as error:
        write_clip(grey_ramp(5), tmp_path / "nowhere" / "clip.mp4", SETTINGS)
    assert "clip.mp4" in str(error.value)
