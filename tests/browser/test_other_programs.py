"""Data of other programs: imported, labelled in the browser, trained on, exported, and read back by the program."""

import json
import os
import pickle
import subprocess
import sys
import warnings
import zipfile
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray
from playwright.sync_api import Page, expect

from accord.client import Client
from browser.fixture_types import SignIn
from browser.labeller import PATIENCE_MS, Labeller
from browser.service import SMALL, Service
from support.waiting import until

pytestmark = pytest.mark.slow

#: Python of imitation's own environment, and what it runs
IMITATION = Path(sys.prefix, "imitation", "bin", "python")
PROGRAM = Path(__file__).with_name("imitation_program.py")
STEPS = 20
N_SEGMENTS = 15
#: every pair of the recorded segments: a few more than a new experiment needs for its first reward version
PAIRS = list(combinations(range(N_SEGMENTS), 2))
#: keys of a pair in these tests: the joint actions of both segments, of which no two are equal
Pair = tuple[bytes, bytes]


@dataclass(frozen=True, slots=True)
class Recorded:
    """A random policy in gymnasium's HalfCheetah, whose joints one agent drives."""

    #: (L, ...) by D4RL's names
    steps: dict[str, NDArray[Any]]
    #: Minari's folder of the same episode
    dataset: Path

    def segment(self, index: int) -> bytes:
        return self.steps["actions"][STEPS * index : STEPS * (index + 1)].tobytes()

    def returned(self, index: int) -> float:
        return float(self.steps["rewards"][STEPS * index : STEPS * (index + 1)].sum())


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """One step more than the segments have: D4RL's own loader leaves out the last."""
    folder, n_steps = tmp_path_factory.mktemp("minari"), STEPS * N_SEGMENTS + 1
    episode: dict[str, list[Any]] = defaultdict(list)
    with pytest.MonkeyPatch.context() as process, closing(gymnasium.make("HalfCheetah-v5")) as env:
        # MuJoCo writes warnings about deprecated attributes into the working directory.
        process.chdir(folder)
        process.setenv("MINARI_DATASETS_PATH", str(folder))
        observation_space, action_space = env.observation_space, env.action_space
        action_space.seed(0)
        episode["observations"].append(env.reset(seed=0)[0])
        simulation: Any = env.unwrapped
        for _ in range(n_steps):
            for name in ("qpos", "qvel"):
                episode[name].append(getattr(simulation.data, name).copy())
            episode["actions"].append(action_space.sample())
            observation, reward, *_ = env.step(episode["actions"][-1])
            episode["observations"].append(observation)
            episode["rewards"].append(reward)
        buffer = EpisodeBuffer(
            observations=np.array(episode["observations"]),
            actions=np.array(episode["actions"]),
            rewards=episode["rewards"],
            terminations=[False] * n_steps,
            truncations=[False] * (n_steps - 1) + [True],
            infos={name: np.array([*episode[name], getattr(simulation.data, name)]) for name in ("qpos", "qvel")},
        )
        with warnings.catch_warnings():
            # Minari warns about missing descriptions and authors.
            warnings.simplefilter("ignore", UserWarning)
            minari.create_dataset_from_buffers(
                "halfcheetah/random-v0", [buffer], observation_space=observation_space, action_space=action_space
            )
    steps = {
        "observations": np.array(episode["observations"][:-1], dtype=np.float32),
        "actions": np.array(episode["actions"]),
        "rewards": np.array(episode["rewards"], dtype=np.float32),
        "terminals": np.array(buffer.terminations),
        "timeouts": np.array(buffer.truncations),
        "infos/qpos": np.array(episode["qpos"], dtype=np.float32),
        "infos/qvel": np.array(episode["qvel"], dtype=np.float32),
    }
    return Recorded(steps, folder / "halfcheetah" / "random-v0")


def of_minari(recorded: Recorded, _folder: Path) -> Path:
    return recorded.dataset


def of_clean_offline_rlhf(recorded: Recorded, folder: Path) -> Path:
    """The D4RL file, and pickles that name the segments of every pair by their first steps, and the better one."""
    with h5py.File(folder / "halfcheetah_random-v2.hdf5", "w") as file:
        for name, rows in recorded.steps.items():
            file[name] = rows
    first, second = np.array(PAIRS).T
    labels = np.array([int(recorded.returned(a) < recorded.returned(b)) for a, b in PAIRS])
    about = f"domain_mujoco_env_halfcheetah-random-v2_num_{len(PAIRS)}_len_{STEPS}_2ee2264b.pkl"
    for name, values in (("human_label", labels), ("indices_1", STEPS * first), ("indices_2", STEPS * second)):
        (folder / f"{name}_{about}").write_bytes(pickle.dumps(values))
    return folder


def segments_in_minari(folder: Path) -> set[bytes]:
    """The joint actions of every episode, read by Minari."""
    dataset = minari.MinariDataset(folder / "data")
    return {
        np.stack([episode.actions[f"agent_{agent}"] for agent in range(6)], axis=1).tobytes() for episode in dataset
    }


def labels_in_clean_offline_rlhf(folder: Path) -> dict[Pair, list[float]]:
    """P(first preferred) and P(second preferred) of pairs, by the rules of Clean-Offline-RLHF's and D4RL's loaders."""
    with h5py.File(folder / "trajectories.hdf5") as file:
        rows = {name: np.array(file[name]) for name in ("actions", "timeouts")}
    kept = [row for row in range(len(rows["timeouts"]) - 1) if not rows["timeouts"][row]]
    actions = rows["actions"][kept]
    labels, second, first = (
        pickle.loads(file.read_bytes())  # noqa: S301 (our own)
        for pattern in ("label_*", "indices_2_*", "indices_num*")
        for file in folder.glob(pattern)
    )
    targets = {0: [1.0, 0.0], 1: [0.0, 1.0], -1: [0.5, 0.5]}
    return {
        (actions[a : a + STEPS].tobytes(), actions[b : b + STEPS].tobytes()): targets[label]
        for a, b, label in zip(first.tolist(), second.tolist(), labels.tolist(), strict=True)
    }


