"""Trains a reward model on labelled pairs: the stages of a version, and the trial of its attention path.

`stage_trainer.py` has the training loop, `schedule.py` plans the stages, `attention_trial.py` judges the trial.
"""

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mapt.device import resolve_device, seeded
from mapt.errors import InvalidConfig, MemberTrainingFailed, ModelMismatch
from mapt.preferences.dataset import BoolArray, PreferenceDataset, SegmentSource
from mapt.processes import ParentConnection, run_jobs
from mapt.rewards import attention_trial
from mapt.rewards.attention_trial import IN_USE, RESTART_LABELS, AttentionTrial, cross_selected, trial_metrics
from mapt.rewards.checkpoints import SavedRewardModel, load_reward_model, save_reward_model
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.data import (
    MarkovScorer,
    PairTensors,
    SegmentReader,
    check_fit,
    evenly_spaced_sample,
    network_scorer,
    network_training_scorer,
    segment_reader,
    step_rewards,
)
from mapt.rewards.kernels import resolve_precision
from mapt.rewards.metrics import calibrated_losses, confidence, counted, evaluate_logits
from mapt.rewards.model import MeanReward, RewardModel, RewardNetwork
from mapt.rewards.registry import build_reward_model
from mapt.rewards.schedule import (
    is_reliable,
    is_significant,
    markov_stage,
    n_networks,
    network_stage,
    replaces,
    start_weights,
)
from mapt.rewards.stage_trainer import RewardTrainer, Stage, TrainingLog, TrainProgress

# Training pairs from which `loss` and `accuracy` are computed.
MAX_EVALUATED_PAIRS = 500
# Activations (agent-steps times d) of one forward and backward pass on a CPU. At d = 256, passes of half to five times
# this size differ by less than 3% in speed. With 32 pairs (ten times) a step takes a third longer, with 64 twice as
# long: the C library returns their activations to the system after every pass and gets them back page by page.
ACTIVATIONS_PER_PASS = 1 << 20


@dataclass(frozen=True, slots=True)
class TrainedReward:
    """A trained model, in evaluation mode on the CPU."""

    model: RewardModel
    #: see `train_reward_model`
    metrics: dict[str, float]
    history: tuple[TrainProgress, ...]


@dataclass(frozen=True, slots=True)
class Fold:
    """Pairs to train on, and pairs to evaluate on."""

    train: PairTensors
    hold_out: PairTensors

    @property
    def is_reliable(self) -> bool:
        """Whether the hold-out is large enough to compare weights by."""
        return is_reliable(len(self.hold_out))

    @property
    def evaluated(self) -> PairTensors:
        """The pairs that weights are compared by."""
        return self.hold_out if self.is_reliable else self.train


@dataclass(frozen=True, slots=True)
class NetworkJob:
    """The training of one network of a version."""

    #: index of the fold whose pairs it holds out
    fold: int
    #: the network from which it continues; None for untrained weights
    initial: SavedRewardModel | None


@dataclass(frozen=True, slots=True)
class VersionData:
    """What a process needs to train a network of a version; see `VersionTrainer`."""

    config: RewardConfig
    train_config: TrainConfig
    pairs: PreferenceDataset
    held_out: BoolArray


