"""What a demo runs: one plan for each seed, number of labels and reward model, and for the true reward beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from accord.domain.errors import Invalid
from mapt.studies.errors import InvalidStudy
from mapt.studies.naming import numbers, setting, words

TRUE = "true"
PREFERENCES = "preferences"
#: More labels on the untrained team's few segments teach the reward those by heart: of 3,000, 600 before the first
#: version led to a return of 2,976, 100 to 4,167 (HalfCheetah-6x1, seed 2).
MOST_INITIAL_LABELS = 100


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What to run: an experiment's settings, as the API takes them."""

    name: str
    task: str
    #: preferences or true
    reward_source: str
    seed: int
    total_steps: int
    label_budget: int
    initial_labels: int
    labels_per_version: int
    render_clips: bool
    reward_model: str = "MAPT"
    #: settings of the policy's learner
    policy: dict[str, Any] = field(default_factory=dict[str, Any])

    def differences(self, config: Mapping[str, Any]) -> list[str]:
        """In what an experiment's settings are not these, as sentences' ends."""
        own = {name: value for name, value in asdict(self).items() if name != "name"}
        return [f"{name} is {config[name]!r}, not {value!r}" for name, value in own.items() if config[name] != value]


@dataclass(frozen=True, slots=True)
class Grid:
    """Every combination of the lists, on one task."""

    task: str
    total_steps: int
    seeds: Sequence[int]
    labels: Sequence[int]
    reward_models: Sequence[str]
    #: labels before the first version; None for a fifth of them, at most `MOST_INITIAL_LABELS`
    initial_labels: int | None = None
    #: labels for each further version; None for a tenth of them
    labels_per_version: int | None = None
    render_clips: bool = False
    #: train on the true reward too, once for each seed
    baseline: bool = True
    policy: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def plans(self, teacher: str) -> list[RunPlan]:
        """Seed after seed, so that what is there when a long demo is ended can be compared.

        Args:
            teacher: how the teacher is called in the names of the runs.
        """
        return [plan for seed in self.seeds for plan in self._of_seed(seed, teacher)]

    def _of_seed(self, seed: int, teacher: str) -> list[RunPlan]:
        learned = [
            self._plan(
                f"{self.task} seed {seed}, {model}, {labels} labels of {teacher}",
                seed,
                PREFERENCES,
                label_budget=labels,
                initial_labels=self.initial_labels or max(2, min(labels // 5, MOST_INITIAL_LABELS)),
                labels_per_version=self.labels_per_version or max(1, labels // 10),
                render_clips=self.render_clips,
                reward_model=model,
            )
            for labels in self.labels
            for model in self.reward_models
        ]
        # Nothing about labels, so that the same run serves demos that differ in them.
        nothing = {"label_budget": 0, "initial_labels": 0, "labels_per_version": 1, "render_clips": False}
        true = [self._plan(f"{self.task} seed {seed}, true reward", seed, TRUE, **nothing)] if self.baseline else []
        return [*true, *learned]

    def _plan(self, name: str, seed: int, source: str, **settings: Any) -> RunPlan:
        return RunPlan(
            name=name,
            task=self.task,
            reward_source=source,
            seed=seed,
            total_steps=self.total_steps,
            policy=dict(self.policy),
            **settings,
        )


def parse_numbers(option: str, text: str, least: int) -> tuple[int, ...]:
    """Raises Invalid, with an example."""
    try:
        return numbers(option, text, least)
    except InvalidStudy as error:
        raise Invalid(f"{error}.") from error


def parse_words(option: str, text: str) -> tuple[str, ...]:
    """Raises Invalid."""
    try:
        return words(option, text)
    except InvalidStudy as error:
        raise Invalid(f"{error}.") from error


def parse_settings(option: str, texts: Sequence[str], example: str) -> dict[str, Any]:
    """Settings written as KEY=VALUE.

    Raises:
        Invalid: if one is none; it shows the example.
    """
    try:
        return dict(setting(text) for text in texts)
    except InvalidStudy as error:
        raise Invalid(f"{option} {error}. One looks like {example}.") from error
