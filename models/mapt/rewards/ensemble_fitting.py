"""The training loop of an ensemble: every step moves every member, each on pairs of its own.

One step, from top to bottom: draw a batch for each member, score both segments of all of them in one pass, take
the Bradley-Terry loss, clip each member's gradient by itself, step one AdamW over the stacked parameters, and
move the running average of the weights, which is what is judged and kept.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mapt.preferences.loss import preference_losses
from mapt.rewards.data import PairTensors
from mapt.rewards.schedule import StageSettings
from mapt.rewards.stacked import SEGMENTS_PER_PASS, StackedModels
from mapt.rewards.trainer import (
    GRADIENT_NORM_LIMIT,
    TrainProgress,
    WeightAverage,
    adamw,
    beats_guessing,
    epoch_batches,
    is_kept,
    is_out_of_patience,
    is_reliable,
)

#: From indices of segments, (B,) or (M, B), to the members' scores of them, (M, B).
StackScorer = Callable[[Tensor], Tensor]


@dataclass(frozen=True, slots=True)
class EnsembleStage:
    """What one run of the loop trains."""

    settings: StageSettings
    #: names of the stacked parameters it moves
    names: Sequence[str]
    scorer: StackScorer
    #: values of some of them to begin with
    start: Mapping[str, Tensor] | None = None


class EnsembleFitting:
    """Trains the members of a stack, stage by stage; each ends a stage with the weights that judged best for it.

    A stage ends when the patience of all members has run out. Until then those that wait are trained on, and may yet
    find better weights.

    Args:
        resampled: whether each member learns from its own draw, with replacement, of the training pairs.
        progress: called after every epoch, with means over members.
        stop: asked before every step; true ends this stage and all that follow.
    """

    def __init__(
        self,
        stack: StackedModels,
        train: PairTensors,
        hold_out: PairTensors,
        *,
        seed: int,
        max_epochs: int,
        resampled: bool = False,
        progress: Callable[[TrainProgress], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        self._stack, self._train, self._hold_out = stack, train, hold_out
        self._average = WeightAverage([])
        self._draws = torch.Generator().manual_seed(seed)
        self._max_epochs = max_epochs
        self._progress, self._stop = progress, stop
        self._started = time.perf_counter()
        shape = len(stack), len(train)
        self._known = (
            torch.randint(len(train), shape, generator=self._draws)
            if resampled
            else torch.arange(len(train)).expand(shape)
        )
        self.epochs = 0
        self.stopped = False
        #: see `mapt.rewards.trainer.Fitting.early`
        self.early: dict[str, Tensor] | None = None

    @property
    def reliable(self) -> bool:
        """Whether the hold-out is large enough to judge by."""
        return is_reliable(self._hold_out)

    def run(self, stage: EnsembleStage) -> None:
        """Train the parameters that `stage` names, and leave the members in evaluation mode."""
        judge = self._hold_out if self.reliable else self._train
        trained = {name: self._stack.parameters[name] for name in stage.names}
        optimiser = adamw(trained.values(), stage.settings, matrix_dims=3)
        before = after = logit_losses(self._logits(judge, stage), judge.labels, stage.settings.label_noise)
        initial, kept = _copies(trained), _copies(trained)
        best, kept_at = before.mean(dim=1), torch.zeros(len(before), dtype=torch.int64, device=before.device)
        begun = torch.zeros_like(kept_at, dtype=torch.bool)
        if stage.start is not None:
            best = torch.full_like(best, math.inf)
            _write(trained, stage.start)
        self._average = WeightAverage(list(trained.values()))
        for epoch in range(1, stage.settings.max_epochs + 1):
            loss = self._epoch(stage, optimiser)
            if self.stopped:
                break
            with self._average.in_place():
                logits = self._logits(judge, stage)
                self._report(stage, loss, logits if self.reliable else self._logits(self._hold_out, stage))
                judged = logit_losses(logits, judge.labels, stage.settings.label_noise)
                better = judged.mean(dim=1) < best
                best = torch.where(better, judged.mean(dim=1), best)
                kept_at, after = torch.where(better, epoch, kept_at), torch.where(better[:, None], judged, after)
                kept = {name: where_member(better, trained[name].detach(), kept[name]) for name in trained}
                if epoch == stage.settings.remember_epoch:
                    self.early = kept
            begun |= beats_guessing(judged)
            if is_out_of_patience(stage.settings, epoch - kept_at, begun).all():
                break
        gained = is_kept(stage.settings, before, after)
        _write(trained, {name: where_member(gained, kept[name], initial[name]) for name in trained})

    def _epoch(self, stage: EnsembleStage, optimiser: torch.optim.Optimizer) -> float:
        """Mean loss of one pass over the training pairs; NaN when stopped."""
        losses: list[Tensor] = []
        self._stack.train(True)
        for index in self._batches(stage.settings.batch_pairs):
            self.stopped = self.stopped or (self._stop is not None and self._stop())
            if self.stopped:
                break
            losses.append(ensemble_step(self._train, stage.scorer, optimiser, index, stage.settings.label_noise))
            self._average.follow()
        self._stack.train(False)
        return math.nan if self.stopped else torch.stack(losses).mean().item()

    def _batches(self, batch_pairs: int) -> Iterator[Tensor]:
        """Indices (M, B) of pairs: every member sees each of its pairs once, in its own order."""
        order = torch.rand(self._known.shape, generator=self._draws).argsort(dim=1)
        yield from epoch_batches(self._known.gather(1, order).to(self._train.labels.device), batch_pairs)

    def _logits(self, pairs: PairTensors, stage: EnsembleStage) -> Tensor:
        return pair_logits(pairs, stage.scorer, len(self._stack))

    def _report(self, stage: EnsembleStage, loss: float, logits: Tensor) -> None:
        self.epochs += 1
        if self._progress is None:
            return
        labels = self._hold_out.labels
        self._progress(
            TrainProgress(
                epoch=self.epochs,
                max_epochs=self._max_epochs,
                loss=loss,
                holdout_loss=logit_losses(logits, labels, stage.settings.label_noise).mean().item(),
                holdout_accuracy=mean_accuracy(logits, labels),
                seconds=time.perf_counter() - self._started,
            )
        )


def ensemble_step(
    train: PairTensors,
    scorer: StackScorer,
    optimiser: torch.optim.Optimizer,
    index: Tensor,
    label_noise: float = 0.0,
) -> Tensor:
    """Move every member by one step on its own pairs `index` (M, B); the mean of their losses before it, nats."""
    first, second = scorer(train.pairs[index].movedim(-1, 1).flatten(1)).chunk(2, dim=1)
    # A sum over members: the gradient of each is that of its own mean loss.
    losses = preference_losses(first - second, train.labels[index], label_noise).mean(dim=1)
    optimiser.zero_grad(set_to_none=True)
    losses.sum().backward()
    clip_each_member(parameter for group in optimiser.param_groups for parameter in group["params"])
    optimiser.step()
    return losses.detach().mean()


def clip_each_member(parameters: Iterable[Tensor]) -> None:
    """Scale each member's gradient to a norm of at most `GRADIENT_NORM_LIMIT`."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    squares = torch.stack([gradient.flatten(1).square().sum(dim=1) for gradient in gradients])
    scale = (GRADIENT_NORM_LIMIT / (squares.sum(dim=0).sqrt() + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(scale.view(-1, *(1 for _ in gradient.shape[1:])))


def logit_losses(logits: Tensor, labels: Tensor, label_noise: float = 0.0) -> Tensor:
    """Loss of each pair, nats, (M, P), by logits (M, P) and labels (P,)."""
    return preference_losses(logits, labels.expand_as(logits), label_noise)


@torch.no_grad()
def pair_logits(pairs: PairTensors, scorer: StackScorer, n_members: int) -> Tensor:
    """score_0 - score_1 of every pair by each of M members, (M, P), without gradient; each segment is scored once."""
    used, position = torch.unique(pairs.pairs, return_inverse=True)
    score = torch.empty(n_members, len(used), device=used.device)
    for place in torch.arange(len(used), device=used.device).split(SEGMENTS_PER_PASS):
        score[:, place] = scorer(used[place])
    return score[:, position[:, 0]] - score[:, position[:, 1]]


def mean_accuracy(logits: Tensor, labels: Tensor) -> float:
    """Share of decided pairs told rightly, mean over members; NaN without any."""
    right = ((logits > 0) == (labels > 0.5))[:, labels != 0.5]
    return right.float().mean().item()


def where_member(chosen: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """`first` (M, ...) for the members `chosen` (M,), `second` for the others."""
    return torch.where(chosen.view(-1, *(1 for _ in first.shape[1:])), first, second)


@torch.no_grad()
def _write(parameters: Mapping[str, Tensor], values: Mapping[str, Tensor]) -> None:
    """Give those of `parameters` that have a value this value."""
    for name, value in values.items():
        parameters[name].copy_(value)


def _copies(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}