class VersionTrainer:
    """Trains the networks of one version, those of the trial of its attention path among them.

    Args:
        pairs: all labelled pairs.
        held_out: bool (P,), those of the version's hold-out.
        workers: processes that train networks at the same time; 1 trains them in this process.
    """

    def __init__(
        self,
        config: RewardConfig,
        train_config: TrainConfig,
        segments: SegmentReader,
        log: TrainingLog,
        *,
        pairs: PreferenceDataset,
        held_out: BoolArray,
        workers: int = 1,
    ) -> None:
        self._config, self._settings, self._segments, self._log = config, train_config, segments, log
        self._pairs, self._held_out, self._workers = pairs, held_out, workers
        self._dtype = resolve_precision(train_config.precision, config.hidden_dim, segments.device)
        self._sample = segments.take(evenly_spaced_sample(segments)).inputs
        self._used = torch.as_tensor(np.unique(pairs.pairs), device=segments.device)
        self._n_networks = n_networks(train_config, len(pairs))
        #: the version's hold-out, and the pairs outside it in equal parts
        self.folds = [self._fold(held_out), *self._more_folds(held_out)]
        self._first = self.folds[0]
        # Whole networks that a trial trained on the folds after the first.
        self._tried = list[RewardNetwork]()
        # Whether the whole network continued from a trained one, and whether it was trained from untrained weights.
        self._warm = self._restarted = False

    def train(
        self, initial: RewardModel | None, initial_metrics: Mapping[str, float | None] | None
    ) -> tuple[list[RewardNetwork], AttentionTrial | None]:
        """The version's networks, continued from `initial` or from scratch, and the trial or review if it had one."""
        first, trial = self._first_network(initial, initial_metrics)
        if first.is_markov or not self._first.is_reliable:
            return [first], trial
        networks = [first, *self._further_networks(initial)]
        due = attention_trial.is_due(len(self._pairs), initial_metrics, self._settings.trial_growth)
        if self._config.markov_path and trial is None and due:
            return self._review(networks)
        return networks, trial

    def _first_network(
        self, initial: RewardModel | None, initial_metrics: Mapping[str, float | None] | None
    ) -> tuple[RewardNetwork, AttentionTrial | None]:
        """The network of the first fold, and its trial if it had one."""
        if initial is None:
            model = self._new_model()
            losses = self._train_markov(model, self._first)
            if not self._config.markov_path:
                self._train_network(model, self._first)
        else:
            model = self._copied(initial.networks[0])
            if (restarted := self._restart(model, initial, initial_metrics)) is not None:
                return restarted, None
            losses = self._continue(model, self._first)
        if not self._should_try(model, losses, initial_metrics):
            return model, None
        accepted, trial = self._try_attention(losses)
        return accepted or model, trial

    def _further_networks(self, initial: RewardModel | None) -> list[RewardNetwork]:
        """Whole networks of the folds after the first; fewer if stopped.

        Trained alike, networks on a few hundred labels differ by several points of accuracy, and their mean is better
        than each of them (docs/results.md, "The mean of networks").
        """
        count = min(self._n_networks, len(self.folds)) - 1
        networks = self._tried[:count]
        folds = range(len(networks) + 1, count + 1)
        if initial is not None and self._warm:
            jobs = [NetworkJob(fold, save_reward_model(initial.networks[fold], {})) for fold in folds]
        else:
            jobs = [NetworkJob(fold, None) for fold in folds]
        if self._workers > 1 and len(jobs) > 1:
            return networks + self._train_in_processes(jobs)
        for job in jobs:
            network = self.further_network(job)
            if self._log.stopped:
                break
            networks.append(network)
        return networks

    def further_network(self, job: "NetworkJob") -> RewardNetwork:
        """The whole network of a fold after the first. It does not depend on the process that trains it."""
        fold, seed = self.folds[job.fold], np.random.SeedSequence([self._settings.seed, job.fold]).generate_state(1)
        with seeded(int(seed[0]), self._segments.device):
            if job.initial is None:
                model = self._new_model()
                self._train_network(model, fold)
            else:
                model = self._copied(load_reward_model(job.initial.weights, job.initial.card).model.networks[0])
                self._continue(model, fold)
        return model

    def _train_in_processes(self, jobs: Sequence["NetworkJob"]) -> list[RewardNetwork]:
        """The networks of `jobs`, in order; fewer if stopped."""
        shared = VersionData(self._config, self._settings, self._pairs, self._held_out)
        trained = dict[int, RewardNetwork]()
        for done in run_jobs(
            partial(_train_network_in_process, shared),
            jobs,
            self._workers,
            on_message=lambda job, at: self._log.add(at.loss, at.holdout_loss, at.holdout_accuracy),
            should_stop=self._log.should_stop,
        ):
            if done.result is None:
                raise MemberTrainingFailed(done.job.fold, done.failure or "")
            network = load_reward_model(done.result.weights, done.result.card).model.networks[0]
            trained[done.job.fold] = network.to(self._segments.device)
        return [] if self._log.stopped else [trained[job.fold] for job in jobs]

    def _review(self, networks: list[RewardNetwork]) -> tuple[list[RewardNetwork], AttentionTrial | None]:
        """`networks`, or a Markov path alone if they predict held-out pairs no better; and the review.

        A trial on a hundred labels accepts attention by chance now and then, and with it a version takes ten times as
        long. Until the gain is clear, a Markov path is trained from scratch on the pairs of each network.
        """
        started, gains, paths = self._log.seconds, list[Tensor](), list[RewardNetwork]()
        accepted = True
        for fold, network in zip(self.folds, networks, strict=False):
            paths.append(self._new_model())
            losses = self._train_markov(paths[-1], fold)
            if self._log.stopped:
                return networks, None
            gains.append(losses - self._losses(network, fold))
            accepted = self._can_gain(losses, fold) and not attention_trial.is_futile(torch.cat(gains))
            if attention_trial.is_clear(torch.cat(gains)):
                break
        review = AttentionTrial(accepted, torch.cat(gains), len(self._pairs), self._log.seconds - started)
        return (networks if accepted else paths[:1]), review

    @staticmethod
    def _can_gain(losses: Tensor, fold: Fold) -> bool:
        """Whether a Markov path with these losses on a fold's evaluated pairs leaves attention something to gain."""
        return losses.mean().item() - fold.evaluated.irreducible_loss >= attention_trial.MIN_MARKOV_LOSS

    def _restart(
        self, model: RewardNetwork, initial: RewardModel, metrics: Mapping[str, float | None] | None
    ) -> RewardNetwork | None:
        """The whole network trained from untrained weights; None if not due, or significantly worse than `model`.

        Trained further and further, a network keeps what it learned from its first few labels. That the new one is
        slightly worse on a few dozen pairs is mostly chance, and the earlier one would learn nothing from new labels.
        """
        if model.is_markov or not self._first.is_reliable:
            return None
        # Of a version with fewer networks, for example of a time when there were fewer folds, not all can continue.
        incomplete = len(initial.networks) < min(self._n_networks, len(self.folds))
        due = attention_trial.is_due(len(self._pairs), metrics, self._settings.restart_growth, RESTART_LABELS)
        if not (incomplete or due):
            return None
        fresh = self._new_model()
        self._train_network(fresh, self._first)
        if incomplete:
            return fresh
        return None if is_significant(self._losses(fresh) - self._losses(model)) else fresh

    def restarted_on(self, initial_metrics: Mapping[str, float | None] | None) -> float:
        """Labels when the whole network was last trained from untrained weights; NaN if that is unknown."""
        earlier = (initial_metrics or {}).get(RESTART_LABELS)
        return float(len(self._pairs)) if self._restarted else math.nan if earlier is None else earlier

    def _continue(self, model: RewardNetwork, fold: Fold) -> Tensor:
        """Train a network further, unless the result is worse; returns its loss on each evaluated pair."""
        was_markov, weights, before = model.is_markov, copy.deepcopy(model.state_dict()), self._losses(model, fold)
        # Beside attention, new weights in the Markov path would only disturb it.
        train = self._train_markov if was_markov else self._train_network
        losses = train(model, fold, warm=True)
        if replaces(before, self._losses(model, fold), markov=was_markov):
            return losses
        model.load_state_dict(weights)
        return before

    def _should_try(
        self, model: RewardNetwork, losses: Tensor, initial_metrics: Mapping[str, float | None] | None
    ) -> bool:
        has_attention = self._config.architecture != "mlp"
        return (
            has_attention
            and model.is_markov
            and not self._log.stopped
            and self._first.is_reliable
            and self._can_gain(losses, self._first)
            and attention_trial.is_due(len(self._pairs), initial_metrics, self._settings.trial_growth)
        )

    def _try_attention(self, losses: Tensor) -> tuple[RewardNetwork | None, AttentionTrial | None]:
        """The version's whole network if a trial accepts it, and the trial; None for a trial that was stopped.

        Args:
            losses: of the version's Markov path on each pair of its hold-out.
        """
        started, gains, accepted = self._log.seconds, list[Tensor](), None
        for number, fold in enumerate(self.folds, 1):
            if number > 1:
                losses = self._train_markov(self._new_model(), fold)
            model = self._new_model()
            network_losses = self._train_network(model, fold)
            if self._log.stopped:
                return None, None
            self._tried.append(model)
            gains.append(losses - network_losses)
            accepted = attention_trial.verdict(torch.cat(gains), is_last=number == len(self.folds))
            if accepted is not None:
                break
        trial = AttentionTrial(bool(accepted), torch.cat(gains), len(self._pairs), self._log.seconds - started)
        return (self._tried.pop(0) if accepted else None), trial

    def _more_folds(self, held_out: BoolArray) -> Iterator[Fold]:
        """The folds after the first: the pairs outside its hold-out, in equal parts."""
        n_folds = self._settings.trial_folds - 1
        folds = self._pairs.folds(n_folds, self._settings.seed) if n_folds else np.empty(0, np.int64)
        for number in range(n_folds):
            fold = self._fold(~held_out & (folds == number))
            if fold.is_reliable:
                yield fold

    def _fold(self, held_out: BoolArray) -> Fold:
        train, hold_out = self._pairs.separate(held_out)
        device = self._segments.device
        return Fold(PairTensors.of(train, device), PairTensors.of(hold_out, device))

    def _copied(self, initial: RewardNetwork) -> RewardNetwork:
        """A copy of `initial` for further training."""
        model = copy.deepcopy(initial).to(self._segments.device)
        model.fit_normalisers(*self._sample, keep_function=True)
        return model.eval()

    def _new_model(self) -> RewardNetwork:
        model = build_reward_model(self._config).to(self._segments.device)
        model.fit_normalisers(*self._sample, keep_function=False)
        return model.eval()

    def _train_markov(self, model: RewardNetwork, fold: Fold, *, warm: bool = False) -> Tensor:
        """Train the Markov path alone; returns its loss on each evaluated pair, from epochs that other pairs select."""
        stage = markov_stage(self._settings, len(fold.train), warm=warm)
        if stage is None or model.markov is None:
            return self._losses(model, fold)
        scorer = MarkovScorer(model, self._segments, self._used)
        run = Stage(
            stage,
            list(model.markov.parameters()),
            scorer,
            scorer.training_scores,
            start=start_weights(stage, model),
        )
        losses = self._trainer(model, fold).run(run)
        return cross_selected((losses.before, *losses.epochs))

    def _train_network(self, model: RewardNetwork, fold: Fold, *, warm: bool = False) -> Tensor:
        """Train the whole network; returns its loss on each evaluated pair."""
        if self._log.stopped:
            return self._losses(model, fold)
        losses = self._trainer(model, fold).run(self._network_stage(model, len(fold.train), warm=warm))
        if fold is self._first:
            self._warm, self._restarted = warm, self._restarted or not warm
        return cross_selected(losses.epochs or (losses.before,))

    def _network_stage(self, model: RewardNetwork, n_pairs: int, *, warm: bool) -> Stage:
        settings = network_stage(self._settings, self._config, n_pairs, warm=warm)
        return Stage(
            settings,
            list(model.parameters()),
            network_scorer(self._segments, self._dtype),
            network_training_scorer(self._segments, self._dtype),
            start=start_weights(settings, model),
            pairs_per_pass=pairs_per_pass(self._config, self._segments),
        )

    def _trainer(self, model: RewardNetwork, fold: Fold) -> RewardTrainer:
        return RewardTrainer(model, fold.train, fold.hold_out, seed=self._settings.seed, log=self._log)

    def _losses(self, model: RewardModel, fold: Fold | None = None) -> Tensor:
        """The calibrated loss of each evaluated pair (P,)."""
        evaluated = (fold or self._first).evaluated
        logits = evaluated.logits(model.eval(), network_scorer(self._segments, self._dtype))
        return calibrated_losses(logits, evaluated.labels, self._settings.label_noise, evaluated.weights)


