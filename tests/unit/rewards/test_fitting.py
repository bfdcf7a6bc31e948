import math

import pytest
import torch

from mapt.preferences.loss import preference_losses
from mapt.rewards.data import PairTensors
from mapt.rewards.schedule import StageSettings
from mapt.rewards.trainer import (
    Fitting,
    Stage,
    WeightAverage,
    exceeds_chance,
    is_kept,
    is_out_of_patience,
    judge_pairs,
)


def test_a_steady_gain_convinces_and_a_lucky_one_does_not():
    assert exceeds_chance(torch.tensor([0.2, 0.1, 0.3, 0.2]))
    assert not exceeds_chance(torch.tensor([1.0, -0.5, 0.1, -0.1, 0.0, 0.0, 0.0, 0.0]))
    assert not exceeds_chance(torch.tensor([-0.2, -0.1, -0.3]))


def test_nothing_gained_does_not_convince():
    assert not exceeds_chance(torch.zeros(20))


def test_a_stage_that_need_not_convince_is_kept_unless_it_is_worthless():
    settings = StageSettings(1e-3, 0.0, 32, 1, 1, 0.0)
    before = torch.full((4, 20), 0.1)
    after = torch.tensor([0.05, 0.2, 0.69, 0.8])[:, None].expand(4, 20)
    assert is_kept(settings, before, after).tolist() == [True, True, True, False]
    assert is_kept(settings, torch.full((20,), 0.9), torch.full((20,), 0.85))


def test_patience_is_longer_until_pairs_are_told_better_than_by_a_coin():
    settings = StageSettings(1e-3, 0.0, 32, 60, patience=5, label_noise=0.0, first_patience=20)
    waited, begun = torch.tensor([4, 5, 5, 19, 20]), torch.tensor([True, True, False, False, False])
    assert is_out_of_patience(settings, waited, begun).tolist() == [False, True, False, False, True]


@pytest.mark.parametrize(("awake_from", "learns"), [(3, True), (8, True), (40, False)])
def test_a_stage_that_stays_level_at_first_is_waited_for(awake_from, learns):
    """A network whose gradient comes only after some epochs, and then tells everything."""
    quality = torch.linspace(-1, 1, 60)
    pairs = PairTensors(torch.stack([torch.arange(60), torch.arange(60).flip(0)], dim=1), (quality > 0).float())
    model = torch.nn.Linear(1, 1, bias=False)
    torch.nn.init.zeros_(model.weight)
    fitting = Fitting(model, pairs, pairs, seed=0, max_epochs=60)

    def score(index):
        return model.weight.sum() * quality[index] * (len(fitting.history) >= awake_from)

    settings = StageSettings(0.1, 0.0, 32, max_epochs=60, patience=3, label_noise=0.0, first_patience=12)
    fitting.run(Stage(settings, list(model.parameters()), score))
    assert (model.weight.item() > 0) == learns
    assert learns or len(fitting.history) == 12


def test_losses_of_pairs_average_to_their_judgement():
    scores = torch.tensor([0.5, -1.0, 2.0])
    pairs = PairTensors(torch.tensor([[0, 1], [2, 0], [1, 2]]), torch.tensor([1.0, 0.5, 0.0]))
    judgement = judge_pairs(pairs, lambda index: scores[index])
    losses = preference_losses(pairs.logits(lambda index: scores[index]), pairs.labels)
    assert math.isclose(losses.mean().item(), judgement.loss, rel_tol=1e-6)
    assert judgement.accuracy == 1.0


def test_no_pairs_give_no_judgement():
    empty = PairTensors(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0))
    assert math.isnan(judge_pairs(empty, lambda index: index).loss)


def test_an_average_follows_and_lets_go():
    weight = torch.nn.Parameter(torch.zeros(2))
    average = WeightAverage([weight])
    for step in range(1, 2001):
        weight.data.fill_(1.0 if step % 2 else -1.0)
        average.follow()
    with average.in_place():
        assert weight.abs().max() < 0.05
    assert torch.equal(weight, torch.full((2,), -1.0))


def test_an_average_of_a_weight_that_stands_still_is_that_weight():
    weight = torch.nn.Parameter(torch.zeros(3))
    average = WeightAverage([weight])
    weight.data.fill_(2.0)
    for _ in range(1500):
        average.follow()
    with average.in_place():
        torch.testing.assert_close(weight, torch.full((3,), 2.0))
