"""Eight scripted labellers label one experiment through the service. The quality page must flag the four bad ones.

Run by `make learn`. Prints the statistics of the quality page and the weights of the newest reward version.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acceptance.accord_service import ENVIRONMENT, Accord, Client
from support.waiting import until

GOOD = "mistake:mistake=0.05"
CREW = {"good-1": GOOD, "good-2": GOOD, "good-3": GOOD, "good-4": GOOD} | {
    name: name.partition("-")[0] for name in ("careless-1", "careless-2", "left", "opposite")
}
#: 500 pairs, a fifth of them labelled twice
LABELS, GOLD_PAIRS = 600, 10
EXPERIMENT: dict[str, Any] = {
    "task": "HalfCheetah-6x1",
    "segment_steps": 50,
    "total_steps": 400_000,
    "policy": {},
    "label_budget": LABELS,
    "initial_labels": 100,
    "labels_per_version": 100,
    "lookahead_queries": 40,
    "labels_per_pair": 2,
    "overlap_share": 0.2,
    "gold_share": 0.1,
    "repeat_share": 0.1,
    "reward_model": "MA-MLP",
    "render_clips": False,
}

pytestmark = pytest.mark.learn


@pytest.fixture
def accord(tmp_path: Path) -> Iterator[Accord]:
    service = Accord(tmp_path / "home")
    yield service
    service.kill_everything()


def make_gold(researcher: Client, experiment: str) -> None:
    """Give the true answer of the pairs whose true returns differ most."""
    queries = researcher.request("GET", f"/experiments/{experiment}/queries", limit=100)["items"]
    returns = {query["id"]: [segment["true_return"] for segment in query["segments"]] for query in queries}
    clearest = sorted(returns, key=lambda id: -abs(returns[id][0] - returns[id][1]))[:GOLD_PAIRS]
    for id in clearest:
        researcher.request("PUT", f"/queries/{id}/gold", {"label": float(returns[id][0] > returns[id][1])})


def label_as(accord: Accord, experiment: str, seed: int, name: str, teacher: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "accord.cli", "teach", "--experiment", experiment, "--teacher", teacher]
    command += ["--token", accord.token(name, "teacher"), "--seed", str(seed), "--url", accord.url]
    return subprocess.Popen(command, env=os.environ | ENVIRONMENT, stdout=subprocess.DEVNULL)


def test_the_quality_page_and_the_weights_tell_bad_labellers_from_good_ones(accord: Accord):
    accord.start({"OMP_NUM_THREADS": "1"}, without=["render"])
    researcher = Client(accord, accord.token("Rosa", "researcher"))
    id = researcher.create_experiment(name="crew", **EXPERIMENT)
    until(lambda: researcher.experiment(id)["labels"]["open_queries"] >= 60, "pairs of the first rollout are ready")
    make_gold(researcher, id)
    people = [label_as(accord, id, seed, name, teacher) for seed, (name, teacher) in enumerate(CREW.items())]

    for person in people:
        assert person.wait() == 0
    until(lambda: researcher.experiment(id)["status"] == "finished", "the policy is trained to the end")
    quality = researcher.request("GET", f"/experiments/{id}/quality")
    weights = {each["name"]: each for each in researcher.request("GET", f"/experiments/{id}/reliability")["items"]}
    print(f"\nalpha {quality['alpha']}, {quality['disputed']} disputed")
    for person in quality["labellers"]:
        shares = {
            name: None if person[name] is None else f"{person[name]['count']}/{person[name]['of']}"
            for name in ("left", "equal", "gold", "consistency", "agreement", "teacher")
        }
        weight = weights[person["name"]]
        print(person["name"], person["labels"], shares, person["flags"], {k: weight[k] for k in weight if "w" in k})
    print("true return", researcher.experiment(id)["returns"])
    bad = {name for name in CREW if not name.startswith("good")}
    mean = {name: weights[name]["mean_weight"] for name in CREW}
    assert max(mean[name] for name in bad) < min(mean[name] for name in CREW if name not in bad)