def _train_network_in_process(data: VersionData, job: NetworkJob, parent: ParentConnection) -> SavedRewardModel:
    trainer = VersionTrainer(
        data.config,
        data.train_config,
        segment_reader(data.pairs.segments, resolve_device(data.train_config.device)),
        TrainingLog(parent.send, parent.cancelled),
        pairs=data.pairs,
        held_out=data.held_out,
    )
    return save_reward_model(trainer.further_network(job), {})


def train_reward_model(
    dataset: PreferenceDataset,
    config: RewardConfig,
    train_config: TrainConfig,
    *,
    initial: RewardModel | None = None,
    initial_metrics: Mapping[str, float | None] | None = None,
    hold_out: PreferenceDataset | None = None,
    reference: SegmentSource | None = None,
    workers: int = 1,
    progress: Callable[[TrainProgress], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> TrainedReward:
    """Train the model of `config` on labelled pairs. On one machine, equal arguments give equal models.

    Args:
        dataset: at least two labelled pairs. Large sets of segments on disk are read batch by batch.
        config: the network; its dimensions must be the dataset's.
        initial: a model with the same `config` to continue from, for at most `warm_markov_epochs` and `warm_epochs`;
            it is not changed.
        initial_metrics: the metrics of `initial`, which say when its attention path was last tried.
        hold_out: pairs of the same segments to evaluate on; by default a fraction of `dataset` is held out.
        reference: segments over which rewards are normalised (`RewardModel.normalised`); default: the dataset's own.
        workers: processes that train the networks of a version at the same time, if attention is in use; 1 trains them
            one after the other in this process. The result is the same.
        progress: called after every epoch.
        stop: called before every step; true ends the training with the best weights so far.

    Returns:
        The model and its metrics: `loss` and `accuracy` on the first 500 training pairs; `holdout_loss`,
        `holdout_accuracy` and `ece` on held-out pairs, each judged by the network that was not trained on it; `epochs`,
        `seconds`, `labels`, `holdout_labels`, `holdout_strict_labels` (those that are `counted` and not ties, over
        which accuracy is measured), `holdout_reliable` (1 if the hold-out was large enough to compare weights by, else
        0), `networks` (those whose mean the model is), `stopped` (1 if `stop` ended the training), and those of
        `attention_trial`. Losses are means by the labels' weights. Undefined metrics, such as the accuracy over ties
        alone, are left out.

    Raises:
        InvalidConfig: if `workers` is less than 1.
        NotEnoughPairs: with fewer than two pairs.
        ModelMismatch: if the dimensions of dataset, config and `initial` differ.
        MemberTrainingFailed: if a worker process ends without a network.
    """
    if workers < 1:
        raise InvalidConfig(f"workers is {workers}; it must be 1 or more.", "workers")
    check_fit(config, dataset.segments)
    if initial is not None and initial.config != config:
        raise ModelMismatch("settings of the initial model", config, initial.config)
    device, log = resolve_device(train_config.device), TrainingLog(progress, stop)
    segments = segment_reader(dataset.segments, device)
    if hold_out is None:
        pairs, held_out = dataset, dataset.held_out(train_config.hold_out_fraction, train_config.seed)
    else:
        pairs, held_out = dataset.joined(hold_out), np.arange(len(dataset) + len(hold_out)) >= len(dataset)
    with seeded(train_config.seed, device):
        trainer = VersionTrainer(config, train_config, segments, log, pairs=pairs, held_out=held_out, workers=workers)
        networks, trial = trainer.train(initial, initial_metrics if initial is not None else None)
    # Each pair that was held out is evaluated with the network that was not trained on it.
    scorer, held = network_scorer(segments), [fold.hold_out for fold in trainer.folds[: len(networks)]]
    labels, weights = torch.cat([each.labels for each in held]), PairTensors.joined_weights(held)
    logits = torch.cat([each.logits(network, scorer) for each, network in zip(held, networks, strict=True)])
    if trainer.folds[0].is_reliable:
        factor = confidence(logits, labels, train_config.label_noise, weights)
        logits = factor * logits
        for network in networks:
            network.scale_rewards(factor)
    model = MeanReward(networks).eval() if len(networks) > 1 else networks[0]
    scaled = segments if reference is None else segment_reader(reference, device)
    rewards = step_rewards(model, scaled, evenly_spaced_sample(scaled))
    mean = float(rewards.mean()) if train_config.subtract_mean else 0.0
    model.set_reward_scale(mean, float(rewards.std()))
    train = trainer.folds[0].train.first(MAX_EVALUATED_PAIRS)
    on_train = evaluate_logits(train.logits(model, scorer), train.labels, train_config.label_noise, train.weights)
    on_hold_out = evaluate_logits(logits, labels, train_config.label_noise, weights)
    metrics = {
        "loss": on_train.loss,
        "accuracy": on_train.accuracy,
        "holdout_loss": on_hold_out.loss,
        "holdout_accuracy": on_hold_out.accuracy,
        "ece": on_hold_out.calibration_error,
        "epochs": float(len(log.history)),
        "labels": float(len(pairs)),
        "holdout_labels": float(len(labels)),
        "holdout_strict_labels": float((counted(labels, weights) & (labels != 0.5)).sum()),
        "holdout_reliable": float(trainer.folds[0].is_reliable),
        "networks": float(len(networks)),
        "stopped": float(log.stopped),
        **trial_metrics(trial, initial_metrics),
        # MA-LSTM has no attention that could be in use.
        IN_USE: math.nan if config.architecture == "lstm" else float(not model.is_markov),
        RESTART_LABELS: math.nan if model.is_markov else trainer.restarted_on(initial_metrics),
        "seconds": log.seconds,
    }
    defined = {name: value for name, value in metrics.items() if math.isfinite(value)}
    return TrainedReward(model.cpu(), defined, tuple(log.history))


def pairs_per_pass(config: RewardConfig, segments: SegmentReader) -> int | None:
    """Most pairs of segments in a forward and backward pass of the whole network; None for a whole batch, on a GPU."""
    if segments.device.type != "cpu":
        return None
    activations_per_pair = 2 * config.n_agents * segments.n_steps * config.hidden_dim
    return max(1, ACTIVATIONS_PER_PASS // activations_per_pair)
