"""A numpy random generator as an array, so that a snapshot needs no pickle."""

import numpy as np
from numpy.typing import NDArray

_LOW_64_BITS = (1 << 64) - 1


def generator_to_array(generator: np.random.Generator) -> NDArray[np.uint64]:
    """State of a PCG64 generator as six words: state and increment (high, low each), then the spare 32 bits."""
    state = generator.bit_generator.state
    numbers = state["state"]["state"], state["state"]["inc"]
    words = [word for number in numbers for word in (number >> 64, number & _LOW_64_BITS)]
    return np.array([*words, state["has_uint32"], state["uinteger"]], dtype=np.uint64)


def generator_from_array(words: NDArray[np.uint64]) -> np.random.Generator:
    """The generator that `generator_to_array` described."""
    state_high, state_low, inc_high, inc_low, has_uint32, uinteger = (int(word) for word in words)
    bits = np.random.PCG64()
    bits.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high << 64 | state_low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
    return np.random.Generator(bits)
