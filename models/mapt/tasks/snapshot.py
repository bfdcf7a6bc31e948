"""Snapshots of a batch of environments: arrays by name, among them the state of the random generator."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidSnapshot

_LOW_64_BITS = (1 << 64) - 1
_RANDOM_STATE = "random_state"


def take_snapshot(arrays: Mapping[str, np.ndarray], generator: np.random.Generator) -> dict[str, np.ndarray]:
    """Copies of the arrays, with the generator's state."""
    return {name: array.copy() for name, array in arrays.items()} | {_RANDOM_STATE: generator_to_array(generator)}


def load_snapshot(
    snapshot: Mapping[str, np.ndarray], arrays: Mapping[str, np.ndarray], task_name: str
) -> np.random.Generator:
    """Write a snapshot into the arrays and return its generator.

    Raises:
        InvalidSnapshot: if its names or shapes differ from the arrays'. Nothing is written then.
    """
    expected = {**{name: array.shape for name, array in arrays.items()}, _RANDOM_STATE: (6,)}
    given = {name: np.shape(array) for name, array in snapshot.items()}
    if given != expected:
        raise InvalidSnapshot(f"The snapshot holds {given}, but this batch of {task_name} needs {expected}.")
    for name, array in arrays.items():
        array[...] = snapshot[name]
    return generator_from_array(snapshot[_RANDOM_STATE])


def generator_to_array(generator: np.random.Generator) -> NDArray[np.uint64]:
    """The state of a PCG64 generator as six words, so that it can be stored without pickle.

    State and increment (high and low word each), whether there is a spare 32-bit number, and that number.
    """
    state = generator.bit_generator.state
    numbers = state["state"]["state"], state["state"]["inc"]
    words = [word for number in numbers for word in (number >> 64, number & _LOW_64_BITS)]
    return np.array([*words, state["has_uint32"], state["uinteger"]], dtype=np.uint64)


def generator_from_array(words: NDArray[np.uint64]) -> np.random.Generator:
    """The inverse of `generator_to_array`."""
    state_high, state_low, inc_high, inc_low, has_uint32, uinteger = (int(word) for word in words)
    bits = np.random.PCG64()
    bits.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high << 64 | state_low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
    return np.random.Generator(bits)
