"""The labelling page in a real Chromium: from a key press to the next pair, drift, and what opening the page loads.

A whole service makes its clips first, and then only waits for labels: the first reward model needs more than are given.

- *key press to next pair*: from the time stamp of the key event to the first animation frame after both canvases show
  the first frame of the next pair. It includes the time for which the answer stays highlighted. Keys are pressed
  `--pause` seconds after a pair began to play.
- *drift*: the largest distance between the frames of both clips, in frames, over all repaints of a minute.
- *opening the page*: requests and bytes until the first pair plays, without a cache, as the server sends them (gzip
  where a browser does not accept Brotli), and the time that takes on an emulated link.

    python tests/benchmarks/bench_page.py [--labels 200] [--pause 1] [--drift-seconds 60] [--link-megabits 9]
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from accord.cli.own_service import OwnService
from accord.client import Client
from accord.domain.enums import Role
from support.chromium import chromium

LONGEST_WAIT_SECONDS = 1_200.0
#: round trip of the emulated link
LATENCY_MS = 20
OPENINGS = 5
KEYS = ("ArrowLeft", "ArrowRight", "ArrowUp")

#: Records every answer: the time of the key event, and of the first animation frame after the next pair is on both
#: canvases. `highlight` is when the answer was highlighted, `shown` when the next pair replaced it.
_RECORD = """() => {
  const answers = [];
  globalThis.recorded = answers;
  let pending = null;
  addEventListener("keydown", (event) => {
    if (event.key.startsWith("Arrow")) pending = { key: event.timeStamp, from: pairOf()?.dataset.query };
  }, true);
  const pairOf = () => document.querySelector("[data-pair]");
  const watch = (now) => {
    const pair = pairOf();
    const playing = pair?.dataset.state === "playing";
    if (pending?.drawn) {
      answers.push({ ...pending, painted: now });
      pending = null;
    } else if (pending && playing && pair.dataset.query !== pending.from && drawn(pair)) pending.drawn = now;
    requestAnimationFrame(watch);
  };
  const drawn = (pair) => [...pair.querySelectorAll("canvas")].every((canvas) => Number(canvas.dataset.frame) >= 0);
  requestAnimationFrame(watch);
}"""

#: The largest distance between the frames on the two canvases over all repaints of some seconds, and their number.
_DRIFT = """async (seconds) => {
  const [left, right] = document.querySelectorAll("[data-pair] canvas");
  const end = performance.now() + 1000 * seconds;
  let largest = 0, repaints = 0;
  while (performance.now() < end) {
    await new Promise(requestAnimationFrame);
    largest = Math.max(largest, Math.abs(left.dataset.frame - right.dataset.frame));
    repaints += 1;
  }
  const { loops, maxDrift } = document.querySelector("[data-pair]").dataset;
  return { largest, repaints, loops: Number(loops), maxDrift: Number(maxDrift) };
}"""


@dataclass(frozen=True, slots=True)
class Loaded:
    """What one opening of the page loaded until the first pair played."""

    seconds: float
    requests: int
    #: as sent, without headers
    page_bytes: int
    clip_bytes: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labels", type=int, default=200)
    parser.add_argument("--pause", type=float, default=1.0)
    parser.add_argument("--drift-seconds", type=float, default=60.0)
    parser.add_argument("--link-megabits", type=float, default=9.0)
    parser.add_argument("--task", default="HalfCheetah-6x1")
    arguments = parser.parse_args()
    program = chromium()
    if program is None:
        raise SystemExit("No Chromium on this machine: apt-get install chromium")
    with TemporaryDirectory() as folder, sync_playwright() as playwright:
        service = OwnService(Path(folder), {})
        try:
            api = Client(service.url(), service.token("admin", Role.ADMIN))
            experiment = start(api, arguments.task, arguments.labels)
            browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
            print(f"{arguments.task}, {browser.version}, nice {os.nice(0)}, load {os.getloadavg()[0]:.1f}", flush=True)
            address = f"{service.url()}/experiments/{experiment}/label"
            measure_opening(browser, api, address, arguments.link_megabits)
            page = sign_in(browser, api, "labeller", address).new_page()
            measure_answers(page, address, arguments.labels, arguments.pause)
            measure_drift(page, arguments.drift_seconds)
            print(f"load at the end {os.getloadavg()[0]:.1f}")
            api.close()
        finally:
            service.close()


def start(api: Client, task: str, labels: int) -> str:
    """An experiment whose pairs are all ready."""
    settings = {
        "name": "page",
        "task": task,
        "initial_labels": labels + 20,
        "label_budget": 2 * labels + 40,
        "labels_per_version": labels,
    }
    experiment = api.create_experiment(**settings).id
    deadline = time.monotonic() + LONGEST_WAIT_SECONDS
    while time.monotonic() < deadline:
        counts = api.experiment(experiment).labels
        if counts.open_queries > labels and counts.rendering_queries == 0:
            return experiment
        time.sleep(1.0)
    raise TimeoutError(f"the clips were not ready within {LONGEST_WAIT_SECONDS:.0f} s: {counts}")


def sign_in(browser: Browser, api: Client, name: str, address: str, **options: Any) -> BrowserContext:
    """The browser of a new labeller who has read the rules of the experiment at this address."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, **options)
    user = api.post("/users", {"name": name, "role": "labeller"})
    context.request.post(user["sign_in_url"].replace("/sign-in/", "/api/v1/sign-in/"))
    experiment = address.split("/")[-2]
    context.add_init_script(f"localStorage.setItem('accord.rules.{user['id']}.{experiment}', '1')")
    return context


