"""Settings of the learner."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Literal, Self, get_args

from mapt.errors import InvalidConfig

Algorithm = Literal["mappo", "happo", "mat", "mat_dec"]
Activation = Literal["tanh", "relu"]

#: What an algorithm starts from where it differs from MAPPO's settings; found on HalfCheetah-6x1, one seed and a
#: million steps each. A transformer takes a smaller step than a small perceptron does. MAT and HAPPO move further in
#: a pass than MAPPO does, so they make half as many; mat_dec needs all ten: 5,525 instead of 2,985.
ALGORITHM_DEFAULTS: Mapping[str, Mapping[str, object]] = {
    "mappo": {},
    "happo": {"learning_rate": 1e-3, "epochs": 5},
    "mat": {"learning_rate": 5e-4, "epochs": 5},
    "mat_dec": {"learning_rate": 5e-4},
}


@dataclass(frozen=True, slots=True)
class PolicyConfig:
    """Settings of the learner; the defaults are MAPPO's, tuned on HalfCheetah-6x1 with its true reward.

    `named` and `from_dict` give the other algorithms defaults of their own.

    Raises:
        InvalidConfig: if a value is of the wrong type or out of its range.
    """

    #: How the team decides and how it is updated: mappo and happo have an actor per agent and a critic of the state,
    #: mat decides agent after agent with a transformer, mat_dec has mat's encoder for a critic and an actor per agent.
    algorithm: Algorithm = "mappo"
    #: Environments stepped at once, E.
    n_envs: int = 32
    #: Steps per environment between updates, L.
    rollout_steps: int = 128
    #: Passes over a rollout per update.
    epochs: int = 10
    #: Gradient steps per pass; must divide n_envs * rollout_steps.
    minibatches: int = 16
    #: Adam's learning rate at the start.
    learning_rate: float = 2e-3
    #: Environment steps over which the learning rate falls linearly to a tenth; 0 keeps it.
    anneal_steps: int = 0
    #: Largest change of an action's probability that still earns, PPO's epsilon.
    clip: float = 0.1
    #: Discount per step.
    gamma: float = 0.99
    #: GAE's lambda.
    gae_lambda: float = 0.95
    #: Weight of the actions' entropy.
    entropy_weight: float = 0.0
    #: Weight of the critic's loss.
    value_weight: float = 0.5
    #: Gradients are scaled down to this norm.
    max_gradient_norm: float = 0.5
    #: Widths of the hidden layers of the perceptrons: actor and critic of mappo and happo, actor of mat_dec.
    hidden: tuple[int, ...] = (64, 64)
    #: Nonlinearity between them.
    activation: Activation = "tanh"
    #: Width of the transformers of mat and mat_dec, d.
    width: int = 64
    #: Layers of the encoder and of the decoder.
    layers: int = 1
    #: Attention heads; must divide width.
    heads: int = 1
    #: Log of the actions' standard deviation at the start.
    initial_log_std: float = -0.5
    #: One actor for all agents, or one each; mat's decoder serves all agents in any case.
    shared_actor: bool = False
    #: Weight of the newest rollout in the statistics of returns.
    value_statistics_rate: float = 0.1
    #: Decides every draw of the learner and of its task.
    seed: int = 0
    #: Threads of torch while collecting and updating; 0 leaves them alone. Networks this small gain nothing from a
    #: second one, and lose much when another process wants the core.
    n_threads: int = 1
    #: Where the networks live: auto takes a GPU when there is one.
    device: str = "auto"

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_type(field.name, getattr(self, field.name), type(field.default))
        for name in ("n_envs", "rollout_steps", "epochs", "minibatches", "width", "layers", "heads"):
            self._require(getattr(self, name) >= 1, name, "must be 1 or more")
        for name in ("anneal_steps", "seed", "n_threads", "entropy_weight", "value_weight"):
            self._require(getattr(self, name) >= 0, name, "must be 0 or more")
        for name in ("learning_rate", "clip", "max_gradient_norm"):
            self._require(getattr(self, name) > 0, name, "must be more than 0")
        for name in ("gamma", "gae_lambda"):
            self._require(0 <= getattr(self, name) <= 1, name, "must lie between 0 and 1")
        for name, known in (("algorithm", get_args(Algorithm)), ("activation", get_args(Activation))):
            self._require(getattr(self, name) in known, name, f"must be one of {', '.join(known)}")
        self._require(0 < self.value_statistics_rate <= 1, "value_statistics_rate", "must be above 0 and at most 1")
        widths = all(type(width) is int and width >= 1 for width in self.hidden)
        self._require(bool(self.hidden) and widths, "hidden", "must be widths of 1 or more")
        self._require(self.width % self.heads == 0, "heads", "must divide width")
        self._require(self.device in {"auto", "cpu", "cuda"}, "device", "must be auto, cpu or cuda")
        self._require(
            self.steps_per_rollout % self.minibatches == 0, "minibatches", "must divide n_envs * rollout_steps"
        )
        one_each = self.algorithm != "happo" or not self.shared_actor
        self._require(one_each, "shared_actor", "must be false for happo, which updates one agent after the other")

    @property
    def steps_per_rollout(self) -> int:
        """Environment steps of one rollout, E * L."""
        return self.n_envs * self.rollout_steps

    @classmethod
    def named(cls, algorithm: str, **settings: object) -> Self:
        """The algorithm's own defaults, but for these settings; raises as `from_dict`."""
        return cls.from_dict({"algorithm": algorithm, **settings})

    @classmethod
    def from_dict(cls, settings: Mapping[str, object]) -> Self:
        """A configuration from parsed JSON; what is left out keeps the algorithm's default.

        Raises:
            InvalidConfig: if a key is unknown, or a value of the wrong type or out of its range.
        """
        known = [field.name for field in fields(cls)]
        unknown = sorted(set(settings) - set(known))
        if unknown:
            raise InvalidConfig(f"Unknown settings: {', '.join(unknown)}. Known: {', '.join(known)}.")
        defaults = ALGORITHM_DEFAULTS.get(str(settings.get("algorithm", "mappo")), {})
        values = {
            name: tuple(value) if isinstance(value, list) else value for name, value in {**defaults, **settings}.items()
        }
        return cls(**values)  # pyright: ignore[reportArgumentType]  (types are checked on creation)

    def to_dict(self) -> dict[str, object]:
        """What `from_dict` reads, ready for JSON."""
        return {**asdict(self), "hidden": list(self.hidden)}

    def _require(self, holds: bool, name: str, rule: str) -> None:
        if not holds:
            raise InvalidConfig(f"{name} {rule}, got {getattr(self, name)!r}.")


def _check_type(name: str, value: object, expected: type) -> None:
    # bool is an int to Python, and JSON writes 1.0 as 1.
    allowed = (int, float) if expected is float else expected
    if not isinstance(value, allowed) or (isinstance(value, bool) and expected is not bool):
        raise InvalidConfig(f"{name} must be of type {expected.__name__}, got {value!r}.")
