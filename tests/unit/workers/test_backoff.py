import random

from hypothesis import given
from hypothesis import strategies as st

from accord.domain.errors import BlobMissing
from accord.workers.backoff import Backoff
from accord.workers.sentence import sentence


@given(st.integers(1, 10_000), st.integers())
def test_pauses_double_with_jitter_up_to_the_longest(failures, seed):
    pause = Backoff(first_seconds=1.0, longest_seconds=30.0).seconds(failures, random.Random(seed))
    step = min(30.0, 2.0 ** min(failures - 1, 30))
    assert step / 2 <= pause <= step


def test_our_own_errors_speak_for_themselves_and_others_name_their_kind():
    assert sentence(BlobMissing("a/b")).startswith("The blob 'a/b'")
    assert sentence(ValueError("bad\nsecond line")) == "ValueError: bad."
    assert sentence(KeyError()) == "KeyError."
    assert len(sentence(ValueError("x" * 5000))) == 400
