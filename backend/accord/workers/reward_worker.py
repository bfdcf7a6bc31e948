"""The reward worker: `python -m accord.workers.reward_worker`. Creates queries and retrains on new labels."""

import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from accord.domain.enums import WorkerRole
from accord.services import experiments, metrics, publish, select
from accord.services.collect import load_arrays
from accord.services.experiment_config import ExperimentConfig
from accord.services.publish import TrainingLabel
from accord.store.blobs import BlobStore
from accord.store.tables import ExperimentRow, RewardVersionRow
from accord.workers.heartbeat import Claim
from accord.workers.model_store import Ensembles, read_reward_model, store_reward_model
from accord.workers.pacing import version_is_due
from accord.workers.query_planner import Asker, wants_ensemble
from accord.workers.runner import Context, run_worker, sentence
from mapt.errors import InvalidConfig, ModelMismatch, UnknownSelector
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.ensemble import train_reward_ensemble
from mapt.rewards.model import RewardModel
from mapt.rewards.trainer import TrainedReward, TrainProgress, train_reward_model

_Arrays = tuple[NDArray[np.float32], NDArray[np.float32]]


class LabelledSegments:
    """Keeps the arrays of one experiment in memory between two trainings: 20 kB a segment, two segments a label."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs
        self._experiment_id = ""
        #: blob key -> observations (T, N, C) and actions (T, N, A)
        self._arrays: dict[str, _Arrays] = {}

    def dataset(self, experiment_id: str, labels: Sequence[TrainingLabel]) -> PreferenceDataset:
        """The labels with their segments, each segment once, in the order of its first label.

        Raises:
            BlobMissing: if a segment's arrays are gone.
        """
        if experiment_id != self._experiment_id:
            self._experiment_id, self._arrays = experiment_id, {}
        keys = [key for label in labels for key in (label.segment_0_blob, label.segment_1_blob)]
        place = {key: index for index, key in enumerate(dict.fromkeys(keys))}
        arrays = [self._read(key) for key in place]
        segments = SegmentArrays.stack([each[0] for each in arrays], [each[1] for each in arrays])
        pairs = np.array([place[key] for key in keys]).reshape(-1, 2)
        return PreferenceDataset(segments, pairs, np.array([label.value for label in labels], dtype=np.float32))

    def _read(self, key: str) -> _Arrays:
        if key not in self._arrays:
            arrays = load_arrays(self._blobs, key)
            self._arrays[key] = arrays["observations"].astype(np.float32), arrays["actions"].astype(np.float32)
        return self._arrays[key]


log = logging.getLogger(__name__)


class RewardWorker:
    """Looks after every running experiment in turn."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._segments = LabelledSegments(context.blobs)
        self._ensembles = Ensembles(context.blobs)
        self._asker = Asker(context, self._ensembles)
        self._round = 0

    def work(self) -> bool:
        """Whatever one experiment needs, queries before training. False if none needs anything."""
        with self._context.database.reading() as session:
            rows = experiments.running(session)
        rows = [row for row in rows if experiments.config_of(row).reward_source == "preferences"]
        self._asker.forget_all_but({row.id for row in rows})
        # Another one first each time: where one fails, the others still get their turn.
        self._round += 1
        first = self._round % max(1, len(rows))
        did = [self._look_after(row) for row in rows[first:] + rows[:first]]
        return any(did)

    def close(self) -> None:
        """Nothing is open between two calls of `work`."""

    def _look_after(self, row: ExperimentRow) -> bool:
        config = experiments.config_of(row)
        with self._context.database.reading() as session:
            wants_queries = bool(select.queries_wanted(session, row) and len(select.askable(session, row.id, 2)) > 1)
            newest = publish.newest(session, row.id)
            changed = publish.new_labels(session, row.id, newest.label_watermark if newest else 0)
            # once the last query is made, there is nothing to choose
            chooses = wants_ensemble(config) and select.queries_left(session, row) > 0
        due = version_is_due(
            config, labels=row.label_count, trained_on=newest.label_count if newest else 0, changed=changed
        )
        unscored = newest if newest and chooses and not self._ensembles.has(newest) else None
        if not (wants_queries or due or unscored):
            return False
        with self._context.pulse.hold(f"reward:{row.id}") as claim:
            if claim is None:
                return False
            try:
                did = wants_queries and self._asker.add_queries(row.id, claim)
                # The policy may wait for a version; queries can be chosen without the newest one's ensemble.
                if due:
                    return self._train(row, newest, claim) or did
                return (unscored is not None and self._train_ensemble(row, unscored, claim)) or did
            except (InvalidConfig, ModelMismatch, UnknownSelector) as error:
                # Its settings will not do the next time either.
                log.exception("Experiment %s failed", row.id)
                with self._context.database.transaction() as session:
                    claim.check_within(session)
                    experiments.fail(session, row.id, sentence(error))
                return True

    def _train(self, row: ExperimentRow, newest: RewardVersionRow | None, claim: Claim) -> bool:
        """Train the next version on all labels, warm from the newest, and publish it."""
        context, number = self._context, (newest.number if newest else 0) + 1
        context.pulse.say("working", f"reward version {number}: reads the labels")
        with context.database.reading() as session:
            labels = publish.training_labels(session, row.id)
        if len(labels.items) < 2:
            return False
        dataset = self._segments.dataset(row.id, labels.items)
        trained = self._fit(row, dataset, newest, claim, number)
        if trained.metrics["stopped"]:
            claim.check()
            return False
        key = store_reward_model(context.blobs, row.id, trained.model, trained.metrics, dataset.segments.n_steps)
        with context.database.transaction() as session:
            claim.check_within(session)
            steps = experiments.get(session, row.id).steps
            version = publish.publish(
                session,
                row.id,
                key,
                label_watermark=labels.watermark,
                label_count=len(labels.items),
                policy_steps=steps,
                metrics=trained.metrics,
            )
            shown = {
                name: trained.metrics[name] for name in ("holdout_accuracy", "holdout_loss") if name in trained.metrics
            }
            metrics.record(session, row.id, steps, shown, version.id)
        return True

    def _fit(
        self,
        row: ExperimentRow,
        dataset: PreferenceDataset,
        newest: RewardVersionRow | None,
        claim: Claim,
        number: int,
    ) -> TrainedReward:
        config, training = _plans(experiments.config_of(row), dataset)
        return train_reward_model(
            dataset,
            config,
            training,
            initial=self._parent(newest, config),
            progress=self._reporting(row.id, claim, f"reward version {number}", len(dataset)),
            stop=lambda: self._context.stop.requested or claim.lost,
        )

    def _train_ensemble(self, row: ExperimentRow, version: RewardVersionRow, claim: Claim) -> bool:
        """Train the ensemble of a published version, on its labels, and store it."""
        with self._context.database.reading() as session:
            labels = publish.version_labels(session, version)
            parents = [each for each in publish.versions(session, row.id) if each.id == version.parent_id]
        if len(labels) < 2:
            return False
        settings = experiments.config_of(row)
        dataset = self._segments.dataset(row.id, labels)
        config, training = _plans(settings, dataset)
        before = self._ensembles.of(parents[0]) if parents else None
        fits = before is not None and before.config == config and len(before) == settings.ensemble_members
        ensemble = train_reward_ensemble(
            dataset,
            config,
            training,
            settings.ensemble_members,
            initial=before if fits else None,
            progress=self._reporting(row.id, claim, f"ensemble of reward version {version.number}", len(dataset)),
            stop=lambda: self._context.stop.requested or claim.lost,
        )
        claim.check()
        if ensemble.metrics["stopped"]:
            return False
        self._ensembles.store(version, ensemble)
        return True

    def _reporting(self, experiment_id: str, claim: Claim, what: str, n_labels: int) -> Callable[[TrainProgress], None]:
        """Says on the page where a training is, and keeps queries coming meanwhile: no labeller waits for it."""

        def report(at: TrainProgress) -> None:
            self._context.pulse.say("working", f"{what}: epoch {at.epoch}, {n_labels} labels")
            self._asker.add_queries(experiment_id, claim)

        return report

    def _parent(self, newest: RewardVersionRow | None, config: RewardConfig) -> RewardModel | None:
        """The model to go on from, if it is of the same shape."""
        if newest is None:
            return None
        model = read_reward_model(self._context.blobs, newest.blob_key)
        return model if model.config == config else None


def _plans(settings: ExperimentConfig, dataset: PreferenceDataset) -> tuple[RewardConfig, TrainConfig]:
    """The network and its training.

    Raises:
        InvalidConfig: if the model or the preset is none that this version knows.
    """
    config = RewardConfig.named(
        settings.reward_model,
        settings.reward_preset,
        observation_dim=dataset.segments.observation_dim,
        action_dim=dataset.segments.action_dim,
        n_agents=dataset.segments.n_agents,
    )
    training = TrainConfig.preset(settings.reward_preset)
    training = replace(training, seed=settings.seed, device=settings.device, label_noise=settings.label_noise)
    return config, training


if __name__ == "__main__":
    sys.exit(run_worker(WorkerRole.REWARD, RewardWorker, sys.argv[1:]))
