"""Learned and true reward along a rollout: a whole episode where one was recorded, else segments in a row."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.rewards.model import RewardModel
from mapt.rewards.relabelling import RolloutRelabeller
from mapt.studies.quality import predict
from mapt.studies.recording import episodes_path
from mapt.studies.replay import Replay

#: of an episode; more cannot be told apart in a picture
_MOST_STEPS = 300
#: which segments, by their place in the replay, where no episode was recorded
_PLACES = (0.02, 0.25, 0.5, 0.75, 0.98)


@dataclass(frozen=True, slots=True)
class RolloutSeries:
    """Steps to compare rewards along."""

    #: in words
    what: str
    #: steps before which another segment begins
    breaks: tuple[int, ...]
    #: (L,)
    true: NDArray[np.float64]
    #: for each model, (L,)
    learned: dict[str, NDArray[np.floating]]


def rollout_series(replay: Replay, models: dict[str, RewardModel]) -> RolloutSeries:
    """The team's rewards along a rollout of the replay's policy, as the policy would be given them."""
    path = episodes_path(replay.path)
    return _episode(Replay.open(path), replay.source.n_steps, models) if path.exists() else _segments(replay, models)


def _episode(episodes: Replay, window: int, models: dict[str, RewardModel]) -> RolloutSeries:
    steps = slice(0, min(_MOST_STEPS, int(episodes.mask[0].sum())))
    played = episodes.segments([0])
    observations, actions = (array[0, steps, None] for array in (played.observations, played.actions))
    start = np.zeros((len(observations), 1), np.bool_)
    start[0] = True
    learned = {
        name: RolloutRelabeller(model, window, 1).relabel(observations, actions, start)[:, 0]
        for name, model in models.items()
    }
    what = f"The first {len(start)} steps of an episode of the trained policy"
    return RolloutSeries(what, (), episodes.rewards[0, steps], learned)


def _segments(replay: Replay, models: dict[str, RewardModel]) -> RolloutSeries:
    places = [round(place * (len(replay) - 1)) for place in _PLACES]
    segments, mask = replay.segments(places), replay.mask[places]
    breaks = tuple(np.cumsum(mask.sum(axis=1))[:-1].tolist())
    learned = {name: predict(model, segments).rewards[mask] for name, model in models.items()}
    what = f"{len(places)} segments from the replay's beginning to its end"
    return RolloutSeries(what, breaks, replay.rewards[places][mask], learned)
