"""Keeps queries coming: how many are wanted, what is known of the segments, which pairs, their rows."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from sqlalchemy.orm import Session

from accord.domain.experiment import ExperimentConfig
from accord.services import experiments, publish, select
from accord.store.tables import RewardVersionRow
from accord.workers.ensembles import Ensembles
from accord.workers.loop import Context
from accord.workers.pulse import Claim
from accord.workers.querying import choose_pairs
from accord.workers.scouting import Scout
from mapt.preferences.selection import (
    ChosenPair,
    SegmentView,
    SelectorName,
    needs_ensemble,
    needs_features,
    selector_names,
)

#: which draws of an experiment's seed choose the queries
_QUERY_STREAM = 11
#: an informed choice is among so many of the newest segments: they are read, and scored again for every version
SCORED_SEGMENTS = 512
#: k-center keeps away from so many of the pairs asked about last
ASKED_PAIRS = 1000


@dataclass(frozen=True, slots=True)
class _Round:
    """What one choice starts from."""

    config: ExperimentConfig
    wanted: int
    #: newest first
    segment_ids: list[str]
    paired: set[frozenset[str]]
    #: newest first, at most two
    versions: list[RewardVersionRow]
    #: the pairs that a choice by features keeps away from
    asked: Sequence[frozenset[str]]
    #: of the segments to look into
    blob_keys: dict[str, str]


class Asker:
    """Adds queries for one experiment after the other."""

    def __init__(self, context: Context, ensembles: Ensembles) -> None:
        self._context = context
        self._ensembles = ensembles
        self._scouts: dict[str, Scout] = {}

    def forget_all_but(self, experiment_ids: Collection[str]) -> None:
        """Frees what was kept of experiments that run no more."""
        self._scouts = {id: scout for id, scout in self._scouts.items() if id in experiment_ids}

    def add_queries(self, experiment_id: str, claim: Claim) -> bool:
        """Choose the next pairs and write their rows. Returns whether any were added.

        Raises:
            ClaimLost: if the experiment may be another worker's by now.
            mapt.preferences.selection.UnknownSelector: if its settings name one.
        """
        with self._context.database.reading() as session:
            found = _read_round(session, experiment_id)
        if found is None:
            return False
        # Segments are read and scored outside of any transaction: nobody's label waits for it.
        view, version = self._look(experiment_id, found)
        chosen = choose_pairs(
            found.config,
            found.segment_ids,
            found.paired,
            found.wanted,
            view=view,
            first_round=not found.versions,
            rng=np.random.default_rng([found.config.seed, _QUERY_STREAM, len(found.paired)]),
        )
        added = 0
        with self._context.database.transaction() as session:
            claim.check_within(session)
            row = experiments.get(session, experiment_id)
            if select.queries_wanted(session, row) == 0:
                return False  # paused, or ended, meanwhile
            for name, group in groupby(chosen, key=_selector_of):
                scored_by = version.id if version is not None and needs_ensemble(name) else None
                added += len(select.add_queries(session, row, [each.pair for each in group], name, scored_by))
        return added > 0

    def _look(self, experiment_id: str, found: _Round) -> tuple[SegmentView | None, RewardVersionRow | None]:
        """What is known of the newest segments, and by which version's ensemble; None before there is one."""
        name = found.config.query_selection
        if not found.blob_keys:
            return None, None
        scout = self._scouts.setdefault(experiment_id, Scout(self._context.blobs))
        keys = [found.blob_keys[id] for id in found.segment_ids[:SCORED_SEGMENTS]]
        scores = features = asked = version = None
        if needs_ensemble(name):
            # Until the newest version has its ensemble, its parent's serves.
            known = ((each, self._ensembles.of(each)) for each in found.versions)
            version, ensemble = next((each for each in known if each[1] is not None), (None, None))
            if version is None or ensemble is None:
                return None, None
            scores = scout.scores(version.id, ensemble, keys, found.config.device)
        if needs_features(name):
            features = scout.features(keys)
            pairs = [found.blob_keys[id] for pair in found.asked for id in sorted(pair)]
            asked = scout.features(pairs).reshape(-1, 2, features.shape[1]) if pairs else None
        return SegmentView(scores, features, asked), version


def wants_ensemble(config: ExperimentConfig) -> bool:
    """Whether an experiment's versions each get an ensemble; not where its selector is an unknown one."""
    return config.query_selection in selector_names() and needs_ensemble(config.query_selection)


def _read_round(session: Session, experiment_id: str) -> _Round | None:
    """None where no query is wanted, or there is nothing to ask about."""
    row = experiments.get(session, experiment_id)
    config = experiments.config_of(row)
    wanted = select.queries_wanted(session, row)
    segment_ids = select.askable(session, experiment_id) if wanted else []
    if len(segment_ids) < 2:
        return None
    paired = select.paired(session, experiment_id)
    versions = publish.versions(session, experiment_id)[:-3:-1]
    looked_into: list[str] = []
    asked: Sequence[frozenset[str]] = ()
    if versions and config.query_selection != "uniform":
        asked = _asked(paired) if needs_features(config.query_selection) else ()
        looked_into = [*segment_ids[:SCORED_SEGMENTS], *(id for pair in asked for id in pair)]
    return _Round(
        config,
        wanted,
        segment_ids,
        paired,
        versions,
        asked,
        select.segment_blobs(session, list(dict.fromkeys(looked_into))),
    )


def _selector_of(chosen: ChosenPair[str]) -> SelectorName:
    return chosen.selector


def _asked(paired: Collection[frozenset[str]]) -> Sequence[frozenset[str]]:
    """The pairs of the newest segments: identifiers sort by time of making."""
    return sorted(paired, key=lambda pair: (max(pair), min(pair)))[-ASKED_PAIRS:]
