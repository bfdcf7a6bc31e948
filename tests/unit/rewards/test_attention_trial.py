import math

import pytest
import torch

from mapt.rewards.attention_trial import AttentionTrial, cross_selected, is_due, stays_in_use, trial_metrics, verdict

# In nats: the Markov path explains most of the preferences, or few.
EXPLAINED, UNEXPLAINED = 0.2, 0.6


@pytest.mark.parametrize(
    ("mean", "is_last", "expected"),
    [(0.5, False, True), (0.2, False, None), (0.05, False, False), (-0.1, False, False), (0.1, True, False)],
)
def test_verdict_waits_only_for_an_uncertain_gain(mean, is_last, expected):
    # The standard error of 101 gains of +1 and -1 around the mean is 0.1.
    gains = mean + torch.tensor([1.0, -1.0] * 50 + [0.0])
    assert verdict(gains, markov_loss=EXPLAINED, is_last=is_last) is expected


def test_last_verdict_needs_two_standard_errors():
    deviations = torch.tensor([1.0, -1.0] * 50 + [0.0])
    assert verdict(0.25 + deviations, markov_loss=EXPLAINED, is_last=False) is None
    assert verdict(0.25 + deviations, markov_loss=EXPLAINED, is_last=True) is True
    assert verdict(0.15 + deviations, markov_loss=EXPLAINED, is_last=True) is False


@pytest.mark.parametrize(
    ("mean", "is_last", "expected"),
    [(0.008, False, False), (0.015, False, None), (0.018, True, False), (0.018, False, None), (0.025, False, True)],
)
def test_a_gain_that_is_too_small_to_matter_is_rejected(mean, is_last, expected):
    # The standard error of 10,001 gains of +0.6 and -0.6 around the mean is 0.006.
    gains = mean + 0.6 * torch.tensor([1.0, -1.0] * 5000 + [0.0])
    assert verdict(gains, markov_loss=EXPLAINED, is_last=is_last) is expected


def test_one_pair_accepts_nothing():
    for markov_loss in (EXPLAINED, UNEXPLAINED):
        assert verdict(torch.tensor([5.0]), markov_loss=markov_loss, is_last=True) is False


@pytest.mark.parametrize(
    ("mean", "is_last", "expected"),
    [
        (0.35, False, True),
        (0.15, False, None),
        (-0.15, False, None),
        (-0.25, False, False),
        (0.15, True, True),
        (0.05, True, False),
        (-0.15, True, False),
    ],
)
def test_where_the_markov_path_explains_little_only_a_clear_loss_ends_a_trial_early(mean, is_last, expected):
    # The standard error is 0.1.
    gains = mean + torch.tensor([1.0, -1.0] * 50 + [0.0])
    assert verdict(gains, markov_loss=UNEXPLAINED, is_last=is_last) is expected


@pytest.mark.parametrize(
    ("mean", "markov_loss", "expected"),
    [
        (0.15, EXPLAINED, True),
        (0.05, EXPLAINED, False),
        (0.05, UNEXPLAINED, True),
        (-0.05, UNEXPLAINED, False),
        (0.5, 0.05, False),
    ],
)
def test_attention_stays_in_use_while_it_gains(mean, markov_loss, expected):
    gains = mean + torch.tensor([1.0, -1.0] * 50 + [0.0])
    assert stays_in_use(gains, markov_loss=markov_loss) is expected


def test_each_pair_is_judged_at_the_epoch_that_the_other_half_selects():
    losses = [torch.tensor([0.5, 0.4, 0.5, 0.4]), torch.tensor([0.9, 0.1, 0.9, 0.1])]
    # The second epoch is better for pairs 1 and 3, and selected for pairs 0 and 2, where it is worse.
    assert cross_selected(losses).tolist() == pytest.approx([0.9, 0.4, 0.9, 0.4])


def test_selection_among_noise_shows_no_gain():
    noise = torch.randn(60, 2000, generator=torch.Generator().manual_seed(0))
    assert noise.mean(dim=1).min() < -0.04
    assert abs(cross_selected(list(noise)).mean().item()) < 4 / math.sqrt(2000)


@pytest.mark.parametrize(("labels", "due"), [(100, False), (129, False), (130, True), (500, True)])
def test_trial_is_due_when_labels_have_grown(labels, due):
    assert is_due(labels, {"attention_trial_labels": 100.0}, 1.3) == due


def test_first_trial_is_due():
    assert is_due(20, None, 1.3)
    assert is_due(20, {"attention_trial_labels": None}, 1.3)


def test_metrics_of_the_latest_trial_are_kept():
    trial = AttentionTrial(True, torch.tensor([0.1, 0.3]), labels=100, seconds=7.0)
    first = trial_metrics(trial, None)
    assert first == pytest.approx(
        {
            "attention_trial_seconds": 7,
            "attention_gain": 0.2,
            "attention_gain_error": 0.1,
            "attention_gain_pairs": 2,
            "attention_trial_labels": 100,
        }
    )
    assert trial_metrics(None, first) == {**first, "attention_trial_seconds": 0.0}
    assert trial_metrics(None, None) == {"attention_trial_seconds": 0.0}
