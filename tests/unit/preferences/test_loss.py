import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import ShapeError
from mapt.preferences.loss import preference_loss, preference_losses, smoothness_penalty

pytestmark = pytest.mark.numerics

finite = st.floats(-50, 50, width=32)
probability = st.floats(0, 1, width=32)


@given(finite, finite, probability)
def test_loss_is_the_cross_entropy_of_the_logistic_of_the_score_difference(score_0, score_1, label):
    logit = score_0 - score_1
    expected = label * math.log1p(math.exp(-logit)) + (1 - label) * math.log1p(math.exp(logit))
    loss = preference_loss(torch.tensor([score_0]), torch.tensor([score_1]), torch.tensor([label]))
    assert loss.item() == pytest.approx(expected, rel=1e-4, abs=1e-5)


@given(finite, finite, probability)
def test_swapping_segments_and_label_does_not_change_the_loss(score_0, score_1, label):
    first, second, target = torch.tensor([score_0]), torch.tensor([score_1]), torch.tensor([label])
    swapped = preference_loss(second, first, 1 - target)
    torch.testing.assert_close(preference_loss(first, second, target), swapped, rtol=1e-4, atol=1e-5)


def test_label_one_prefers_segment_0():
    better, worse, label = torch.tensor([2.0]), torch.tensor([-2.0]), torch.ones(1)
    assert preference_loss(better, worse, label) < preference_loss(worse, better, label)


def test_loss_is_finite_for_scores_far_apart():
    loss = preference_loss(torch.tensor([-1e6]), torch.tensor([1e6]), torch.ones(1))
    assert loss.item() == pytest.approx(2e6)


@pytest.mark.parametrize(("n_scores", "n_labels", "name"), [(2, 3, "label"), (3, 2, "score_1")])
def test_different_shapes_are_refused(n_scores, n_labels, name):
    with pytest.raises(ShapeError) as refused:
        preference_loss(torch.zeros(2), torch.zeros(n_scores), torch.zeros(n_labels))
    assert refused.value.name == name


@given(st.floats(-20, 20, width=32), probability, st.floats(0.01, 0.49))
def test_label_noise_mixes_the_two_likelihoods(logit, label, noise):
    p = 1 / (1 + math.exp(-logit))
    seen = (1 - noise) * p + noise * (1 - p)
    expected = -label * math.log(seen) - (1 - label) * math.log(1 - seen)
    loss = preference_losses(torch.tensor([logit]), torch.tensor([label]), noise)
    assert loss.item() == pytest.approx(expected, rel=1e-3, abs=1e-4)


def test_label_noise_bounds_the_loss_of_a_confident_error_and_removes_its_gradient():
    logit = torch.tensor([60.0], requires_grad=True)
    loss = preference_losses(logit, torch.zeros(1), 0.1).sum()
    loss.backward()
    assert loss.item() == pytest.approx(math.log(10), rel=1e-4)
    assert logit.grad.abs().item() < 1e-6


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize(("sign", "label"), [(1, 1.0), (-1, 0.0)])
def test_confident_correct_predictions_have_no_denormal_gradient(sign, label, noise):
    logit = (sign * torch.tensor([5.0, 29.0, 31.0, 90.0, 100.0])).requires_grad_()
    preference_losses(logit, torch.full((5,), label), noise).sum().backward()
    assert (logit.grad[:2] * sign < 0).all()
    assert (logit.grad[2:] == 0).all()


@pytest.mark.parametrize(("sign", "label"), [(1, 0.0), (-1, 1.0)])
def test_confident_errors_have_the_full_gradient(sign, label):
    logit = (sign * torch.tensor([40.0, 200.0])).requires_grad_()
    preference_losses(logit, torch.full((2,), label)).sum().backward()
    assert logit.grad.tolist() == [sign, sign]


def test_smoothness_penalty_is_the_mean_squared_change_between_real_steps():
    rewards = torch.tensor([[1.0, 3.0, 3.0, 9.0], [2.0, 1.0, 0.0, 50.0]])
    mask = torch.tensor([[True, True, True, True], [True, True, False, False]])
    assert smoothness_penalty(rewards, mask).item() == pytest.approx((4 + 0 + 36 + 1) / 4)
    assert smoothness_penalty(rewards + 7, mask).item() == pytest.approx((4 + 0 + 36 + 1) / 4)


def test_segments_of_one_step_have_no_smoothness_penalty():
    assert smoothness_penalty(torch.ones(3, 1), torch.ones(3, 1, dtype=torch.bool)).item() == 0
