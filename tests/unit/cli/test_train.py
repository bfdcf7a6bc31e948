"""mapt train, evaluate and curves as commands: what they print, and what they refuse in one sentence."""

import json
from pathlib import Path

import pytest

from mapt.training.run_folder import RunFolder
from support.short_cheetah import SHORTEST_NAME
from unit.training.conftest import STEPS_PER_ITERATION, reward_model, write_reward

TINY = ("n_envs=4", "rollout_steps=24", "minibatches=2", "epochs=2", "hidden=[8]")


pytestmark = pytest.mark.usefixtures("short_episodes")


def training(output: Path, *more: str | Path) -> list[str | Path]:
    settings = [word for setting in TINY for word in ("--set", setting)]
    steps = str(2 * STEPS_PER_ITERATION)
    return [
        *("train", "--task", SHORTEST_NAME, "--steps", steps, "--device", "cpu", "--no-video", "--output", output),
        *settings,
        *more,
    ]


def test_seeds_are_trained_measured_and_compared(mapt, tmp_path):
    trained = mapt(*training(tmp_path / "runs", "--seed", "0,1"))
    assert trained.status == 0, trained.errors
    assert trained.printed.count("true return") >= 2
    for seed in (0, 1):
        settings = RunFolder(tmp_path / "runs" / f"seed-{seed}").settings()
        assert (settings.policy.seed, settings.policy.hidden, settings.reward) == (seed, (8,), None)

    told = mapt("evaluate", tmp_path / "runs" / "seed-1", "--episodes", "3", "--json", "--device", "cpu")
    found = json.loads(told.printed)
    assert found["steps"] == 2 * STEPS_PER_ITERATION
    assert len(found["returns"]) == found["episodes"] == 3
    assert "over 3 episodes of 20 steps" in mapt("evaluate", tmp_path / "runs" / "seed-1", "--episodes", "3").printed

    drawn = mapt("curves", tmp_path / "runs", "--output", tmp_path / "a" / "c.png", "--table", tmp_path / "b" / "t.md")
    assert drawn.status == 0, drawn.errors
    assert (tmp_path / "a" / "c.png").exists()
    assert f"| {SHORTEST_NAME} | mappo | true |" in (tmp_path / "b" / "t.md").read_text()


def test_a_finished_run_is_not_trained_again(mapt, tmp_path):
    mapt(*training(tmp_path))
    before = RunFolder(tmp_path / "seed-0").metrics.read_bytes()
    assert mapt(*training(tmp_path)).status == 0
    assert RunFolder(tmp_path / "seed-0").metrics.read_bytes() == before


def test_what_a_reward_looks_back_on_is_on_its_card_or_has_to_be_said(mapt, tmp_path):
    write_reward(tmp_path / "told", reward_model(), segment_steps=7)
    write_reward(tmp_path / "silent", reward_model(), segment_steps=None)
    assert mapt(*training(tmp_path / "a", "--reward", tmp_path / "told")).status == 0
    refused = mapt(*training(tmp_path / "b", "--reward", tmp_path / "silent"))
    assert (refused.status, "--segment-steps" in refused.errors) == (2, True)
    said = mapt(*training(tmp_path / "b", "--reward", tmp_path / "silent", "--segment-steps", "4"))
    assert said.status == 0, said.errors
    steps = [RunFolder(tmp_path / name / "seed-0").settings().reward for name in "ab"]
    assert [reward.segment_steps for reward in steps if reward] == [7, 4]


def test_a_reward_is_taken_as_the_service_keeps_it(mapt, tmp_path):
    write_reward(tmp_path, reward_model())
    for name, kept in (("reward.safetensors", "rwb_1.safetensors"), ("reward.json", "rwb_1.json")):
        (tmp_path / name).rename(tmp_path / kept)
    trained = mapt(*training(tmp_path / "run", "--reward", tmp_path / "rwb_1.safetensors"))
    assert trained.status == 0, trained.errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "learning_rte=1"], "learning_rte"),
        (["--set", "learning_rate"], "'learning_rate' is no KEY=VALUE"),
        (["--set", "learning_rate=fast"], "must be of type float"),
        (["--set", "seed=3"], "give --seed instead"),
        (["--algorithm", "ppo"], "one of mappo, happo, mat, mat_dec"),
        (["--task", "Cheetah"], "No task is called 'Cheetah'"),
        (["--seed", "0,0"], "--seed '0,0'"),
        (["--reward", "nowhere"], "reward.safetensors is missing"),
        (["--reward", "nowhere", "--segment-steps", "5"], "reward.safetensors is missing"),
        (["--device", "tpu"], "auto, cpu or cuda"),
    ],
)
def test_what_cannot_be_trained_is_refused_in_one_sentence(mapt, tmp_path, arguments, message):
    ended = mapt(*training(tmp_path / "run", *arguments))
    assert ended.status == 2
    assert message in ended.errors
    assert ended.errors.count("\n") == 1
    assert not (tmp_path / "run" / "seed-0" / "run.json").exists()


def test_a_folder_of_another_run_is_refused(mapt, tmp_path):
    mapt(*training(tmp_path))
    for more, message in (
        (("--set", "clip=0.3"), "policy.clip: 0.1, not 0.3"),
        (("--set", "n_envs=8"), "policy.n_envs: 4, not 8"),
        (("--task", "Ant-4x2"), f"task: {SHORTEST_NAME}, not Ant-4x2"),
    ):
        ended = mapt(*training(tmp_path, *more))
        assert ended.status == 2
        assert message in ended.errors


@pytest.mark.parametrize("command", [["evaluate"], ["curves", "--output", "c.png"]])
def test_a_folder_without_a_run_is_told(mapt, tmp_path, command):
    ended = mapt(*command, tmp_path)
    assert ended.status == 2
    assert "holds no run" in ended.errors