def import_on_page(page: Page, format: str, archive: Path) -> str:
    """Import a file; return the id of the paused experiment."""
    page.get_by_role("button", name="Import").click()
    form = page.get_by_role("form", name="Import an experiment")
    form.get_by_label("Format").select_option(format)
    form.get_by_label("File", exact=True).set_input_files(archive)
    form.get_by_label("Name of the new experiment").fill(f"From {format}")
    form.get_by_label("Task").select_option(SMALL["task"])
    form.get_by_label("Steps of a segment").fill(str(STEPS))
    form.get_by_role("button", name="Import").click()
    expect(page.get_by_role("heading", name=f"From {format}")).to_be_visible(timeout=PATIENCE_MS)
    return page.url.rpartition("/")[2]


def export_on_page(page: Page, format: str, path: Path) -> Path:
    """Download an export of the experiment on the page to a new file, or to a new folder if it is a ZIP file."""
    page.get_by_label("Format").select_option(format)
    with page.expect_download(timeout=PATIENCE_MS) as download:
        page.get_by_role("button", name="Export").click()
    if not download.value.suggested_filename.endswith(".zip"):
        download.value.save_as(path)
        return path
    with zipfile.ZipFile(download.value.path()) as archive:
        archive.extractall(path)
    return next(path.iterdir())


@dataclass(frozen=True, slots=True)
class Researcher:
    """Imports, labels and trains on a file, in the browser; and over REST what takes too many clicks."""

    service: Service
    token: str
    page: Page

    def work_with(self, format: str, file: Path, labels: int, exported: Path) -> Path:
        """Import a file, label a pair and wait for a reward version.

        Args:
            labels: those in the file; without any, a program labels the first round.
            exported: see `export_on_page`.

        Returns:
            The export.
        """
        service, page = self.service, self.page
        experiment = import_on_page(page, format, file)
        with Client(service.url, self.token) as client:
            assert client.experiment(experiment).labels.labels == labels
            client.resume(experiment)
            labeller = Labeller(page)
            labeller.open(service.url, experiment)
            labelled = labeller.press("ArrowLeft").query
            stored = "select state from labels where query_id = ?"
            until(lambda: service.rows(stored, labelled) == [("label",)], "the label is stored")
            if not labels:
                client.teach(experiment, lambda first, second: float(first.rewards.sum() > second.rewards.sum()), 100)
            version = until(lambda: client.reward_versions(experiment), "a reward version of the labels")[0]
            assert version.label_count >= 100
            client.cancel(experiment)
        page.goto(f"{service.url}/experiments/{experiment}")
        return export_on_page(page, format, exported)


@pytest.fixture
def rosa(service: Service, researcher: str, sign_in: SignIn) -> Researcher:
    return Researcher(service, researcher, sign_in("Rosa", "researcher"))


@pytest.mark.parametrize(
    ("format", "write", "labels"), [("minari", of_minari, 0), ("offline", of_clean_offline_rlhf, len(PAIRS))]
)
def test_data_of_a_program_are_labelled_trained_on_and_read_back_by_it(
    rosa: Researcher,
    recorded: Recorded,
    tmp_path: Path,
    format: str,
    write: Callable[[Recorded, Path], Path],
    labels: int,
) -> None:
    (tmp_path / "original").mkdir()
    original, archive = write(recorded, tmp_path / "original"), tmp_path / "original.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted(original.rglob("*")):
            file.write(path, f"original/{path.relative_to(original)}")
    exported = rosa.work_with(format, archive, labels, tmp_path / "exported")
    if format == "minari":
        found = segments_in_minari(exported)
        # The last step of the episode is in no segment.
        assert {recorded.segment(index) for index in range(N_SEGMENTS)} <= found
    else:
        targets = labels_in_clean_offline_rlhf(exported)
        assert len(targets) == labels + 1
        for a, b in PAIRS:
            better = [1.0, 0.0] if recorded.returned(a) >= recorded.returned(b) else [0.0, 1.0]
            assert targets[recorded.segment(a), recorded.segment(b)] == better


def imitation(action: str, file: Path, *arguments: str) -> str:
    """Run `imitation_program.py`; returns what it prints."""
    done = subprocess.run(
        [IMITATION, PROGRAM, action, file, *arguments],
        cwd=file.parent,  # MuJoCo writes its warnings there
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not IMITATION.exists(), reason="imitation is not installed (make test-imitation)")
def test_comparisons_of_imitation_are_labelled_trained_on_and_read_back_by_it(rosa: Researcher, tmp_path: Path) -> None:
    original = tmp_path / "preferences.pkl"
    imitation("write", original, str(STEPS), str(len(PAIRS)))
    given = json.loads(imitation("read", original))
    assert len(given["labels"]) == len(PAIRS)
    exported = rosa.work_with("imitation", original, len(PAIRS), tmp_path / "exported.pkl")
    found = json.loads(imitation("read", exported))
    assert found["labels"].items() >= given["labels"].items()
    assert len(found["labels"]) == len(PAIRS) + 1
    assert found["infos"] == ["qpos", "qvel"]
