"""Any sequence of labels, skips, changes and undos by several people, against a plain model of what should be."""

import tempfile
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from sqlalchemy import func
from sqlalchemy import select as sql_select

from accord.domain.enums import Role
from accord.domain.errors import LabelNotFound, LeaseLost, QueryClosed
from accord.services import experiments, label, lease, publish
from accord.store.tables import LabelRevisionRow, LabelRow, QueryRow
from support.sample_experiments import create_sample, user
from support.stores import open_stores

PEOPLE, QUERIES = 3, 2
VALUES = st.sampled_from([1.0, 0.5, 0.0, None])


class Labelling(RuleBasedStateMachine):
    """The model: who said what about which query, who holds which, and how many words were ever said."""

    @initialize()
    def start(self) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="accord-labels-")
        self.context = open_stores(Path(self.folder.name))
        self.stores = self.context.__enter__()
        sample = create_sample(self.stores.database, self.stores.blobs, segments=3, queries=QUERIES, render_clips=False)
        self.experiment_id, self.query_ids = sample.experiment.id, sample.query_ids
        with self.stores.database.transaction() as session:
            # the last one is a program, which needs no lease
            roles = [Role.LABELLER] * (PEOPLE - 1) + [Role.TEACHER]
            self.people = [user(session, f"person {n}", role)[0] for n, role in enumerate(roles)]
        self.said: dict[tuple[int, int], float | str | None] = {}
        self.holder: dict[int, int] = {}
        self.words: list[tuple[int, int, float | str | None]] = []

    def closed_by(self, query: int) -> int | None:
        return next((who for (who, which), word in self.said.items() if which == query and type(word) is float), None)

    def say(self, who: int, query: int, word: float | str | None) -> None:
        self.said[who, query] = word
        self.words.append((who, query, word))

    @rule(who=st.integers(0, PEOPLE - 1), count=st.integers(1, QUERIES))
    def ask(self, who: int, count: int) -> None:
        mine = [query for query, holder in sorted(self.holder.items()) if holder == who]
        free = [
            query
            for query in range(QUERIES)
            if query not in self.holder
            and self.closed_by(query) is None
            and self.said.get((who, query), "undone") == "undone"
        ]
        expected = sorted((mine + free)[:count])
        with self.stores.database.transaction() as session:
            found = lease.next_queries(session, self.people[who], self.experiment_id, count, 3600.0)
        assert [self.query_ids.index(item.id) for item in found.items] == expected
        self.holder |= dict.fromkeys(expected, who)

    @rule(who=st.integers(0, PEOPLE - 1), query=st.integers(0, QUERIES - 1))
    def give_back(self, who: int, query: int) -> None:
        with self.stores.database.transaction() as session:
            lease.release(session, self.people[who], self.query_ids[query])
        if self.holder.get(query) == who:
            del self.holder[query]

    @rule(who=st.integers(0, PEOPLE - 1), query=st.integers(0, QUERIES - 1), value=VALUES)
    def put(self, who: int, query: int, value: float | None) -> None:
        before = self.said.get((who, query), "undone")
        expected: type[Exception] | None = None
        if before != value and type(before) is not float:
            if self.closed_by(query) is not None:
                expected = QueryClosed
            elif self.holder.get(query, who) != who or (
                query not in self.holder and before == "undone" and who != PEOPLE - 1
            ):
                expected = LeaseLost
        with self.stores.database.transaction() as session, refusal(expected):
            outcome = label.put_label(session, self.people[who], self.query_ids[query], value)
            assert outcome.created == (before != value)
        if expected is None and before != value:
            self.say(who, query, value)
            self.holder.pop(query, None)

    @rule(who=st.integers(0, PEOPLE - 1), query=st.integers(0, QUERIES - 1))
    def undo(self, who: int, query: int) -> None:
        before = self.said.get((who, query), "undone")
        expected: type[Exception] | None = None
        if before == "undone":
            expected = LabelNotFound
        elif before is None and self.closed_by(query) is not None:
            expected = QueryClosed
        elif before is None and self.holder.get(query, who) != who:
            expected = LeaseLost
        with self.stores.database.transaction() as session, refusal(expected):
            label.undo(session, self.people[who], self.query_ids[query], 3600.0)
        if expected is None:
            self.say(who, query, "undone")
            self.holder[query] = who

    @invariant()
    def the_database_says_the_same(self) -> None:
        counted = {self.query_ids[query]: word for (_, query), word in sorted(self.said.items()) if type(word) is float}
        with self.stores.database.reading() as session:
            row = experiments.get(session, self.experiment_id)
            assert row.label_count == len(counted)
            assert row.label_revision == len(self.words)
            # every word ever said is kept, in its order
            history = session.execute(
                sql_select(LabelRevisionRow.revision, LabelRevisionRow.state, LabelRevisionRow.value).order_by(
                    LabelRevisionRow.revision
                )
            ).all()
            assert [tuple(each) for each in history] == [
                (number, *state_and_value(word)) for number, (_, _, word) in enumerate(self.words, 1)
            ]
            assert session.scalar(sql_select(func.count()).select_from(LabelRow)) == len(self.said)
            training = publish.training_labels(session, self.experiment_id)
            assert {each.query_id: each.value for each in training.items} == counted
            assert training.watermark == len(self.words)
            for number, query_id in enumerate(self.query_ids):
                query = session.get(QueryRow, query_id)
                assert query is not None
                assert query.status == ("closed" if self.closed_by(number) is not None else "open")
                holder = self.holder.get(number)
                assert query.leased_by == (None if holder is None else self.people[holder].id)

    def teardown(self) -> None:
        if hasattr(self, "context"):
            self.context.__exit__(None, None, None)
            self.folder.cleanup()


def refusal(expected: type[Exception] | None) -> AbstractContextManager[object]:
    return nullcontext() if expected is None else pytest.raises(expected)


def state_and_value(word: float | str | None) -> tuple[str, float | None]:
    if word == "undone":
        return "undone", None
    return ("skip", None) if word is None else ("label", float(word))


Labelling.TestCase.settings = settings(
    max_examples=30, stateful_step_count=30, deadline=None, suppress_health_check=list(HealthCheck)
)
TestAnySequenceOfLabels = Labelling.TestCase
