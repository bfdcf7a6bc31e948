"""A real Firefox, driven over WebDriver BiDi (https://w3c.github.io/webdriver-bidi/).

Playwright drives only Firefox versions that know its newest commands, which those of Linux distributions do not.
"""

import json
import os
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
from websockets.sync.client import ClientConnection, connect

from support.waiting import PATIENCE_SECONDS

#: code points that stand for keys, https://w3c.github.io/webdriver/#keyboard-actions
KEYS = {"ArrowLeft": "\ue012", "ArrowUp": "\ue013", "ArrowRight": "\ue014", "ArrowDown": "\ue015", "Enter": "\ue007"}


class Firefox:
    """One tab.

    Args:
        connection: to a browser with an open session.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self._connection, self._id = connection, 0
        self._tab = ""
        self._send("session.new", capabilities={"alwaysMatch": {}})
        self._tab = self._send("browsingContext.getTree")["contexts"][0]["context"]

    def goto(self, url: str) -> None:
        """Open an address, and wait until the page is loaded."""
        self._send("browsingContext.navigate", context=self._tab, url=url, wait="complete")

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression, or of its promise; it must be JSON."""
        wrapped = f"(async () => JSON.stringify(await ({expression})))()"
        answer = self._send("script.evaluate", expression=wrapped, target={"context": self._tab}, awaitPromise=True)
        assert answer["type"] == "success", answer
        return json.loads(answer["result"].get("value", "null"))

    def until(self, expression: str) -> Any:
        """Wait until an expression is true; return its value."""
        deadline = time.monotonic() + PATIENCE_SECONDS
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < deadline, f"{expression} is not true:\n{self.evaluate('document.body.innerText')}"
            time.sleep(0.05)
        return value

    def click(self, text: str) -> None:
        """Click the button whose text begins so, once it is there."""
        button = (
            f"[...document.querySelectorAll('button')].find((each) => each.innerText.startsWith({json.dumps(text)}))"
        )
        self.until(f"{button} !== undefined")
        self.evaluate(f"{button}.click()")

    def press(self, key: str) -> None:
        """Press a key and release it."""
        strokes = [{"type": kind, "value": KEYS.get(key, key)} for kind in ("keyDown", "keyUp")]
        actions = [{"type": "key", "id": "keyboard", "actions": strokes}]
        self._send("input.performActions", context=self._tab, actions=actions)

    def _send(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._id += 1
        self._connection.send(json.dumps({"id": self._id, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(PATIENCE_SECONDS))
            if answer.get("id") == self._id:
                assert answer["type"] == "success", answer
                return answer["result"]


@contextmanager
def open_firefox(executable: str, folder: Path, *, decodes_h264: bool) -> Iterator[Firefox]:
    """Start Firefox without a window and with a new profile; stop it at the end of the block.

    Args:
        folder: a new folder for its files.
        decodes_h264: whether it finds ffmpeg's libraries, here those of PyAV. Without them it decodes no H.264, unless
            the system has ffmpeg.
    """
    folder.mkdir()
    log = folder / "log"
    command = [executable, "--headless", "--profile", str(folder), "--remote-debugging-port=0", "about:blank"]
    environment = os.environ | (_libraries(folder) if decodes_h264 else {})
    with (
        log.open("wb") as output,
        subprocess.Popen(command, env=environment, stdout=output, stderr=output) as process,
    ):
        try:
            address = _wait_for(lambda: re.search(r"WebDriver BiDi listening on (ws://\S+)", log.read_text()), log)
            with connect(f"{address[1]}/session", max_size=None) as connection:
                yield Firefox(connection)
        finally:
            process.terminate()
            process.wait(PATIENCE_SECONDS)


def _libraries(folder: Path) -> dict[str, str]:
    """The environment in which Firefox finds PyAV's libraries by the names of ffmpeg's own."""
    bundled = Path(av.__file__).parents[1] / "av.libs"
    links = folder / "libraries"
    links.mkdir()
    for name in ("libavcodec", "libavutil"):
        library = next(bundled.glob(f"{name}-*.so.*"))
        major = library.name.split(".so.")[1].split(".")[0]
        (links / f"{name}.so.{major}").symlink_to(library)
    return {"LD_LIBRARY_PATH": f"{links}:{bundled}"}


def _wait_for(find: Callable[[], re.Match[str] | None], log: Path) -> re.Match[str]:
    deadline = time.monotonic() + PATIENCE_SECONDS
    while (found := find()) is None:
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.05)
    return found
