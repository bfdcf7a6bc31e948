"""How reliable each of several labellers is, estimated from their labels, and the weight of these in training.

In the model of Dawid and Skene (1979), one of the two segments of a pair is better, and each labeller has a probability
of each answer for either case. Expectation maximisation alternates between the pairs' better segments and these
probabilities. This differs from the paper in three points:

- Answers are those that the labeller saw (left, equal, right), so that a preference for one side shows.
- Pseudo-counts stand for what is known of people before they have labelled anything (Paun et al., 2018), so that few
  labels do not swing an estimate.
- A model of the segments may take part as a further labeller (Raykar et al., 2010, train it jointly), so that people
  who share no pair can be compared.

No library is used: crowd-kit 1.4 requires transformers, nltk, scikit-learn and pandas, and its estimator knows neither
sides nor priors nor a model.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.errors import ShapeError
from mapt.preferences.dataset import FloatArray, IntArray, PreferenceDataset, SegmentSource, in_batches

Float64s = NDArray[np.float64]

#: Columns of a confusion matrix.
LEFT, EQUAL, RIGHT = 0, 1, 2
#: What is assumed of a labeller before the first label: the accuracy of strict answers, the share of equal ones, and
#: how many labels this counts as for each of the two cases.
PRIOR_ACCURACY, PRIOR_EQUAL, PRIOR_LABELS = 0.8, 0.1, 5.0
#: The same of the model, which is trained on the labels under test, and of answers that are known.
MODEL_ACCURACY, MODEL_LABELS = 0.7, 2.0
KNOWN_ACCURACY, KNOWN_LABELS = 0.99, 1000.0
_MAX_ITERATIONS, _TOLERANCE = 500, 1e-5
_FOLDS = 5
#: Precision of the prior of the linear model's weights; features have unit variance.
_RIDGE = 300.0
_SEGMENTS_AT_ONCE = 256


@dataclass(frozen=True, slots=True)
class LabellerAnswers:
    """Who gave which label on which pair.

    Raises:
        ShapeError: if the arrays differ in length.
    """

    #: int (L,), the pair of each label, in [0, P)
    pairs: IntArray
    #: float32 (L,), P(segment 0 preferred)
    labels: FloatArray
    #: int (L,), who gave each label, in [0, J)
    labellers: IntArray
    #: int (L,), the segment, 0 or 1, that was on the left
    left_segments: IntArray

    def __post_init__(self) -> None:
        for name in ("labels", "labellers", "left_segments"):
            if getattr(self, name).shape != self.pairs.shape:
                raise ShapeError(name, getattr(self, name).shape, f"{self.pairs.shape}")

    def __len__(self) -> int:
        return len(self.pairs)

    @property
    def shown(self) -> IntArray:
        """Each answer as the labeller saw it: `LEFT`, `EQUAL` or `RIGHT`, int (L,)."""
        prefers_left = np.where(self.left_segments == 0, self.labels, 1 - self.labels)
        return np.where(prefers_left > 0.5, LEFT, np.where(prefers_left < 0.5, RIGHT, EQUAL))


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """The estimates of J labellers."""

    #: P(answer | better side), float64 (J, 2, 3): rows left and right, columns `LEFT`, `EQUAL`, `RIGHT`
    confusion: Float64s
    #: weight in training of an answer, float64 (J, 3), in [0, 1]; the most reliable labeller's best answer has 1
    answer_weights: Float64s
    #: weight of each label, float32 (L,)
    weights: FloatArray

    @property
    def accuracy(self) -> Float64s:
        """P(the better side is preferred | a strict answer), when either side is equally often better, (J,)."""
        right = self.confusion[:, 0, LEFT] + self.confusion[:, 1, RIGHT]
        return right / (right + self.confusion[:, 0, RIGHT] + self.confusion[:, 1, LEFT])


def estimate_reliability(
    answers: LabellerAnswers,
    n_labellers: int,
    model_logits: Float64s | None = None,
    known: Float64s | None = None,
) -> Reliability:
    """Estimate the confusion matrix of every labeller, and the weights of their labels.

    The weight of a strict answer is 2 q - 1, where q is the probability that it is right; it is 0 for an answer that is
    more often wrong than right, and relative to the highest weight of any labeller. That of an equal answer is the mean
    weight of the labeller's strict answers; who gives more equal answers than is usual has them reduced to as many. One
    labeller, who can be compared with nobody, has weight 1.

    Args:
        answers: every label.
        n_labellers: J.
        model_logits: log odds that segment 0 is better, (P,), from a model that was not trained on the pair's labels;
            NaN for a pair without.
        known: 1 where segment 0 is known to be better, 0 where segment 1 is, otherwise NaN, (P,).
    """
    confusion = _confusion(answers, n_labellers, model_logits, known)
    shown = answers.shown
    if n_labellers < 2:
        return Reliability(confusion, np.ones((n_labellers, 3)), np.ones(len(answers), dtype=np.float32))
    by_answer = np.zeros((n_labellers, 3))
    strict = confusion[:, 0, [LEFT, RIGHT]] - confusion[:, 1, [LEFT, RIGHT]]
    strict = strict * (1, -1) / (confusion[:, 0, [LEFT, RIGHT]] + confusion[:, 1, [LEFT, RIGHT]])
    by_answer[:, [LEFT, RIGHT]] = np.maximum(strict, 0)
    by_answer[:, EQUAL] = by_answer[:, [LEFT, RIGHT]].mean(axis=1) * _equal_factor(
        shown, answers.labellers, n_labellers
    )
    by_answer /= max(by_answer.max(), 1e-9)
    return Reliability(confusion, by_answer, by_answer[answers.labellers, shown].astype(np.float32))


def _confusion(
    answers: LabellerAnswers, n_labellers: int, model_logits: Float64s | None, known: Float64s | None
) -> Float64s:
    """P(answer | better side) of each labeller, (J, 2, 3)."""
    votes = [np.stack((answers.pairs, answers.labellers, answers.shown, answers.left_segments))]
    priors = [_prior(PRIOR_ACCURACY, PRIOR_LABELS)] * n_labellers
    if model_logits is not None and np.isfinite(model_logits).any():
        # The model's less and its more certain half are two labellers, each with an accuracy of its own.
        given = np.flatnonzero(np.isfinite(model_logits))
        certain = np.abs(model_logits[given]) > np.median(np.abs(model_logits[given]))
        votes.append(_votes(given, n_labellers + certain, model_logits[given] > 0))
        priors += [_prior(MODEL_ACCURACY, MODEL_LABELS)] * 2
    if known is not None:
        given = np.flatnonzero(np.isfinite(known))
        votes.append(_votes(given, np.full(len(given), len(priors)), known[given] > 0.5))
        priors.append(_prior(KNOWN_ACCURACY, KNOWN_LABELS))
    pairs, labellers, shown, left = np.concatenate(votes, axis=1)
    # The classes of a pair are "segment 0 is better" and "segment 1 is better"; the rows of a matrix are sides.
    rows = np.stack((left, 1 - left), axis=1)
    # Which segment is number 0 is arbitrary, so that both classes are equally likely.
    found = dawid_skene(pairs, labellers, shown, np.stack(priors), rows=rows, class_probabilities=np.full(2, 0.5))
    return found.confusion[:n_labellers]


def _votes(pairs: IntArray, labellers: IntArray, first: NDArray[np.bool_]) -> IntArray:
    """Pair, labeller, answer and left segment of votes for segment 0, where `first`, or segment 1, (4, L)."""
    return np.stack((pairs, labellers, np.where(first, LEFT, RIGHT), np.zeros_like(pairs)))


@dataclass(frozen=True, slots=True, eq=False)
class DawidSkene:
    """The result of `dawid_skene`."""

    #: P(answer | row), float64 (J, K, A)
    confusion: Float64s
    #: P(class) of each item, float64 (I, K)
    classes: Float64s
    #: P(class), float64 (K,)
    class_probabilities: Float64s


def dawid_skene(
    items: IntArray,
    observers: IntArray,
    answers: IntArray,
    prior: Float64s,
    *,
    rows: IntArray | None = None,
    class_probabilities: Float64s | None = None,
    start: Float64s | None = None,
) -> DawidSkene:
    """The classes of I items and the confusion matrices of J observers (Dawid and Skene, 1979, section 3).

    Args:
        items, observers, answers: of each of L observations, int (L,), in [0, I), [0, J) and [0, A). An observer may
            observe an item several times.
        prior: pseudo-counts, float64 (J, K, A); zeros give the paper's maximum-likelihood estimate.
        rows: the row of the observer's matrix that each class of the item means in each observation, int (L, K); by
            default row k for class k.
        class_probabilities: (K,); estimated if None.
        start: classes to start with, (I, K); by default those that the prior's matrices give.
    """
    n_classes, n_items = prior.shape[1], int(items.max(initial=-1)) + 1
    rows = np.tile(np.arange(n_classes), (len(items), 1)) if rows is None else rows
    at = observers[:, None], rows, answers[:, None]
    probabilities = np.full(n_classes, 1 / n_classes) if class_probabilities is None else class_probabilities
    confusion = _normalised(prior)
    classes = np.full((n_items, n_classes), 1 / n_classes) if start is None else start
    for iteration in range(_MAX_ITERATIONS):
        if iteration or start is None:
            with np.errstate(divide="ignore"):
                log_odds = np.tile(np.log(probabilities), (n_items, 1))
                np.add.at(log_odds, items, np.log(confusion[at]))
            classes = _normalised(np.exp(log_odds - log_odds.max(axis=1, keepdims=True)))
        counts = prior.copy()
        np.add.at(counts, at, classes[items])
        before, confusion = confusion, _normalised(counts)
        if class_probabilities is None:
            probabilities = classes.mean(axis=0)
        if np.abs(confusion - before).max(initial=0) < _TOLERANCE:
            break
    return DawidSkene(confusion, classes, probabilities)


def _normalised(counts: Float64s) -> Float64s:
    """`counts` divided by their sum over the last axis; equal shares where it is 0."""
    totals = counts.sum(axis=-1, keepdims=True)
    return np.where(totals > 0, counts / np.where(totals > 0, totals, 1), 1 / counts.shape[-1])


def _prior(accuracy: float, labels: float) -> Float64s:
    """Pseudo-counts of a labeller, (2, 3)."""
    right, wrong = accuracy * (1 - PRIOR_EQUAL), (1 - accuracy) * (1 - PRIOR_EQUAL)
    return labels * np.array([[right, PRIOR_EQUAL, wrong], [wrong, PRIOR_EQUAL, right]])


def _equal_factor(shown: IntArray, labellers: IntArray, n_labellers: int) -> Float64s:
    """The share of equal answers that is usual over the labeller's own share, at most 1, (J,).

    Usual is what the other labellers give, and `PRIOR_EQUAL` in any case.
    """
    given = np.bincount(labellers, minlength=n_labellers)
    equal = np.bincount(labellers[shown == EQUAL], minlength=n_labellers)
    own, others = (
        (part + PRIOR_LABELS * PRIOR_EQUAL) / (whole + PRIOR_LABELS)
        for part, whole in ((equal, given), (equal.sum() - equal, given.sum() - given))
    )
    return np.minimum(1, np.maximum(others, PRIOR_EQUAL) / own)


def cross_fitted_logits(dataset: PreferenceDataset) -> Float64s:
    """Log odds that segment 0 is preferred, (P,), by linear models that were not trained on the pair.

    A Bradley-Terry model of the mean and standard deviation of every observation and action over a segment, with a
    Gaussian prior, trained on four fifths of the pairs at a time. It takes milliseconds, and need not be a good reward:
    `estimate_reliability` estimates its accuracy, too.
    """
    features = _segment_features(dataset.segments)
    differences = features[dataset.pairs[:, 0]] - features[dataset.pairs[:, 1]]
    labels, folds = dataset.labels.astype(np.float64), dataset.folds(_FOLDS, 0)
    logits = np.zeros(len(dataset))
    for fold in range(_FOLDS):
        inside = folds == fold
        logits[inside] = differences[inside] @ _logistic_weights(differences[~inside], labels[~inside])
    return logits


def _segment_features(segments: SegmentSource) -> Float64s:
    """Mean and standard deviation over time of observations and actions, standardised, (S, F)."""
    parts: list[Float64s] = []
    for batch in in_batches(segments, _SEGMENTS_AT_ONCE):
        steps = np.concatenate((batch.observations, batch.actions), axis=3).astype(np.float64)
        real = np.where(batch.mask[:, :, None, None], steps, 0.0)
        n_steps = batch.mask.sum(axis=1)[:, None, None]
        mean = real.sum(axis=1) / n_steps
        deviation = np.sqrt(np.maximum(np.square(real).sum(axis=1) / n_steps - np.square(mean), 0))
        parts.append(np.concatenate((mean, deviation), axis=2).reshape(len(batch), -1))
    features = np.concatenate(parts)
    return (features - features.mean(axis=0)) / np.maximum(features.std(axis=0), 1e-6)


def _logistic_weights(differences: Float64s, labels: Float64s) -> Float64s:
    """The weights (F,) of the most likely linear model, by Newton's method."""
    weights = np.zeros(differences.shape[1])
    for _ in range(20):
        predicted = 1 / (1 + np.exp(-differences @ weights))
        curvature = (differences * (predicted * (1 - predicted))[:, None]).T @ differences
        gradient = differences.T @ (labels - predicted) - _RIDGE * weights
        step = np.linalg.solve(curvature + _RIDGE * np.eye(len(weights)), gradient)
        weights = weights + step
        if np.abs(step).max(initial=0) < _TOLERANCE:
            break
    return weights
