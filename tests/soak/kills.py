"""Kill a random process in each of many rounds, while people label, a teacher labels and a policy trains.

The processes: the server, the workers, the render process, `accord up`, which is started again as systemd would, and
with PostgreSQL one of the database's processes. After each kill, a label is acknowledged and the policy trains further
than before, or the round fails. At the end, every label that was acknowledged is stored as acknowledged, none is stored
twice, and `accord verify` finds no fault.

    python tests/soak/kills.py [--rounds 200] [--database sqlite|postgres] [--labellers 16] [--seed 0]
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from urllib.parse import urlsplit

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import httpx
import psutil
from bench_load import database_url
from sqlalchemy import text

from acceptance.accord_service import ENVIRONMENT, TINY, Accord, alive
from accord.domain.enums import Role
from accord.services import accounts
from accord.store.database import Database
from accord.store.migrate import migrate
from support.plain_http import PLAIN_HTTP
from support.ports import free_port
from support.waiting import PATIENCE_SECONDS, until

VICTIMS = ("api", "policy", "reward", "render", "child", "supervisor")
#: An experiment is replaced after so many rounds, because training on thousands of labels takes minutes.
ROUNDS_PER_EXPERIMENT = 20
EXPERIMENT = TINY | {
    "total_steps": 4_000_000,
    "label_budget": 100_000,
    "labels_per_version": 20,
    "lookahead_queries": 64,
    "labels_per_pair": 3,
    "overlap_share": 1.0,
    "pacing": "free",
}
THINK_SECONDS = 0.1
TRANSIENT = {429, 502, 503, 504, 507}
#: the lease has expired, the pair has its labels, or the experiment is over: the label was not stored
REFUSED = {403, 404, 409, 410}


@dataclass
class Labeller:
    """A person who labels new pairs and changes earlier labels, and sends each label until it is answered."""

    url: str
    token: str
    random: random.Random
    stop: threading.Event
    #: query -> value that was acknowledged last
    acknowledged: dict[str, float] = field(default_factory=dict)
    count: int = 0
    failure: str = ""
    #: held while a label is sent
    busy: threading.Lock = field(default_factory=threading.Lock)

    def run(self, experiment: "CurrentExperiment") -> None:
        try:
            with httpx.Client(
                base_url=f"{self.url}/api/v1", headers={"Authorization": f"Bearer {self.token}"}, **PLAIN_HTTP
            ) as http:
                while not self.stop.is_set():
                    with self.busy:
                        self._label(http, experiment.id)
                    self.stop.wait(THINK_SECONDS * self.random.random())
        except Exception as error:  # noqa: BLE001 a thread: the main one ends the run
            self.failure = repr(error)

    def _label(self, http: httpx.Client, experiment: str) -> None:
        found = self._send(http, "POST", f"/experiments/{experiment}/queries/next", {"count": 1})
        items = found.json()["items"] if found.is_success else []
        if items:
            query, value = items[0]["id"], self.random.choice((0.0, 0.5, 1.0))
        elif self.acknowledged:
            query = self.random.choice(list(self.acknowledged)[-50:])
            value = 1.0 if self.acknowledged[query] != 1.0 else 0.0
        else:
            return
        answer = self._send(http, "PUT", f"/queries/{query}/label", {"label": value, "order": "segments"})
        if answer.status_code in REFUSED:
            return
        if not answer.is_success:
            raise RuntimeError(f"a label was answered by {answer.status_code}: {answer.text}")
        self.acknowledged[query] = value
        self.count += 1

    def _send(self, http: httpx.Client, method: str, path: str, body: object) -> httpx.Response:
        """The answer of the server, however often the request must be repeated: its label may be stored already."""
        end = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < end:
            with suppress(httpx.TransportError):
                response = http.request(method, path, json=body)
                if response.status_code not in TRANSIENT:
                    return response
            time.sleep(0.1)
        raise RuntimeError(f"no answer to {method} {path} in {PATIENCE_SECONDS:.0f} s")


@dataclass
class CurrentExperiment:
    """The experiment that is labelled now."""

    id: str


class Soak:
    """A service, its database and those who label."""

    def __init__(self, folder: Path, url: str, labellers: int, seed: int, victims: str | None) -> None:
        self.random = random.Random(seed)
        home = folder / "home"
        home.mkdir(parents=True)
        self.port = free_port()
        self.database_url = url or f"sqlite:///{home / 'accord.db'}"
        self.accord = Accord(home, self.database_url)
        self.environment = {"ACCORD_DATABASE_URL": self.database_url} if url else {}
        self.postgres = _postmaster(url) if url else None
        every = [*VICTIMS, *(["postgres"] * 2 if self.postgres else [])]
        self.victims = victims.split(",") if victims else every
        self.recoveries: dict[str, list[float]] = {}
        self.stop = threading.Event()
        self.teacher: subprocess.Popen[bytes] | None = None
        self.teacher_ends = 0
        with closing(Database.open(self.database_url)) as database:
            migrate(database)
            with database.transaction() as session:
                names = [f"labeller {number}" for number in range(labellers)]
                tokens = [accounts.create_user(session, name, Role.LABELLER)[1] for name in names]
                self.researcher = accounts.create_user(session, "researcher", Role.RESEARCHER)[1]
                self.teacher_token = accounts.create_user(session, "teacher", Role.TEACHER)[1]
        address = f"http://127.0.0.1:{self.port}"
        self.labellers = [
            Labeller(address, token, random.Random(f"{seed} {number}"), self.stop)
            for number, token in enumerate(tokens)
        ]
        self.address = address
        self.threads: list[threading.Thread] = []
        self.experiments: list[str] = []
        self.current = CurrentExperiment("")

    def start(self) -> None:
        self.accord.start(self.environment, port=self.port)

    def request(self, method: str, path: str, body: object = None) -> dict:
        def attempt() -> httpx.Response | None:
            with suppress(httpx.TransportError):
                headers = {"Authorization": f"Bearer {self.researcher}"}
                response = self.accord.http.request(method, f"{self.address}/api/v1{path}", json=body, headers=headers)
                return None if response.status_code in TRANSIENT else response
            return None

        return until(attempt, f"an answer to {method} {path}").raise_for_status().json()

    def new_experiment(self) -> None:
        """Replace the experiment while nobody sends a label; the earlier one keeps its labels."""
        with ExitStack() as quiet:
            for labeller in self.labellers:
                quiet.enter_context(labeller.busy)
            if self.current.id:
                self.request("POST", f"/experiments/{self.current.id}/cancel")
                self.end_teacher()
            name = f"experiment {len(self.experiments)}"
            self.current.id = self.request("POST", "/experiments", {"name": name, **EXPERIMENT})["id"]
            self.experiments.append(self.current.id)
            self.start_teacher()

    def await_version(self) -> None:
        """Wait until another reward version is published: training has survived the kills."""
        experiment = self.current.id
        before = self.versions(experiment)
        until(lambda: self.versions(experiment) > before, "a further reward version")

    def versions(self, experiment: str) -> int:
        return len(self.request("GET", f"/experiments/{experiment}/reward-versions")["items"])

    def start_labellers(self) -> None:
        for labeller in self.labellers:
            thread = threading.Thread(target=labeller.run, args=(self.current,), daemon=True)
            thread.start()
            self.threads.append(thread)

    def start_teacher(self) -> None:
        command = [sys.executable, "-m", "accord.cli", "teach", "--url", self.address, "--token", self.teacher_token]
        with (self.accord.home.parent / "teach.log").open("ab") as log:
            self.teacher = subprocess.Popen(
                [*command, "--experiment", self.current.id, "--labels", "100000"],
                env=os.environ | ENVIRONMENT,
                stdout=log,
                stderr=log,
            )

    def end_teacher(self) -> None:
        if self.teacher is not None:
            self.teacher.kill()
            self.teacher.wait()

    def count(self) -> int:
        """Labels acknowledged so far."""
        failed = [each.failure for each in self.labellers if each.failure]
        assert not failed, failed
        return sum(each.count for each in self.labellers)

    def kill_one(self, victim: str) -> psutil.Process | None:
        """Kill a process, and start again what nothing else starts. Returns the process that another must replace."""
        if victim == "postgres":
            self._kill_postgres()
        elif victim == "supervisor":
            processes = list(self.accord.processes().values())
            self.accord.supervisor.kill()
            self.accord.supervisor.wait(PATIENCE_SECONDS)
            until(lambda: not any(alive(each) for each in processes), "all processes end with accord up")
            self.start()
        else:
            process = until(lambda: self.accord.processes().get(victim), f"the {victim} process runs")
            process.kill()
            return process
        return None

    def _kill_postgres(self) -> None:
        assert self.postgres is not None
        server, command, owner = self.postgres
        group = [server, *server.children(recursive=True)]
        victim = self.random.choice(group)
        with suppress(psutil.NoSuchProcess):
            victim.kill()
        if victim.pid != server.pid:
            return  # the database ends all its connections and recovers by itself
        server.wait(PATIENCE_SECONDS)
        until(lambda: not any(alive(each) for each in group), "the processes of the database end")
        Path(command[command.index("-D") + 1], "postmaster.pid").unlink(missing_ok=True)
        started = psutil.Popen(command, user=owner, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/")
        self.postgres = started, command, owner

    def steps(self) -> int:
        experiment = self.request("GET", f"/experiments/{self.current.id}")
        assert experiment["status"] in {"running", "finished"}, experiment["phase_detail"]
        if experiment["status"] == "finished":
            self.new_experiment()
            return 0
        return experiment["steps"]

    def round(self, number: int, rounds: int) -> None:
        """Kill one process, and wait until labels are acknowledged and the policy trains further than before."""
        if number % ROUNDS_PER_EXPERIMENT == 0:
            if self.current.id:
                self.await_version()
            self.new_experiment()
            if not self.threads:
                self.start_labellers()
            until(lambda: self.steps() > 0, "the policy begins")
        time.sleep(self.random.uniform(0.0, 1.5))
        if self.teacher is not None and self.teacher.poll() is not None:
            self.teacher_ends += 1
            self.start_teacher()
        victim = self.random.choice(self.victims)
        experiment, before = self.current.id, self.steps()
        started = time.monotonic()
        killed = self.kill_one(victim)
        labels = self.count()

        def goes_on() -> bool:
            trained = self.steps() > before or self.current.id != experiment
            running = self.accord.all_running()
            replaced = running is not None and (killed is None or running[victim].pid != killed.pid)
            return trained and self.count() > labels and replaced

        until(goes_on, f"labels and training go on after a kill of {victim}")
        seconds = time.monotonic() - started
        self.recoveries.setdefault(victim, []).append(seconds)
        print(f"{number + 1:4}/{rounds}  {victim:<10} {seconds:5.1f} s   {self.count()} labels", flush=True)

    def run(self, rounds: int) -> None:
        self.start()
        try:
            for number in range(rounds):
                self.round(number, rounds)
            self.await_version()
            self.stop.set()
            for thread in self.threads:
                thread.join(PATIENCE_SECONDS)
                assert not thread.is_alive(), "a labeller waits for an answer"
            self.count()
            self.end_teacher()
            until(self.accord.all_running, "all processes run")
            self.accord.send_signal(signal.SIGTERM)
            self.accord.supervisor.wait(PATIENCE_SECONDS)
            self.check()
        except BaseException:
            print(self.tracebacks(), file=sys.stderr)
            raise
        finally:
            self.stop.set()
            self.end_teacher()
            self.accord.kill_everything()

    def tracebacks(self) -> str:
        """What the server's log says about failures."""
        lines = (self.accord.home / "logs" / "api.log").read_text().splitlines()
        return "\n".join(line for line in lines if " INFO " not in line)[-20_000:]

    def check(self) -> None:
        """Compare what is stored with what was acknowledged, and print the result. Raises AssertionError."""
        with closing(Database.open(self.database_url)) as database, database.reading() as session:
            rows = session.execute(
                text(
                    "SELECT labels.query_id, users.name, labels.value FROM labels JOIN users "
                    "ON users.id = labels.user_id WHERE labels.state = 'label'"
                )
            ).all()
            history = session.execute(
                text(
                    "SELECT label_id, label_revisions.value, label_revisions.state, users.name, labels.query_id, "
                    "label_revisions.revision, label_revisions.created_at, label_revisions.left_segment "
                    "FROM label_revisions JOIN labels ON labels.id = label_id JOIN users ON users.id = labels.user_id "
                    "ORDER BY label_id, label_revisions.revision"
                )
            ).all()
            versions = dict(
                session.execute(
                    text("SELECT experiment_id, count(*) FROM reward_versions GROUP BY experiment_id")
                ).all()
            )
        stored = {(name, query): value for query, name, value in rows}
        given = {
            (f"labeller {number}", query): value
            for number, labeller in enumerate(self.labellers)
            for query, value in labeller.acknowledged.items()
        }
        lost = [key for key, value in given.items() if stored.get(key) != value]
        people = {f"labeller {number}" for number in range(len(self.labellers))}
        doubled = [(a, b) for a, b in pairwise(history) if a[:3] == b[:3]]
        assert len(stored) == len(rows)
        unknown = [key for key in stored if key[0] in people and key not in given]
        by_teacher = sum(name == "teacher" for name, _ in stored)
        checked = self.accord.run("verify", environment=self.environment)
        kills = Counter({victim: len(times) for victim, times in self.recoveries.items()})
        for victim, times in sorted(self.recoveries.items()):
            print(f"{victim:<10} {len(times):4} kills   longest recovery {max(times):5.1f} s")
        print(f"{kills.total()} kills, {self.count()} labels and changes acknowledged, {len(stored)} stored")
        print(f"labels of the teacher: {by_teacher}; it was started again {self.teacher_ends} times")
        print(
            f"reward versions of {len(self.experiments)} experiments: {[versions.get(e, 0) for e in self.experiments]}"
        )
        print(f"lost {len(lost)}, doubled {len(doubled)}, stored without having been acknowledged {len(unknown)}")
        for each in (*lost, *doubled, *unknown):
            print(f"  {each}")
        print(f"accord verify: {'clean' if checked.returncode == 0 else checked.stdout + checked.stderr}")
        assert not lost
        assert not doubled
        assert not unknown
        assert by_teacher
        assert all(versions.get(each, 0) for each in self.experiments)
        assert checked.returncode == 0


def _postmaster(url: str) -> tuple[psutil.Process, list[str], str]:
    """The server's first process, its command, and the user that it runs as."""
    port = str(urlsplit(url).port)
    for process in psutil.process_iter(["name", "cmdline"]):
        command = process.info["cmdline"] or []
        if process.info["name"] == "postgres" and "-D" in command and port in command:
            return process, command, process.username()
    raise RuntimeError(f"no PostgreSQL server on port {port}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--database", choices=["sqlite", "postgres"], default="sqlite")
    parser.add_argument("--labellers", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--victims", help="comma-separated; all by default")
    options = parser.parse_args()
    with ExitStack() as opened:
        folder = opened.enter_context(tempfile.TemporaryDirectory(prefix="accord-soak-"))
        url = opened.enter_context(database_url(options.database))
        Soak(Path(folder), url, options.labellers, options.seed, options.victims).run(options.rounds)


if __name__ == "__main__":
    main()
