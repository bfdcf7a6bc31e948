"""Several reward models of one shape, which differ where the labels leave them free to."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.device import resolve_device
from mapt.errors import InvalidConfig, ModelMismatch
from mapt.preferences.dataset import SegmentSource, in_batches
from mapt.rewards.config import RewardConfig
from mapt.rewards.data import SegmentTensors, check_fit
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model
from mapt.rewards.stacked import SEGMENTS_PER_PASS, StackedModels


class RewardEnsemble:
    """M reward models of the same settings, scored in one pass.

    Args:
        stack: the members; it becomes this ensemble's own.
        metrics: how their training went.
    """

    def __init__(self, stack: StackedModels, metrics: Mapping[str, float] | None = None) -> None:
        self._stack = stack
        self._stack.train(False)
        self.metrics = dict(metrics or {})

    @classmethod
    def of(cls, models: Sequence[RewardModel], metrics: Mapping[str, float] | None = None) -> "RewardEnsemble":
        """An ensemble of copies of these models.

        Raises:
            InvalidConfig: without a model.
            ModelMismatch: if they differ in their settings.
        """
        if not models:
            raise InvalidConfig("an ensemble needs at least one member")
        for model in models:
            if model.config != models[0].config:
                raise ModelMismatch("settings of an ensemble's member", models[0].config, model.config)
        return cls(StackedModels(models), metrics)

    def state(self) -> dict[str, torch.Tensor]:
        """Every parameter and buffer of the members behind each other, (M, ...)."""
        return self._stack.state()

    @property
    def config(self) -> RewardConfig:
        """The settings of every member."""
        return self._stack.config

    def __len__(self) -> int:
        """M."""
        return len(self._stack)

    def member(self, index: int) -> RewardModel:
        """One member as a model of its own, in evaluation mode on the CPU."""
        model = build_reward_model(self.config)
        state = self._stack.state_of(range(len(self))[index])
        model.load_state_dict({name: state[name] for name in model.state_dict()})
        return model.eval()

    @torch.no_grad()
    def scores(self, segments: SegmentSource, device: str = "cpu") -> NDArray[np.float32]:
        """Score of every segment by every member, (M, S): its own P(i preferred to j) is sigmoid(score_i - score_j).

        Args:
            device: as in `TrainConfig`; where the members then stay.

        Raises:
            ModelMismatch: if the segments are of another task.
        """
        check_fit(self.config, segments)
        on = resolve_device(device)
        self._stack.to(on)
        scores = [
            self._stack.outputs(*SegmentTensors.of(part, on).inputs)[0].cpu().numpy()
            for part in in_batches(segments, SEGMENTS_PER_PASS)
        ]
        return np.concatenate(scores, axis=1) if scores else np.zeros((len(self), 0), dtype=np.float32)
