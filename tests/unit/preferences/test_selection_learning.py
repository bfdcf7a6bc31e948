"""Whether an informed choice is worth it: an ensemble of linear rewards learns from pairs that it chooses itself."""

import numpy as np
import pytest

from mapt.preferences.selection import ControlledSelector, SegmentView, UniformSelector, make_selector

SEGMENTS, DIMENSIONS, MEMBERS = 400, 40, 3
FIRST, BATCH, LABELS, SEEDS = 20, 20, 160, 6


def fitted(steps, labels, weights):
    """Members' weights (M, F) after gradient descent on the Bradley-Terry loss of differences `steps` (P, F)."""
    for _ in range(150):
        excess = 1 / (1 + np.exp(-np.clip(steps @ weights.T, -30, 30))) - labels[:, None]
        weights = weights - 0.3 * (excess.T @ steps / len(labels) + 1e-3 * weights)
    return weights


def accuracy_of(name, seed):
    """Of the members' mean on fresh pairs, after LABELS labels by an oracle."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(SEGMENTS, DIMENSIONS))
    returns = features @ (rng.normal(size=DIMENSIONS) * np.geomspace(0.1, 1, DIMENSIONS))
    start = rng.normal(size=(MEMBERS, DIMENSIONS))
    selector = ControlledSelector(make_selector(name, rng), UniformSelector(rng), 0.2, rng)
    asked, view = [], None
    while len(asked) < LABELS:
        k = FIRST if view is None else BATCH
        asked += [chosen.pair for chosen in selector.choose(range(SEGMENTS), asked, k, view)]
        first, second = np.array(asked).T
        weights = fitted(features[first] - features[second], (returns[first] > returns[second]) * 1.0, start)
        view = SegmentView(weights @ features.T, features)
    first, second = rng.integers(SEGMENTS, size=(2, 4000))
    scores = view.scores.mean(axis=0)
    decided = first != second
    return ((scores[first] > scores[second]) == (returns[first] > returns[second]))[decided].mean()


@pytest.mark.parametrize("name", ["disagreement", "entropy"])
def test_asking_where_members_are_unsure_beats_asking_at_random(name):
    gains = [accuracy_of(name, seed) - accuracy_of("uniform", seed) for seed in range(SEEDS)]
    # paired over seeds: by more than two points, and by more than three standard errors
    assert np.mean(gains) > 0.02
    assert np.mean(gains) > 3 * np.std(gains, ddof=1) / np.sqrt(SEEDS)
