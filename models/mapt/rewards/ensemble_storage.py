"""An ensemble as one safetensors file: the stacked weights, and a card in its header."""

import hashlib
import json
import struct
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from mapt.errors import DamagedCheckpoint, InvalidConfig, ModelMismatch
from mapt.rewards.checkpoints import POLARITY, checked_card, config_in, metrics_in, read_stored
from mapt.rewards.members import RewardEnsemble
from mapt.rewards.registry import build_reward_model
from mapt.rewards.stacked import StackedModels

FORMAT = "mapt.reward_ensemble"
FORMAT_VERSION = 1
# safetensors: the length of the JSON header, then the header.
_LENGTH = struct.Struct("<Q")


def save_reward_ensemble(ensemble: RewardEnsemble) -> bytes:
    """Serialise an ensemble; reading it back gives the same bits."""
    state = {name: tensor.contiguous().cpu() for name, tensor in ensemble.state().items()}
    card = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "polarity": POLARITY,
        "config": ensemble.config.to_dict(),
        "metrics": ensemble.metrics,
        "weights_sha256": _digest(state),
    }
    return save(state, metadata={"card": json.dumps(card, sort_keys=True, allow_nan=False)})


def load_reward_ensemble(source: bytes | Path) -> RewardEnsemble:
    """Read an ensemble from its file, or the bytes of it.

    Raises:
        NewerCheckpoint: if a later version of this library wrote it.
        DamagedCheckpoint: if it is no ensemble, or not whole.
    """
    stored = read_stored(source)
    card = _card(stored)
    try:
        state = load(stored)
    except SafetensorError as error:
        raise DamagedCheckpoint(str(error)) from error
    if card.get("weights_sha256") != _digest(state):
        raise DamagedCheckpoint("its weights are not those its card was written for")
    return _build(card, state)


def _build(card: Mapping[str, object], state: dict[str, Tensor]) -> RewardEnsemble:
    config, metrics = config_in(card), metrics_in(card)
    scales = state.get("reward_mean")
    if scales is None or scales.dim() != 1 or not len(scales):
        raise DamagedCheckpoint("it holds no members")
    try:
        stack = StackedModels([build_reward_model(config)] * len(scales))
        stack.load(state)
    except (InvalidConfig, ModelMismatch) as error:
        raise DamagedCheckpoint(str(error)) from error
    return RewardEnsemble(stack, metrics)


def _card(stored: bytes) -> Mapping[str, object]:
    try:
        (length,) = _LENGTH.unpack_from(stored)
        header = json.loads(stored[_LENGTH.size : _LENGTH.size + length])
        card = json.loads(header["__metadata__"]["card"])
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpoint("its header holds no card") from error
    return checked_card(card, FORMAT, FORMAT_VERSION)


def _digest(state: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(name.encode())
        digest.update(state[name].numpy().tobytes())
    return digest.hexdigest()
