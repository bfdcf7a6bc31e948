import math

import torch

from mapt.preferences.loss import preference_losses
from mapt.rewards.fitting import exceeds_chance, judge_pairs
from mapt.rewards.pair_tensors import PairTensors


def test_a_steady_gain_convinces_and_a_lucky_one_does_not():
    assert exceeds_chance(torch.tensor([0.2, 0.1, 0.3, 0.2]))
    assert not exceeds_chance(torch.tensor([1.0, -0.5, 0.1, -0.1, 0.0, 0.0, 0.0, 0.0]))
    assert not exceeds_chance(torch.tensor([-0.2, -0.1, -0.3]))


def test_nothing_gained_does_not_convince():
    assert not exceeds_chance(torch.zeros(20))


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
