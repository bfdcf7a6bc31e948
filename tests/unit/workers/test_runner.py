import os
import random
import signal
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from accord.domain.errors import BlobMissing
from accord.workers.runner import Backoff, Stop, error_sentence


@pytest.fixture
def stop():
    previous = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    stop = Stop()
    stop.install()
    yield stop
    signal.signal(signal.SIGTERM, previous[0])
    signal.signal(signal.SIGINT, previous[1])
    stop.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_requests_a_stop(stop, number):
    assert not stop.requested
    os.kill(os.getpid(), number)
    assert stop.wait(0)
    assert stop.requested
    assert not stop.immediate


def test_a_second_signal_requests_an_immediate_stop(stop):
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGINT)
    assert stop.immediate


def test_a_signal_ends_a_wait(stop):
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


def test_a_wait_times_out_without_a_signal(stop):
    assert not stop.wait(0.001)


@given(st.integers(1, 10_000), st.integers())
def test_pauses_double_with_jitter_up_to_the_longest(failures, seed):
    pause = Backoff(first_seconds=1.0, longest_seconds=30.0).seconds(failures, random.Random(seed))
    step = min(30.0, 2.0 ** min(failures - 1, 30))
    assert step / 2 <= pause <= step


def test_error_sentences_name_the_class_of_foreign_errors_only():
    assert error_sentence(BlobMissing("a/b")).startswith("The blob 'a/b'")
    assert error_sentence(ValueError("bad\nsecond line")) == "ValueError: bad."
    assert error_sentence(KeyError()) == "KeyError."
    assert len(error_sentence(ValueError("x" * 5000))) == 400
