"""Both clips play in sync, and every frame on screen is the right frame of its file."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from browser.fixture_types import NewExperiment, SignIn
from browser.frames import assert_shows, image, reference_frames
from browser.labeller import PATIENCE_MS, Labeller
from browser.service import SMALL, Service

pytestmark = pytest.mark.slow

_FRAMES = SMALL["segment_steps"]

#: samples both canvases before every repaint for a number of loops
_SAMPLE = """async loops => {
  const pair = document.querySelector("[data-pair]");
  const [left, right] = pair.querySelectorAll("canvas");
  const goal = Number(pair.dataset.loops) + loops;
  const seen = { left: new Set(), right: new Set(), distance: 0, samples: 0 };
  while (Number(pair.dataset.loops) < goal) {
    await new Promise(requestAnimationFrame);
    seen.left.add(Number(left.dataset.frame));
    seen.right.add(Number(right.dataset.frame));
    seen.distance = Math.max(seen.distance, Math.abs(left.dataset.frame - right.dataset.frame));
    seen.samples += 1;
  }
  return { ...seen, left: [...seen.left], right: [...seen.right], maxDrift: Number(pair.dataset.maxDrift) };
}"""


@pytest.fixture(scope="module")
def watched(new_shared_experiment: NewExperiment) -> str:
    """An experiment whose pairs are watched."""
    return new_shared_experiment("Watched")


@pytest.fixture
def watching(service: Service, watched: str, sign_in: SignIn) -> Iterator[Page]:
    """A page on which a pair plays. Fails when the page reports a warning, such as a fallback to a slower decoder."""
    page = sign_in("Vera")
    warnings: list[str] = []
    page.on("console", lambda message: warnings.append(message.text) if message.type == "warning" else None)
    Labeller(page).open(service.url, watched)
    yield page
    page.goto("about:blank")  # releases the pairs for the next test
    assert warnings == []


def test_both_clips_show_the_same_frame_at_every_repaint(watching: Page) -> None:
    watching.keyboard.press("3")
    expect(watching.get_by_role("button", name=re.compile("^2"))).to_have_attribute("aria-pressed", "true")
    seen = watching.evaluate(_SAMPLE, 6)
    assert seen["distance"] == 0
    assert seen["maxDrift"] < 1
    assert seen["samples"] > 6
    assert set(seen["left"]) == set(seen["right"])
    assert max(seen["left"]) == _FRAMES - 1


def test_stepping_shows_the_frames_of_the_files(watching: Page) -> None:
    clips = {side: reference_frames(watching, side) for side in ("left", "right")}
    assert {len(frames) for frames in clips.values()} == {_FRAMES}
    watching.keyboard.press(" ")
    expect(watching.get_by_role("button", name="Play")).to_be_visible()
    for key, count in ((".", 7), (",", 12), (".", 3)):
        for _ in range(count):
            watching.keyboard.press(key)
        for side, frames in clips.items():
            index = int(watching.get_by_test_id(f"clip-{side}").get_attribute("data-frame") or -1)
            assert_shows(image(watching, side), frames, index)


def test_pause_stops_both_clips_and_the_speed_survives_a_reload(watching: Page) -> None:
    watching.keyboard.press("3")
    watching.keyboard.press(" ")
    expect(watching.get_by_role("button", name="Play")).to_be_visible()
    frames = [watching.get_by_test_id(f"clip-{side}").get_attribute("data-frame") for side in ("left", "right")]
    assert frames[0] == frames[1]
    watching.evaluate("async () => { for (let n = 0; n < 30; n++) await new Promise(requestAnimationFrame); }")
    assert watching.get_by_test_id("clip-left").get_attribute("data-frame") == frames[0]
    watching.reload()
    expect(watching.get_by_role("button", name=re.compile("^2"))).to_have_attribute("aria-pressed", "true")


def test_without_webcodecs_the_same_frames_are_shown(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    """Browsers offer WebCodecs only on https and localhost. Elsewhere the page seeks a video element."""
    page = sign_in("Vera")
    page.add_init_script("delete globalThis.VideoDecoder")
    Labeller(page).open(service.url, new_experiment("Without WebCodecs"))
    assert page.evaluate("'VideoDecoder' in globalThis") is False
    frames = reference_frames(page, "left")
    page.keyboard.press(" ")
    for _ in range(5):
        page.keyboard.press(".")
        index = int(page.get_by_test_id("clip-left").get_attribute("data-frame") or -1)
        assert_shows(image(page, "left"), frames, index)


def test_the_shorter_clip_is_marked_as_ended(service: Service, new_experiment: NewExperiment, sign_in: SignIn) -> None:
    """A walker that falls gives a shorter segment. Its clip stays on the last frame, marked, until the other ends."""
    walker = {"task": "Walker2d-2x3", "segment_steps": 30, "policy": {"n_envs": 8, "rollout_steps": 60}}
    page = sign_in("Vera")
    labeller = Labeller(page)
    labeller.open(service.url, new_experiment("Falls", **walker))
    # At most thirty steps of this task are a quarter of a second: they play slowly until the user chooses a speed.
    expect(page.get_by_role("button", name=re.compile("^¼"))).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_role("note")).to_contain_text(re.compile(r"0\.[12] s"))
    for _ in range(10):
        seen = _stepped_through(page, 30)
        counts = {side: 1 + max(shown[side]["frame"] for shown in seen) for side in ("left", "right")}
        if counts["left"] != counts["right"]:
            break
        page.keyboard.press(" ")
        labeller.press("ArrowLeft")
    shorter, longer = sorted(counts, key=lambda side: counts[side])
    assert counts[shorter] < counts[longer]
    for shown in seen:
        assert shown[shorter]["ended"] == (shown[longer]["frame"] >= counts[shorter])
        assert not shown[longer]["ended"]


def test_both_clips_are_shown_from_the_chosen_camera(watching: Page) -> None:
    pair = watching.get_by_test_id("pair")
    watching.keyboard.press(" ")
    before = [image(watching, side) for side in ("left", "right")]
    watching.keyboard.press("c")
    expect(pair).to_have_attribute("data-camera", "top", timeout=PATIENCE_MS)
    expect(pair).to_have_attribute("data-state", "playing")
    for side, followed in zip(("left", "right"), before, strict=True):
        # The floor fills the picture only from above.
        assert (np.abs(image(watching, side).astype(int) - followed).max(axis=-1) > 30).mean() > 0.2
    labeller = Labeller(watching)
    labeller.press("ArrowLeft")
    expect(pair).to_have_attribute("data-camera", "top", timeout=PATIENCE_MS)
    watching.get_by_role("button", name="Follow").click()
    expect(pair).to_have_attribute("data-camera", "follow")


def test_hovering_over_a_limb_shows_the_name_of_its_agent(watching: Page) -> None:
    watching.keyboard.press(" ")
    expect(watching.get_by_role("button", name="Play")).to_be_visible()
    shown = image(watching, "left").astype(int)
    blue = np.abs(shown - np.array([0, 100, 160])).max(axis=-1) < 18
    rows, columns = np.nonzero(blue)
    middle = len(rows) // 2
    box = watching.get_by_test_id("clip-left").bounding_box()
    assert box is not None
    x = box["x"] + (columns[middle] + 0.5) * box["width"] / shown.shape[1]
    y = box["y"] + (rows[middle] + 0.5) * box["height"] / shown.shape[0]
    watching.mouse.move(x, y)
    expect(watching.locator(".agent-name")).to_have_text("back shin")
    watching.mouse.move(box["x"] + box["width"] / 2, box["y"] + 4)
    expect(watching.locator(".agent-name")).to_have_count(0)


def test_a_missing_clip_shows_an_error_and_a_retry_button(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    page = sign_in("Vera")
    page.route("**/api/v1/clips/*.mp4", lambda route: route.fulfill(status=404, body="gone"))
    page.goto(f"{service.url}/experiments/{new_experiment('Missing clip')}/label")
    page.get_by_role("button", name="Start labelling").click()
    expect(page.get_by_role("alert")).to_contain_text("cannot be played", timeout=PATIENCE_MS)
    expect(page.get_by_role("button", name="Left is better")).to_be_disabled()
    page.unroute("**/api/v1/clips/*.mp4")
    page.get_by_role("button", name="Try again").click()
    Labeller(page).pair()


def test_a_clip_is_loaded_automatically_when_the_server_is_back(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    page = sign_in("Vera")
    page.route("**/api/v1/clips/*.mp4", lambda route: route.abort())
    page.goto(f"{service.url}/experiments/{new_experiment('Unreachable server')}/label")
    page.get_by_role("button", name="Start labelling").click()
    expect(page.get_by_role("alert")).to_contain_text("not responding", timeout=PATIENCE_MS)
    page.unroute("**/api/v1/clips/*.mp4")
    Labeller(page).pair()
    expect(page.get_by_role("alert")).to_have_count(0)


def _stepped_through(page: Page, count: int) -> list[dict[str, Any]]:
    """Step forward `count` times; return what each side shows after each step."""
    look = """() => Object.fromEntries(["left", "right"].map((side) => {
      const canvas = document.querySelector(`[data-testid=clip-${side}]`);
      return [side, { frame: Number(canvas.dataset.frame), ended: canvas.hasAttribute("data-ended") }];
    }))"""
    shown = []
    for _ in range(count):
        page.keyboard.press(".")
        shown.append(page.evaluate(look))
    return shown
