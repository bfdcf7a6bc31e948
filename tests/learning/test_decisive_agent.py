"""What a tap on the agent that decided each preference is worth, with the same pairs and labels.

Run by `make learn`. The teacher `low-effort` prefers the segment whose joints take less power. Its score is a sum over
agents, so that it knows the true reward of each agent, and which agent decided. MAPT trains the same network first.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from mapt.benchmarks.evaluate import DatasetTeacher, evaluate_model, held_out_pairs, labelled_dataset, split_dataset
from mapt.benchmarks.job import network_of, training_of
from mapt.benchmarks.recorded_dataset import RecordedDataset, Recording, record_dataset
from mapt.preferences.dataset import PreferenceDataset
from mapt.preferences.teachers import LowEffort, TeacherView, make_teacher
from mapt.rewards.inspection import predict
from mapt.rewards.metrics import correlation
from mapt.rewards.model import RewardModel
from mapt.rewards.trainer import train_reward_model

TEACHER, MODEL, N_TEST_PAIRS = "low-effort", "MA-MLP", 4000
LABELS = (100, 500)
SEEDS = (0, 1, 2)

pytestmark = pytest.mark.learn


@pytest.fixture(scope="module", params=SEEDS)
def seeded_segments(request, tmp_path_factory):
    recording = Recording("HalfCheetah-6x1", policy_steps=100_000, segment_steps=50, segments=1500, seed=request.param)
    return request.param, record_dataset(recording, tmp_path_factory.mktemp("effort") / "segments")


def tapped(pairs: PreferenceDataset) -> PreferenceDataset:
    """The same labels, each with the agent that decided it."""
    segments = pairs.segments.take(np.arange(len(pairs.segments)))
    view = TeacherView(np.zeros(segments.mask.shape), segments.mask, segments.observations, segments.actions)
    first, second = (view.take(side) for side in pairs.pairs.T)
    return replace(pairs, decisive_agents=make_teacher(TEACHER).decisive_agents(first, second, pairs.labels))


def agent_metrics(model: RewardModel, recorded: RecordedDataset, seed: int) -> dict[str, float]:
    """How far the rewards of single agents are right, on held-out segments and pairs.

    Returns:
        `agent_correlation`: of learned and true reward over steps, mean over agents. `share_correlation`: of the
        learned and true parts of agents in the score difference of a pair, less their mean over agents. `decisive`: how
        often the learned largest part is that of the agent that decided.
    """
    test = split_dataset(len(recorded), seed).test
    segments = recorded.segments(test)
    learned = predict(model, segments)
    view = TeacherView(np.zeros(segments.mask.shape), segments.mask, segments.observations, segments.actions)
    true = LowEffort().step_scores(view)
    agents = range(segments.n_agents)
    steps = [correlation(learned.agent_rewards[..., n][segments.mask], true[..., n][segments.mask]) for n in agents]
    pairs = np.searchsorted(test, held_out_pairs(len(recorded), N_TEST_PAIRS, seed))
    learned_parts = (learned.weights[..., None] * learned.agent_rewards).sum(axis=1)
    differences = [parts[pairs[:, 0]] - parts[pairs[:, 1]] for parts in (learned_parts, true.sum(axis=1))]
    by_pair = [each - each.mean(axis=1, keepdims=True) for each in differences]
    side = np.sign(differences[1].sum(axis=1, keepdims=True))
    decisive = [(side * each).argmax(axis=1) for each in differences]
    return {
        "agent_correlation": float(np.mean(steps)),
        "share_correlation": correlation(by_pair[0].ravel(), by_pair[1].ravel()),
        "decisive": float((decisive[0] == decisive[1]).mean()),
    }


def measure(name: str, pairs: PreferenceDataset, recorded: RecordedDataset, seed: int, **options: float):
    """Train on the pairs; print and return the metrics."""
    network = network_of(MODEL, "small", recorded.source.layout)
    training = replace(training_of(MODEL, "small", seed, "cpu"), **options)
    trained = train_reward_model(pairs, network, training)
    metrics = {
        "accuracy": evaluate_model(trained.model, recorded, TEACHER, N_TEST_PAIRS, seed).metrics["accuracy"],
        **agent_metrics(trained.model, recorded, seed),
    }
    figures = ", ".join(f"{key} {value:.3f}" for key, value in metrics.items())
    print(f"\nseed {seed}, {name}: {figures}; {trained.metrics['seconds']:.0f} s", end="", flush=True)
    return metrics


@pytest.mark.parametrize("n_labels", LABELS)
def test_taps_on_the_decisive_agent_teach_the_rewards_of_agents(seeded_segments, n_labels: int):
    seed, recorded = seeded_segments
    pairs = labelled_dataset(DatasetTeacher(TEACHER, recorded, seed), recorded, n_labels, seed)
    found: Mapping[str, Mapping[str, float]] = {
        name: measure(f"{n_labels} labels, {name}", dataset, recorded, seed)
        for name, dataset in (("labels alone", pairs), ("labels with taps", tapped(pairs)))
    }
    alone, taps = found["labels alone"], found["labels with taps"]
    assert taps["share_correlation"] > alone["share_correlation"] - 0.02
    assert taps["accuracy"] > alone["accuracy"] - 0.02
