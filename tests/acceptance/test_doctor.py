"""`accord doctor` as a process."""

import socket

from acceptance.accord_service import Accord


def test_doctor_renders_and_encodes_and_exits_with_status_1_if_a_check_fails(accord: Accord) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        done = accord.run("doctor", "--port", str(port))
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert "ok     OpenGL without a display: egl rendered a frame" in lines
    assert any(line.startswith("ok     H.264 encoder") for line in lines)
    failed = lines.index(f"failed port: 127.0.0.1:{port} in use")
    assert "fix:" in lines[failed + 1]
    assert f"--port {port + 1}" in lines[failed + 1]
