"""Execute the steps of backend/Dockerfile, and run the service as the container would. Takes minutes."""

import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import psutil
import pytest

from deployment import chroot_image
from support.plain_http import PLAIN_HTTP
from support.ports import free_port
from support.waiting import until

REPOSITORY = Path(__file__).parents[2]


def may_make_namespaces() -> bool:
    """Whether this process may start others in a mount and process namespace of their own, as containers have."""
    if os.geteuid() != 0:
        return False
    done = subprocess.run(["unshare", "--mount", "--pid", "--fork", "true"], check=False, capture_output=True)
    return done.returncode == 0


pytestmark = [
    pytest.mark.deployment,
    pytest.mark.timeout(3000),
    pytest.mark.skipif(
        not shutil.which("debootstrap") or not may_make_namespaces(),
        reason="needs debootstrap, and root that may make namespaces",
    ),
]


@pytest.fixture(scope="module")
def image() -> Iterator[chroot_image.Image]:
    """The image, which takes minutes to build. ACCORD_TEST_IMAGES names a folder that keeps the base image."""
    kept = os.environ.get("ACCORD_TEST_IMAGES")
    with tempfile.TemporaryDirectory(prefix="accord-image-") as temporary:
        folder = Path(kept or temporary)
        for stage in folder.glob("stage-*"):
            shutil.rmtree(stage)
        yield chroot_image.build(REPOSITORY / "backend" / "Dockerfile", REPOSITORY, folder)


def test_the_container_starts_answers_its_health_check_and_stops(image: chroot_image.Image, tmp_path: Path) -> None:
    port, log = free_port(), tmp_path / "log"
    here = {"ACCORD_PORT": str(port)}
    address = f"http://127.0.0.1:{port}"
    check = [word.replace(":8000", f":{port}") for word in image.health_check]
    assert subprocess.run(image.arguments(check), env=image.variables(), capture_output=True, check=False).returncode
    with chroot_image.container(image, log, here) as process:

        def healthy() -> bool:
            assert process.poll() is None, log.read_text()
            done = subprocess.run(image.arguments(check), env=image.variables(), capture_output=True, check=False)
            return done.returncode == 0

        until(healthy, "the health check succeeds")
        link = until(lambda: re.search(r"http://\S+(/sign-in/\S+)", log.read_text()), "a sign-in link")
        with httpx.Client(base_url=address, headers={"Sec-Fetch-Site": "same-origin"}, **PLAIN_HTTP) as browser:
            assert "<title>" in browser.get("/").text
            assert browser.post(f"/api/v1{link[1]}").is_success
            [experiment] = browser.get("/api/v1/experiments").json()["items"]

            def clip() -> str | None:
                path = f"/api/v1/experiments/{experiment['id']}/queries/next"
                queries = browser.post(path).json()["items"]
                return queries[0]["left"]["clip_url"] if queries else None

            video = browser.get(until(clip, f"a rendered pair; {log.read_text()}"))
        assert video.content[4:8] == b"ftyp"
        inside = [each for each in psutil.Process(process.pid).children(recursive=True) if each.uids().real != 0]
        assert inside
        supervisor = min(inside, key=lambda each: each.create_time())
        supervisor.send_signal(signal.Signals[image.stop_signal])
        assert process.wait(30) == 0, log.read_text()


def test_the_image_has_the_programs_that_backups_and_checks_need(image: chroot_image.Image) -> None:
    image.run(["pg_dump", "--version"])
    image.run(["accord", "doctor", "--home", "/tmp/doctor"], {"ACCORD_PORT": str(free_port())})
    image.run(["python", "-c", "import psycopg, obstore, opentelemetry.sdk"])
