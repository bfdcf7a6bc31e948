"""Where a policy's rewards come from: the task, or a reward model of which newer versions appear during training."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapt.errors import DamagedCheckpoint, ModelMismatch
from mapt.policies import Rollout
from mapt.rewards.checkpoints import CARD_FILE, WEIGHTS_FILE, LoadedRewardModel, load_reward_model, save_reward_model
from mapt.rewards.model import PolicyReward, RewardModel
from mapt.rewards.relabelling import Credit, RolloutRelabeller
from mapt.tasks import TaskSpec
from mapt.training.settings import RunSettings

Context = dict[str, NDArray[np.generic]]


class VersionedReward:
    """Relabels whole rollouts, each by one version; versions change between rollouts alone.

    Args:
        segment_steps: T.
        n_envs: E.
        credit, kind, device: as in `RolloutRelabeller`.
        version, context: as of the checkpoint that training goes on from.
    """

    def __init__(
        self,
        segment_steps: int,
        n_envs: int,
        *,
        credit: Credit,
        kind: PolicyReward,
        device: str,
        version: str | None = None,
        context: Context | None = None,
    ) -> None:
        self._segment_steps, self._n_envs, self._device = segment_steps, n_envs, device
        self._credit: Credit = credit
        self._kind: PolicyReward = kind
        self._restored: Context = context or {}
        self._relabeller: RolloutRelabeller | None = None
        #: of the model in force; None before the first
        self.version = version

    def holds(self, version: str) -> bool:
        """Whether the model in force is of this version; one that was restored by name has to be adopted again."""
        return self._relabeller is not None and version == self.version

    def adopt(self, model: RewardModel, version: str) -> bool:
        """Use this model from the next rollout on; the steps that rewards look back on are kept.

        Returns:
            Whether it is another version than before: tell the learner, by `Learner.reward_changed`.

        Raises:
            ModelMismatch: if it is for a task of other dimensions than the last one.
        """
        if self._relabeller is None:
            self._relabeller = RolloutRelabeller(
                model, self._segment_steps, self._n_envs, self._credit, self._device, kind=self._kind
            )
            if self._restored:
                self._relabeller.load_state_dict(self._restored)
        else:
            self._relabeller.replace_model(model)
        changed = version != self.version
        self.version = version
        return changed

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        """(L, E), or (L, E, N) where each agent gets its own. Call `adopt` before."""
        if self._relabeller is None:
            raise RuntimeError("There is no reward version yet.")
        return self._relabeller.relabel(rollout.observations, rollout.actions, rollout.episode_start)

    def context(self) -> Context:
        """What the next rewards look back on."""
        return self._relabeller.state_dict() if self._relabeller else self._restored


#: hexadecimal digits of a weights' SHA-256 that are shown
_SHOWN = 12


class RewardSource(Protocol):
    """Rewards of whole rollouts, each rollout by one version."""

    @property
    def progress(self) -> dict[str, object]:
        """What a checkpoint must hold of it beside `context`."""
        ...

    def refresh(self) -> bool:
        """Use the newest version from the next rollout on. Returns whether it is another than before."""
        ...

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        """(L, E), or (L, E, N) where each agent gets its own."""
        ...

    def metrics(self) -> dict[str, float | str]:
        """Which version is in force."""
        ...

    def context(self) -> Context:
        """What the next rewards look back on."""
        ...


def make_reward_source(
    settings: RunSettings,
    spec: TaskSpec,
    progress: dict[str, object],
    context: Context,
    *,
    keep: Path,
    note: Callable[[str], None],
) -> RewardSource:
    """The source that the settings name.

    Args:
        progress, context: of the checkpoint that the run goes on from; empty at its beginning.
        keep: folder for a copy of every version that was learned from.
        note: told in a sentence when a new version cannot be read.

    Raises:
        CheckpointError: if there is no reward model that can be read.
        ModelMismatch: if it is for another task.
    """
    if settings.reward is None:
        return TrueReward()
    return FileReward(settings, spec, progress, context, keep=keep, note=note)


class TrueReward:
    """The task's own reward."""

    progress: dict[str, object] = {}  # noqa: RUF012  (never written to)

    def refresh(self) -> bool:
        return False

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        return rollout.rewards

    def metrics(self) -> dict[str, float | str]:
        return {}

    def context(self) -> Context:
        return {}


