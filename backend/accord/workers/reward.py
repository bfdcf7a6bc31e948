"""The reward worker: `python -m accord.workers.reward`. Keeps queries coming and retrains on new labels."""

import logging
import sys
from dataclasses import replace

import numpy as np

from accord.domain.words import WorkerRole
from accord.services import experiments, metrics, publish, select
from accord.store.tables import ExperimentRow, RewardVersionRow
from accord.workers.labelled import LabelledSegments
from accord.workers.loop import Context, run_worker
from accord.workers.pacing import version_is_due
from accord.workers.pulse import Claim
from accord.workers.querying import choose_pairs
from accord.workers.reward_blobs import read_reward_model, store_reward_model
from accord.workers.sentence import sentence
from mapt.preferences.dataset import PreferenceDataset
from mapt.rewards.config import RewardConfig
from mapt.rewards.errors import InvalidConfig, ModelMismatch
from mapt.rewards.network import MAPT
from mapt.rewards.train_config import TrainConfig
from mapt.rewards.trainer import TrainedReward, TrainProgress, train_reward_model

log = logging.getLogger(__name__)

#: which draws of an experiment's seed choose the queries
_QUERY_STREAM = 11
SELECTOR = "uniform"


class RewardWorker:
    """Looks after every running experiment in turn."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._segments = LabelledSegments(context.blobs)
        self._round = 0

    def work(self) -> bool:
        """Whatever one experiment needs, queries before training. False if none needs anything."""
        with self._context.database.reading() as session:
            rows = experiments.running(session)
        rows = [row for row in rows if experiments.config_of(row).reward_source == "preferences"]
        # Another one first each time: where one fails, the others still get their turn.
        self._round += 1
        first = self._round % max(1, len(rows))
        did = [self._look_after(row) for row in rows[first:] + rows[:first]]
        return any(did)

    def close(self) -> None:
        """Nothing is open between two calls of `work`."""

    def _look_after(self, row: ExperimentRow) -> bool:
        with self._context.database.reading() as session:
            wants_queries = bool(select.queries_wanted(session, row) and len(select.candidates(session, row.id, 2)) > 1)
            newest = publish.newest(session, row.id)
            changed = publish.new_labels(session, row.id, newest.label_watermark if newest else 0)
        due = version_is_due(
            experiments.config_of(row),
            labels=row.label_count,
            trained_on=newest.label_count if newest else 0,
            changed=changed,
        )
        if not wants_queries and not due:
            return False
        with self._context.pulse.hold(f"reward:{row.id}") as claim:
            if claim is None:
                return False
            did = wants_queries and self._add_queries(row.id, claim)
            try:
                return (due and self._train(row, newest, claim)) or did
            except (InvalidConfig, ModelMismatch) as error:
                # Its settings will not do the next time either.
                log.exception("Experiment %s failed", row.id)
                with self._context.database.transaction() as session:
                    claim.check_within(session)
                    experiments.fail(session, row.id, sentence(error))
                return True

    def _add_queries(self, experiment_id: str, claim: Claim) -> bool:
        """Choose the next pairs. Returns whether there were any to choose."""
        with self._context.database.transaction() as session:
            claim.check_within(session)
            row = experiments.get(session, experiment_id)
            wanted = select.queries_wanted(session, row)
            paired = select.paired(session, experiment_id)
            newest = publish.newest(session, experiment_id)
            pool = [segment_id for segment_id, _ in select.candidates(session, experiment_id)]
            rng = np.random.default_rng([experiments.config_of(row).seed, _QUERY_STREAM, len(paired)])
            pairs = choose_pairs(pool, paired, wanted, first_round=newest is None, rng=rng)
            return bool(select.add_queries(session, row, pairs, SELECTOR, newest.id if newest else None))

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
        key = store_reward_model(context.blobs, row.id, trained.model, trained.metrics)
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
        settings = experiments.config_of(row)
        preset = settings.reward_preset
        config = RewardConfig.preset(
            preset,  # pyright: ignore[reportArgumentType]  (an unknown one is refused there, with a sentence)
            observation_dim=dataset.segments.observation_dim,
            action_dim=dataset.segments.action_dim,
            n_agents=dataset.segments.n_agents,
        )
        training = replace(
            TrainConfig.preset(preset),  # pyright: ignore[reportArgumentType]
            seed=settings.seed,
            device=settings.device,
        )

        def progress(at: TrainProgress) -> None:
            self._context.pulse.say("working", f"reward version {number}: epoch {at.epoch}, {len(dataset)} labels")

        return train_reward_model(
            dataset,
            config,
            training,
            initial=self._parent(newest, config),
            progress=progress,
            stop=lambda: self._context.stop.requested or claim.lost,
        )

    def _parent(self, newest: RewardVersionRow | None, config: RewardConfig) -> MAPT | None:
        """The model to go on from, if it is of the same shape."""
        if newest is None:
            return None
        model = read_reward_model(self._context.blobs, newest.blob_key)
        return model if model.config == config else None


if __name__ == "__main__":
    sys.exit(run_worker(WorkerRole.REWARD, RewardWorker, sys.argv[1:]))
