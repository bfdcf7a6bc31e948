"""Creates queries: reads how many are needed, scores segments if necessary, chooses pairs and writes their rows.

Runs in a thread of the reward worker's process, under its own claim on each experiment, so that labellers never wait
for a training to end.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from sqlalchemy.orm import Session

from accord.domain.errors import BlobUnreadable
from accord.services import experiments, publish, select
from accord.services.collect import load_arrays
from accord.services.experiment_config import ExperimentConfig
from accord.store.tables import RewardVersionRow
from accord.workers.heartbeat import Claim
from accord.workers.model_store import EnsembleStore
from accord.workers.runner import Context, error_sentence
from mapt.errors import UnknownSelector
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import (
    ChosenPair,
    SegmentView,
    SelectorName,
    needs_ensemble,
    needs_features,
    needs_view,
)
from mapt.rewards.ensemble import RewardEnsemble
from mapt.training.pair_selection import SCORED_SEGMENTS, SegmentScorer, candidate_limit, choose_pairs, newest_pairs
from mapt.training.schedule import QUERY_STREAM

log = logging.getLogger(__name__)

#: ensembles kept in memory, over all experiments
_KEPT_ENSEMBLES = 4


@dataclass(frozen=True, slots=True)
class _Candidates:
    """The rows that a choice of pairs depends on, read in one transaction."""

    config: ExperimentConfig
    wanted: int
    #: newest first
    segment_ids: list[str]
    #: pairs that have a query
    paired: set[frozenset[str]]
    #: the newest first, at most two
    versions: list[RewardVersionRow]
    #: the newest of these pairs, if the selector needs features
    newest_pairs: Sequence[tuple[str, str]]
    #: segment id -> blob key, for segments whose arrays are needed
    blob_keys: dict[str, str]


class QueryPlanner:
    """Keeps the wanted number of queries open in every running experiment."""

    def __init__(self, context: Context, ensembles: EnsembleStore) -> None:
        self._context = context
        self._ensembles = ensembles
        #: by version id, least recently used first
        self._loaded: dict[str, RewardEnsemble] = {}
        self._scorers: dict[str, SegmentScorer[str]] = {}

    def work(self) -> bool:
        """Create the queries that are wanted. Returns whether there were any."""
        with self._context.database.reading() as session:
            rows = experiments.running(session)
            ids = [row.id for row in rows if experiments.config_of(row).reward_source == "preferences"]
        self._scorers = {id: scorer for id, scorer in self._scorers.items() if id in ids}
        did = [self._plan(id) for id in ids]
        return any(did)

    def close(self) -> None:
        """Nothing stays open between two calls of `work`."""

    def _plan(self, experiment_id: str) -> bool:
        with self._context.database.reading() as session:
            row = experiments.get(session, experiment_id)
            if (
                not select.queries_to_add(session, row)
                or len(select.selectable_segments(session, experiment_id, 2)) < 2
            ):
                return False
        with self._context.heartbeat.claim(f"queries:{experiment_id}") as claim:
            if claim is None:
                return False
            try:
                return self._add_queries(experiment_id, claim)
            except UnknownSelector as error:
                # Another version of Accord stored this setting; a retry would fail again.
                log.exception("Experiment %s failed", experiment_id)
                with self._context.database.transaction() as session:
                    claim.check_within(session)
                    experiments.fail(session, experiment_id, error_sentence(error))
                return True

    def _add_queries(self, experiment_id: str, claim: Claim) -> bool:
        """Choose the next pairs and write their rows. Returns whether any were added.

        Raises:
            ClaimLost: if another worker holds the claim.
        """
        with self._context.database.reading() as session:
            found = _read_candidates(session, experiment_id)
        if found is None:
            return False
        # Segments are read and scored outside any transaction, so that no label waits for it.
        try:
            view, version = self._view(experiment_id, found)
        except BlobUnreadable:
            log.exception("The next queries of experiment %s are chosen without their segments' arrays", experiment_id)
            view, version = None, None
        chosen = choose_pairs(
            found.segment_ids,
            found.paired,
            found.wanted,
            selector=found.config.query_selection,
            control_share=found.config.control_share,
            view=view,
            first_round=not found.versions,
            rng=np.random.default_rng([found.config.seed, QUERY_STREAM, len(found.paired)]),
        )
        added = 0
        with self._context.database.transaction() as session:
            claim.check_within(session)
            row = experiments.get(session, experiment_id)
            if select.queries_to_add(session, row) == 0:
                return False  # paused or ended meanwhile
            for name, group in groupby(chosen, key=_selector_of):
                scored_by = version.id if version is not None and needs_ensemble(name) else None
                added += len(select.add_queries(session, row, [each.pair for each in group], name, scored_by))
        return added > 0

    def _view(self, experiment_id: str, found: _Candidates) -> tuple[SegmentView | None, RewardVersionRow | None]:
        """What the selector needs of the newest segments, and the version whose ensemble scored them."""
        name = found.config.query_selection
        if not found.blob_keys:
            return None, None
        scorer = self._scorers.setdefault(experiment_id, SegmentScorer(self._read))
        keys = [found.blob_keys[id] for id in found.segment_ids[:SCORED_SEGMENTS]]
        pairs = None
        if needs_features(name):
            pairs = [(found.blob_keys[first], found.blob_keys[second]) for first, second in found.newest_pairs]
        if not needs_ensemble(name):
            return scorer.view(keys, "", None, pairs), None
        # Until the newest version has its ensemble, that of its parent is used.
        loaded = ((each, self._ensemble(each)) for each in found.versions)
        version, ensemble = next((each for each in loaded if each[1] is not None), (None, None))
        if version is None or ensemble is None:
            return None, None
        device = found.config.device
        return scorer.view(keys, version.id, lambda segments: ensemble.scores(segments, device), pairs), version

    def _read(self, blob_keys: Sequence[str]) -> SegmentArrays:
        """Raises BlobMissing, BlobDamaged."""
        arrays = [load_arrays(self._context.blobs, key) for key in blob_keys]
        return SegmentArrays.stack([each["observations"] for each in arrays], [each["actions"] for each in arrays])

    def _ensemble(self, version: RewardVersionRow) -> RewardEnsemble | None:
        ensemble = self._loaded.pop(version.id, None) or self._ensembles.load(version)
        if ensemble is not None:
            self._loaded[version.id] = ensemble
            while len(self._loaded) > _KEPT_ENSEMBLES:
                del self._loaded[next(iter(self._loaded))]
        return ensemble


def _read_candidates(session: Session, experiment_id: str) -> _Candidates | None:
    """None if no query is wanted, or there are too few segments."""
    row = experiments.get(session, experiment_id)
    config = experiments.config_of(row)
    wanted = select.queries_to_add(session, row)
    if not wanted:
        return None
    segment_ids = select.selectable_segments(session, experiment_id, candidate_limit(config.query_selection))
    if len(segment_ids) < 2:
        return None
    paired = select.existing_pairs(session, experiment_id)
    versions = publish.versions(session, experiment_id)[:-3:-1]
    needed: list[str] = []
    newest: Sequence[tuple[str, str]] = ()
    if versions and needs_view(config.query_selection):
        newest = newest_pairs(paired) if needs_features(config.query_selection) else ()
        needed = [*segment_ids[:SCORED_SEGMENTS], *(id for pair in newest for id in pair)]
    return _Candidates(
        config,
        wanted,
        segment_ids,
        paired,
        versions,
        newest,
        select.segment_blobs(session, list(dict.fromkeys(needed))),
    )


def _selector_of(chosen: ChosenPair[str]) -> SelectorName:
    return chosen.selector
