"""A worker that does nothing until it is told to stop, for tests of its supervisor."""

from accord.workers.runner import Stop


def main() -> int:
    stop = Stop()
    stop.install()
    while not stop.wait(60.0):
        pass
    return 0
