import os
import signal
import threading
import time

import pytest

from accord.workers.stop import Stop


@pytest.fixture
def stop():
    kept = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    stop = Stop()
    stop.install()
    yield stop
    signal.signal(signal.SIGTERM, kept[0])
    signal.signal(signal.SIGINT, kept[1])
    stop.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_asks_to_stop(stop, number):
    assert not stop.requested
    os.kill(os.getpid(), number)
    assert stop.wait(0)
    assert stop.requested
    assert not stop.insisted


def test_the_second_signal_insists(stop):
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGINT)
    assert stop.insisted


def test_a_signal_ends_a_wait_that_has_begun(stop):
    def send() -> None:
        while not waiting.is_set():
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGTERM)

    waiting = threading.Event()
    thread = threading.Thread(target=send)
    thread.start()
    waiting.set()
    assert stop.wait(60)
    thread.join()


def test_nothing_asked_nothing_stopped(stop):
    assert not stop.wait(0.001)
