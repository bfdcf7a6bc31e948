"""Models of a table: a network and its training."""

from mapt.preferences.storage import SegmentLayout
from mapt.rewards.config import PresetName, RewardConfig
from mapt.rewards.train_config import TrainConfig
from mapt.studies.naming import Written

#: before a setting of the training; all others are the network's
TRAINING_PREFIX = "train."


def network_of(model: str, preset: PresetName, segments: SegmentLayout) -> RewardConfig:
    """The network of `model` for segments of these dimensions.

    Args:
        model: a name of `MODEL_NAMES`, or one with settings: `MAPT:markov_path=false`.

    Raises:
        InvalidConfig: if there is no such model, or a setting is unknown or out of its range.
    """
    written = Written.parse(model)
    named = RewardConfig.named(
        written.name,
        preset,
        observation_dim=segments.observation_dim,
        action_dim=segments.action_dim,
        n_agents=segments.n_agents,
        discrete_actions=segments.discrete,
    )
    own = {key: value for key, value in written.settings.items() if not key.startswith(TRAINING_PREFIX)}
    return RewardConfig.from_dict(named.to_dict() | own)


def training_of(model: str, preset: PresetName, seed: int, device: str) -> TrainConfig:
    """The training of `model`: the preset's, but for its settings after `train.`, as in `MAPT:train.lr=1e-3`.

    Raises:
        InvalidConfig: if a setting is unknown or out of its range.
    """
    own = {
        key.removeprefix(TRAINING_PREFIX): value
        for key, value in Written.parse(model).settings.items()
        if key.startswith(TRAINING_PREFIX)
    }
    return TrainConfig.from_dict(TrainConfig.preset(preset).to_dict() | own | {"seed": seed, "device": device})