def measure_opening(browser: Browser, api: Client, address: str, megabits: float) -> None:
    for coding in ("br", "gzip"):
        found = [open_page(browser, api, f"{coding} {n}", address, coding, megabits) for n in range(OPENINGS)]
        seconds = statistics.median(each.seconds for each in found)
        first = found[0]
        print(
            f"opening the page, {coding}: {first.page_bytes / 1024:.0f} KB in {first.requests} requests before clips,"
            f" clips {first.clip_bytes / 1024:.0f} KB; first pair plays after {seconds:.2f} s"
            f" ({min(each.seconds for each in found):.2f} to {max(each.seconds for each in found):.2f})"
            f" on {megabits:g} Mbit/s with {LATENCY_MS} ms",
            flush=True,
        )


def open_page(browser: Browser, api: Client, name: str, address: str, coding: str, megabits: float) -> Loaded:
    context = sign_in(browser, api, name, address, extra_http_headers={"Accept-Encoding": coding})
    page = context.new_page()
    network = context.new_cdp_session(page)
    network.send("Network.enable")
    bytes_per_second = megabits * 1e6 / 8
    conditions = {"offline": False, "latency": LATENCY_MS, "downloadThroughput": bytes_per_second}
    network.send("Network.emulateNetworkConditions", conditions | {"uploadThroughput": bytes_per_second})
    urls: dict[str, str] = {}
    sizes: dict[str, float] = {}
    network.on("Network.requestWillBeSent", lambda event: urls.update({event["requestId"]: event["request"]["url"]}))
    network.on("Network.loadingFinished", lambda e: sizes.update({e["requestId"]: e["encodedDataLength"]}))
    started = time.perf_counter()
    page.goto(address)
    page.locator("[data-pair][data-state=playing]").wait_for()
    seconds = time.perf_counter() - started
    finished = {urls[id]: size for id, size in sizes.items()}
    clips = [size for url, size in finished.items() if url.endswith(".mp4")]
    context.close()
    # The third pair's clips may still be arriving.
    return Loaded(seconds, len(finished) - len(clips), round(sum(finished.values()) - sum(clips)), round(sum(clips)))


def measure_answers(page: Page, address: str, labels: int, pause: float) -> None:
    page.goto(address)
    page.locator("[data-pair][data-state=playing]").wait_for()
    page.evaluate(_RECORD)
    for count in range(labels):
        page.wait_for_timeout(1000 * pause)
        page.keyboard.press(KEYS[count % len(KEYS)])
        page.wait_for_function("count => globalThis.recorded.length > count", arg=count, timeout=60_000, polling=20)
    recorded = page.evaluate("globalThis.recorded")
    waits = sorted(each["painted"] - each["key"] for each in recorded)
    print(
        f"key press to next pair, {len(waits)} labels, one every {pause:g} s: p50 {percentile(waits, 0.5):.0f} ms,"
        f" p95 {percentile(waits, 0.95):.0f} ms, longest {waits[-1]:.0f} ms",
        flush=True,
    )


def percentile(ordered: Sequence[float], share: float) -> float:
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def measure_drift(page: Page, seconds: float) -> None:
    found = page.evaluate(_DRIFT, seconds)
    print(
        f"drift over {seconds:.0f} s: {max(found['largest'], found['maxDrift'])} frames,"
        f" {found['repaints']} repaints, {found['loops']} loops"
    )


if __name__ == "__main__":
    main()
