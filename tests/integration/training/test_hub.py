"""Reward models and policies in repositories of the Hugging Face Hub: its own client, and a stand-in of its server."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from huggingface_hub import ModelCard, constants

import mapt
from mapt import hub
from mapt.errors import (
    AlreadyExists,
    DamagedCheckpoint,
    HubDenied,
    HubNotFound,
    HubUnreachable,
    InvalidConfig,
    RunNotFound,
)
from mapt.policies import Learner, PolicyConfig
from mapt.provenance import provenance
from mapt.training.evaluation import Evaluation
from mapt.training.policy_checkpoint import PolicyCheckpoint
from mapt.training.run_folder import RunFolder, load_policy
from mapt.training.settings import RunSettings
from support.hub_server import TOKEN, HubServer, hub_server
from support.short_tasks import SHORTEST_NAME
from support.training_runs import reward_model

pytestmark = [
    pytest.mark.usefixtures("short_episodes"),
    # of the Hub's own client
    pytest.mark.filterwarnings("ignore:Use 'content=<...>' to upload raw bytes:DeprecationWarning"),
]

REPOSITORY = "team/cheetah"
LABELS = {"labels": 40.0, "holdout_accuracy": 0.875}


@pytest.fixture(scope="module")
def server() -> Iterator[HubServer]:
    with hub_server() as server:
        yield server


@pytest.fixture
def signed_in(server: HubServer, tmp_path_factory, monkeypatch: pytest.MonkeyPatch) -> HubServer:
    """The client, with an empty cache, in the settings that its environment variables would give it."""
    server.repositories.clear()
    home = tmp_path_factory.mktemp("hub")
    for name in ("ENDPOINT", "HUGGINGFACE_CO_URL_TEMPLATE"):
        monkeypatch.setattr(constants, name, getattr(constants, name).replace("https://huggingface.co", server.url))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(home / "cache"))
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(home / "token"))
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    return server


@pytest.fixture
def reward(short_episodes: None) -> mapt.Reward:
    return mapt.Reward(reward_model(mean=2.0), LABELS, 5, provenance(), SHORTEST_NAME)


@pytest.fixture
def learner(short_episodes: None) -> Learner:
    settings = {"n_envs": 2, "rollout_steps": 8, "minibatches": 1, "hidden": [8], "device": "cpu"}
    return Learner(mapt.make_task(SHORTEST_NAME, 2, n_threads=1), PolicyConfig.from_dict(settings))


def files_of(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def test_a_pushed_reward_gives_equal_rewards_after_it_is_loaded(signed_in: HubServer, reward: mapt.Reward) -> None:
    url = reward.push_to_hub(REPOSITORY)
    assert url.startswith(f"{signed_in.url}/{REPOSITORY}/commit/")
    loaded = mapt.Reward.from_pretrained(REPOSITORY)
    assert (loaded.metrics, loaded.segment_steps, loaded.task) == (LABELS, 5, SHORTEST_NAME)
    assert loaded.provenance == reward.provenance
    config = reward.model.config
    inputs = (
        torch.rand(3, 5, config.n_agents, config.observation_dim),
        torch.rand(3, 5, config.n_agents, config.action_dim),
        torch.ones(3, 5, dtype=torch.bool),
    )
    with torch.no_grad():
        assert torch.equal(reward.model(*inputs).score, loaded.model(*inputs).score)


def test_the_model_card_says_what_the_reward_was_trained_on(signed_in: HubServer, reward: mapt.Reward) -> None:
    reward.push_to_hub(REPOSITORY)
    repository = signed_in.repositories[REPOSITORY]
    card = ModelCard(repository.commits[repository.head]["README.md"].decode())
    assert {"MAPT", SHORTEST_NAME, "reward-model"} <= set(card.data.tags or ())
    assert card.data.library_name == "accord"
    [result] = card.data.eval_results or ()
    assert (result.dataset_type, result.metric_type, result.metric_value) == (SHORTEST_NAME, "accuracy", 0.875)
    for fact in ("| Labels | 40 |", "87.5%", version("torch"), f'from_pretrained("{REPOSITORY}")'):
        assert fact in card.text


def test_a_pushed_policy_continues_its_training(signed_in: HubServer, learner: Learner) -> None:
    learner.collect()
    mapt.TrainedPolicy(learner, ()).push_to_hub(REPOSITORY, private=True)
    assert signed_in.repositories[REPOSITORY].private
    loaded = mapt.TrainedPolicy.from_pretrained(REPOSITORY, mapt.make_task(SHORTEST_NAME, 2, n_threads=1))
    assert loaded.learner.to_bytes() == learner.to_bytes()


def test_a_run_is_pushed_and_pulled_with_its_evaluation_and_video(
    signed_in: HubServer, learner: Learner, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    folder.claim(RunSettings(task=SHORTEST_NAME, policy=learner.config, steps=16))
    folder.checkpoint.write_bytes(PolicyCheckpoint(learner.to_bytes(), {}).to_bytes())
    folder.write_evaluation(16, Evaluation((10.0, 14.0), (20, 20)))
    folder.video.write_bytes(b"a video")
    hub.push(folder.path, REPOSITORY)
    repository = signed_in.repositories[REPOSITORY]
    assert "replay.mp4" in repository.commits[repository.head]
    card = ModelCard(repository.commits[repository.head]["README.md"].decode())
    [result] = card.data.eval_results or ()
    assert (result.metric_type, result.metric_value) == ("mean_reward", "12.00 +/- 2.00")

    hub.pull(REPOSITORY, tmp_path / "pulled")
    for path in folder.path.iterdir():
        assert (tmp_path / "pulled" / path.name).read_bytes() == path.read_bytes()
    assert load_policy(tmp_path / "pulled", "cpu").task == SHORTEST_NAME
    with pytest.raises(AlreadyExists):
        hub.pull(REPOSITORY, tmp_path / "pulled")


@pytest.mark.slow
def test_the_commands_push_and_pull(server: HubServer, reward: mapt.Reward, tmp_path: Path) -> None:
    """In a process of its own, with the environment variables of the client."""
    reward.save(tmp_path / "reward")
    environment = {
        **os.environ,
        "HF_ENDPOINT": server.url,
        "HF_HOME": str(tmp_path / "home"),
        "HF_TOKEN": TOKEN,
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    }
    script = "import sys; from mapt.cli.main import app; app(sys.argv[1:4], standalone_mode=False); app(sys.argv[4:])"
    arguments = [
        "push",
        str(tmp_path / "reward"),
        "team/by-command",
        "pull",
        "team/by-command",
        str(tmp_path / "pulled"),
    ]
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert files_of(tmp_path / "pulled") == {"README.md", "reward.json", "reward.safetensors"}
    for name in files_of(tmp_path / "reward"):
        assert (tmp_path / "pulled" / name).read_bytes() == (tmp_path / "reward" / name).read_bytes()


def test_an_older_version_is_pulled_by_its_commit(signed_in: HubServer, reward: mapt.Reward, tmp_path: Path) -> None:
    reward.push_to_hub(REPOSITORY)
    first = signed_in.repositories[REPOSITORY].head
    mapt.Reward(reward_model(seed=1), LABELS, 5, {}, SHORTEST_NAME).push_to_hub(REPOSITORY)
    assert mapt.Reward.from_pretrained(REPOSITORY, revision=first).provenance == reward.provenance
    assert mapt.Reward.from_pretrained(REPOSITORY).provenance != reward.provenance
    with pytest.raises(HubNotFound):
        hub.pull(REPOSITORY, tmp_path / "pulled", revision="v9")
    assert not (tmp_path / "pulled").exists()


def test_a_push_without_a_token_or_with_one_that_may_not_write_is_refused(
    signed_in: HubServer, reward: mapt.Reward, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(HubDenied):
        reward.push_to_hub(REPOSITORY, token="hf_of_somebody_else")
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(HubDenied):
        reward.push_to_hub(REPOSITORY)
    assert not signed_in.repositories


def test_a_missing_or_private_repository_is_not_found(
    signed_in: HubServer, reward: mapt.Reward, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reward.push_to_hub("team/secret", private=True)
    monkeypatch.delenv("HF_TOKEN")
    for name in ("team/nothing", "team/secret"):
        with pytest.raises(HubNotFound):
            hub.pull(name, tmp_path / "pulled")
    assert not (tmp_path / "pulled").exists()
    with pytest.raises(InvalidConfig) as raised:
        hub.pull("not a name", tmp_path / "pulled")
    assert raised.value.field == "repo_id"


def test_a_hub_that_is_down_or_away_changes_nothing(
    signed_in: HubServer, reward: mapt.Reward, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signed_in, "failing", 418)
    with pytest.raises(HubUnreachable):
        reward.push_to_hub(REPOSITORY)
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{unused.getsockname()[1]}")
        with pytest.raises(HubUnreachable):
            hub.pull(REPOSITORY, tmp_path / "pulled")
        with pytest.raises(HubUnreachable):
            reward.push_to_hub(REPOSITORY)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(HubUnreachable):
        reward.push_to_hub(REPOSITORY)
    assert not (tmp_path / "pulled").exists()


def test_damaged_or_foreign_repositories_are_refused(signed_in: HubServer, reward: mapt.Reward, tmp_path: Path) -> None:
    reward.push_to_hub(REPOSITORY)
    repository = signed_in.repositories[REPOSITORY]
    repository.commit({"reward.json": json.dumps({"format": "mapt.reward", "format_version": 4}).encode()})
    with pytest.raises(DamagedCheckpoint):
        hub.pull(REPOSITORY, tmp_path / "pulled")
    repository.commits[repository.commit({})] = {"README.md": b"a model of another library"}
    with pytest.raises(HubNotFound):
        hub.pull(REPOSITORY, tmp_path / "pulled")
    assert not (tmp_path / "pulled").exists()


def test_only_complete_models_are_pushed(signed_in: HubServer, tmp_path: Path) -> None:
    with pytest.raises(DamagedCheckpoint):
        hub.push(tmp_path, REPOSITORY)
    with pytest.raises(RunNotFound):
        hub.push(tmp_path / "nothing", REPOSITORY)
    assert not signed_in.repositories
