"""The labelling page in Firefox: the clips play in step, and keys label them."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from pathlib import Path

import pytest

from browser.firefox import Firefox, open_firefox
from browser.fixture_types import NewExperiment
from browser.service import Service
from support.waiting import until

#: the pair whose clips play, once it may be labelled
_PLAYED = """(() => {
  const pair = document.querySelector("[data-pair]"), canvas = document.querySelector("canvas");
  const played = pair?.dataset.state === "playing" && (canvas.dataset.frame >= 8 || pair.dataset.loops > 0);
  return played && pair.dataset.query;
})()"""
#: frames of both clips at twenty repaints
_FRAMES = """new Promise((done) => {
  const seen = [];
  requestAnimationFrame(function look() {
    seen.push([...document.querySelectorAll("[data-pair] canvas")].map((each) => each.dataset.frame));
    if (seen.length < 20) requestAnimationFrame(look);
    else done(seen);
  });
})"""


@pytest.fixture
def executable() -> str:
    found = shutil.which("firefox") or shutil.which("firefox-esr")
    if found is None:
        pytest.skip("no Firefox on this machine: apt-get install firefox-esr")
    return found


@contextmanager
def labelling(
    service: Service, experiment: str, executable: str, folder: Path, *, decodes_h264: bool
) -> Iterator[Firefox]:
    """Firefox in which a new labeller has signed in and read the rules."""
    _, link = service.add_user(f"Fiona of {experiment}", "labeller")
    with open_firefox(executable, folder, decodes_h264=decodes_h264) as firefox:
        firefox.goto(link)
        firefox.click("Sign in as")
        firefox.until("document.querySelector('h1')?.innerText === 'Experiments'")
        firefox.goto(f"{service.url}/experiments/{experiment}/label")
        firefox.click("Start labelling")
        yield firefox


def test_keys_label_pairs_whose_clips_play_in_step(
    service: Service, new_experiment: NewExperiment, executable: str, tmp_path: Path
) -> None:
    experiment = new_experiment("Firefox")
    with labelling(service, experiment, executable, tmp_path / "firefox", decodes_h264=True) as firefox:
        label_three_and_undo_one(service, experiment, firefox)


@pytest.mark.skipif(
    find_library("avcodec") is not None, reason="every program of this machine finds ffmpeg's libraries"
)
def test_a_browser_without_h264_says_what_to_install(
    service: Service, new_experiment: NewExperiment, executable: str, tmp_path: Path
) -> None:
    experiment = new_experiment("Firefox without H.264")
    with labelling(service, experiment, executable, tmp_path / "firefox", decodes_h264=False) as firefox:
        told = firefox.until("document.querySelector('[role=alert]')?.innerText")
    assert "cannot decode H.264 video. On Linux, install ffmpeg" in told


def label_three_and_undo_one(service: Service, experiment: str, firefox: Firefox) -> None:
    labelled: dict[str, float] = {}
    for key, label in (("ArrowLeft", 1.0), ("ArrowUp", 0.5), ("ArrowLeft", 1.0)):
        query = firefox.until(_PLAYED)
        frames = firefox.evaluate(_FRAMES)
        assert all(left == right for left, right in frames)
        assert len({left for left, _ in frames}) > 1, "the clips do not move"
        firefox.press(key)
        firefox.until(f"document.querySelector('[data-pair]')?.dataset.query !== {json.dumps(query)}")
        labelled[query] = label
    firefox.press("z")
    assert firefox.until(_PLAYED) == query
    firefox.until("document.querySelector('[data-testid=own-labels]')?.innerText === '2'")
    del labelled[query]

    def stored() -> dict[str, float]:
        rows = service.rows(
            "select query_id, value, left_segment from labels where experiment_id = ? and state = 'label'", experiment
        )
        return {id: value if left == 0 else 1.0 - value for id, value, left in rows}

    until(lambda: stored() == labelled, "two labels are stored")
