"""Chooses the pairs to ask about next and writes their query rows."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from accord.services import experiments, publish, select
from accord.services.collect import load_arrays
from accord.services.experiment_config import ExperimentConfig
from accord.store.blobs import BlobStore
from accord.store.tables import RewardVersionRow
from accord.workers.heartbeat import Claim
from accord.workers.model_store import Ensembles
from accord.workers.runner import Context
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import (
    ChosenPair,
    ControlledSelector,
    SegmentView,
    SelectorName,
    UniformSelector,
    make_selector,
    needs_ensemble,
    needs_features,
    segment_features,
    selector_names,
)
from mapt.preferences.selection.protocol import SegmentId
from mapt.rewards.ensemble import RewardEnsemble

#: the newest share of the pool counts as recent, at least so many segments
RECENT_SHARE = 0.25
FEWEST_RECENT = 16


class RecentPairs:
    """Uniform, but half of the pairs compare two recent segments and half a recent one with any.

    Labels on what the policy does now matter most, and a bridge to older behaviour keeps the reward's scale.
    """

    name: SelectorName = "uniform"

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._uniform = UniformSelector(rng)

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
        view: SegmentView | None = None,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """See `mapt.preferences.selection.QuerySelector.select`; the newest segments come first."""
        recent = segment_ids[: max(FEWEST_RECENT, round(len(segment_ids) * RECENT_SHARE))]
        chosen = self._uniform.select(recent, paired, k // 2)
        taken = {frozenset(pair) for pair in [*paired, *chosen]}
        chosen += self._bridges(recent, segment_ids, taken, k - len(chosen))
        # A small pool may hold no such pair any more.
        rest = k - len(chosen)
        return chosen + self._uniform.select(segment_ids, [*paired, *chosen], rest) if rest else chosen

    def _bridges(
        self, recent: Sequence[SegmentId], pool: Sequence[SegmentId], taken: set[frozenset[SegmentId]], k: int
    ) -> list[tuple[SegmentId, SegmentId]]:
        chosen: list[tuple[SegmentId, SegmentId]] = []
        for _ in range(20 * k):
            if len(chosen) == k:
                break
            new, other = recent[int(self._rng.integers(len(recent)))], pool[int(self._rng.integers(len(pool)))]
            if new == other or frozenset((new, other)) in taken:
                continue
            taken.add(frozenset((new, other)))
            chosen.append((new, other) if self._rng.integers(2) else (other, new))
        return chosen


def choose_pairs(
    config: ExperimentConfig,
    segment_ids: Sequence[str],
    paired: Collection[frozenset[str]],
    k: int,
    *,
    view: SegmentView | None,
    first_round: bool,
    rng: np.random.Generator,
) -> list[ChosenPair[str]]:
    """Choose up to k pairs that were never asked about, each with how it was chosen.

    The first round draws from all segments alike; so does, but for `RecentPairs`, every round without a view.

    Args:
        segment_ids: the pool, newest first.
        paired: pairs that have a query, in either order.
        view: what is known of the first of `segment_ids`, as many as it tells of; the others are chosen only when
            those are used up.

    Raises:
        mapt.preferences.selection.UnknownSelector: if `config.query_selection` is none.
    """
    known = [(min(pair), max(pair)) for pair in paired]
    control = UniformSelector(rng) if first_round else RecentPairs(rng)
    informed = make_selector(config.query_selection, rng, propose=control)
    chosen: list[ChosenPair[str]] = []
    if view is not None:
        selector = ControlledSelector(informed, control, config.control_share, rng)
        chosen = selector.choose(segment_ids[: view.n_segments], known, k, view)
    rest = control.select(segment_ids, [*known, *(each.pair for each in chosen)], k - len(chosen))
    return chosen + [ChosenPair(pair, control.name) for pair in rest]


#: segments read at once
_CHUNK = 64

_Vector = NDArray[np.float32]


class Scout:
    """Looks into the segments of one experiment."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs
        #: by blob key, (F,); a segment never changes
        self._features: dict[str, _Vector] = {}
        #: of which version's ensemble the scores are
        self._version_id = ""
        #: by blob key, (M,)
        self._scores: dict[str, _Vector] = {}

    def scores(
        self, version_id: str, ensemble: RewardEnsemble, keys: Sequence[str], device: str
    ) -> NDArray[np.float32]:
        """Score of each segment by each member, (M, S); computed once for a version's ensemble.

        Raises:
            BlobMissing: if a segment's arrays are gone.
        """
        if version_id != self._version_id:
            self._version_id, self._scores = version_id, {}
        for chunk in self._new(keys, self._scores):
            self._scores.update(zip(chunk, ensemble.scores(self._read(chunk), device).T, strict=True))
        return np.stack([self._scores[key] for key in keys], axis=1)

    def features(self, keys: Sequence[str]) -> NDArray[np.float32]:
        """`segment_features` of each segment, (S, F).

        Raises:
            BlobMissing: if a segment's arrays are gone.
        """
        for chunk in self._new(keys, self._features):
            self._features.update(zip(chunk, segment_features(self._read(chunk)), strict=True))
        return np.stack([self._features[key] for key in keys])

    def _new(self, keys: Sequence[str], known: dict[str, _Vector]) -> list[list[str]]:
        new = [key for key in dict.fromkeys(keys) if key not in known]
        return [new[start : start + _CHUNK] for start in range(0, len(new), _CHUNK)]

    def _read(self, keys: Sequence[str]) -> SegmentArrays:
        arrays = [load_arrays(self._blobs, key) for key in keys]
        return SegmentArrays.stack([each["observations"] for each in arrays], [each["actions"] for each in arrays])


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