class FileReward:
    """The reward model in two files, read anew when they are replaced. See `make_reward_source`."""

    def __init__(
        self,
        settings: RunSettings,
        spec: TaskSpec,
        progress: dict[str, object],
        context: Context,
        *,
        keep: Path,
        note: Callable[[str], None],
    ) -> None:
        if settings.reward is None:
            raise ValueError("The settings name the true reward.")
        self._spec, self._keep, self._note = spec, keep, note
        self._weights, self._card = reward_files(Path(settings.reward.path))
        sha, number = progress.get("reward_sha"), progress.get("reward_version", 0)
        self._reward = VersionedReward(
            settings.reward.segment_steps,
            settings.policy.n_envs,
            credit=settings.reward.credit,
            kind=settings.reward.kind,
            device=settings.policy.device,
            version=str(sha) if sha else None,
            context=context,
        )
        #: versions so far, the one in force included
        self._number = int(number) if isinstance(number, int) else 0
        self._seen = self._stamp()
        self._complained = False
        #: a version that is in force from the start of a run, or other than the checkpoint's, has to be told of
        self._is_new = self._adopt(self._load())

    @property
    def progress(self) -> dict[str, object]:
        return {"reward_sha": self._reward.version or "", "reward_version": self._number}

    def refresh(self) -> bool:
        """See `RewardSource.refresh`. Files that are being written, or damaged, are looked at again next time."""
        changed, self._is_new = self._is_new, False
        stamp = self._stamp()
        if stamp == self._seen:
            return changed
        try:
            changed |= self._adopt(self._load())
        except (DamagedCheckpoint, ModelMismatch) as error:
            if not self._complained:
                self._note(f"{self._weights.parent} changed, but cannot be used: {error}. The version before stays.")
            self._complained = True
            return changed
        self._seen, self._complained = stamp, False
        return changed

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        return self._reward.rewards(rollout)

    def metrics(self) -> dict[str, float | str]:
        return {"reward_version": self._number, "reward_sha": (self._reward.version or "")[:_SHOWN]}

    def context(self) -> Context:
        return self._reward.context()

    def _load(self) -> LoadedRewardModel:
        loaded = load_reward_model(self._weights, self._card)
        found, expected = loaded.model.config.dimensions, dimensions(self._spec)
        if found != expected:
            raise ModelMismatch(f"agents, observation and action dimension of {self._spec.name}", found, expected)
        return loaded

    def _adopt(self, loaded: LoadedRewardModel) -> bool:
        if self._reward.holds(loaded.sha256):
            return False
        if not self._reward.adopt(loaded.model, loaded.sha256):
            return False
        self._number += 1
        # The file may be replaced tomorrow: what this policy has learned from stays with it.
        kept = save_reward_model(loaded.model, loaded.metrics, segment_steps=loaded.segment_steps)
        kept.write(self._keep / f"version-{self._number}")
        return True

    def _stamp(self) -> tuple[tuple[int, int, int], ...]:
        """What changes when a file is written or replaced."""
        found = [path.stat() for path in (self._weights, self._card) if path.exists()]
        return tuple((stat.st_ino, stat.st_mtime_ns, stat.st_size) for stat in found)


def reward_files(path: Path) -> tuple[Path, Path]:
    """Weights and card at a path: a folder of both, or the weights with their card beside them."""
    if path.suffix == ".safetensors":
        return path, path.with_suffix(".json")
    return path / WEIGHTS_FILE, path / CARD_FILE


def dimensions(spec: TaskSpec) -> tuple[int, int, int]:
    """N, C and A, in the order of `RewardConfig.dimensions`."""
    return spec.n_agents, spec.observation_dim, spec.action_dim
