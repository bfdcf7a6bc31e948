"""A report is written whole, of models that fit the replay, whatever attentions they have."""

import json
import sys

import numpy as np
import pytest

from mapt.cli.main import main
from mapt.cli.report import load_models
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.storage import SegmentWriter
from mapt.rewards.checkpoints import save_reward_model
from mapt.rewards.errors import ModelMismatch
from mapt.rewards.model import build_reward_model
from mapt.studies.errors import InvalidStudy
from mapt.studies.quality import predict
from mapt.studies.recording import episodes_path
from mapt.studies.report import ReportPlan, agent_names, make_report
from mapt.studies.rollout_series import rollout_series
from mapt.studies.variants import network_of

PLAN = ReportPlan("oracle", 60, None)
ALWAYS = {
    "report.html",
    "report.json",
    "histograms.png",
    "time-series.png",
    "ranks.png",
    "calibration.png",
    "agents.png",
}


def model_of(name, replay):
    return build_reward_model(network_of(f"{name}:hidden_dim=8", "small", replay.source.layout)).eval()


def test_a_report_of_several_models_has_every_picture(tmp_path, replay):
    models = {name: model_of(name, replay) for name in ("MAPT", "MA-MLP", "MA-Transformer")}
    paths = make_report(models, replay, PLAN, tmp_path / "report")
    assert {path.name for path in paths} == ALWAYS | {"step-attention.png", "agent-attention.png"}
    page = (tmp_path / "report" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 7
    assert "src='http" not in page
    numbers = json.loads((tmp_path / "report" / "report.json").read_text())
    assert [model["name"] for model in numbers["models"]] == list(models)
    assert all(np.isfinite(value) for model in numbers["models"] for value in model["metrics"].values())


def test_a_report_of_a_model_without_attention_leaves_its_pictures_out(tmp_path, replay):
    paths = make_report({"<MLP> & co": model_of("MA-MLP", replay)}, replay, PLAN, tmp_path)
    assert {path.name for path in paths} == ALWAYS
    assert "&lt;MLP&gt; &amp; co" in (tmp_path / "report.html").read_text()


def test_a_model_of_other_dimensions_is_refused_and_nothing_written(tmp_path, replay):
    layout = replay.source.layout
    other = build_reward_model(network_of("MA-MLP", "small", type(layout)(6, 2, 5, 1)))
    with pytest.raises(ModelMismatch):
        make_report({"other": other}, replay, PLAN, tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_rewards_go_along_segments_where_no_episode_was_recorded(replay):
    model = model_of("MAPT", replay)
    series = rollout_series(replay, {"MAPT": model})
    assert series.breaks == (6, 12, 18, 24)
    assert series.true.shape == series.learned["MAPT"].shape == (30,)


def test_rewards_go_along_an_episode_as_the_policy_is_given_them(replay):
    rng = np.random.default_rng(0)
    observations, actions = rng.normal(size=(1, 20, 2, 3)), rng.normal(size=(1, 20, 2, 1))
    played = SegmentArrays(observations.astype(np.float32), actions.astype(np.float32), np.arange(20)[None] < 15)
    layout = type(replay.source.layout)(20, 2, 3, 1, rewards=True)
    with SegmentWriter.create(episodes_path(replay.path), layout) as writer:
        writer.append(played, rewards=rng.normal(size=(1, 20)))
    model = model_of("MA-MLP", replay)
    series = rollout_series(replay, {"MLP": model})
    assert series.true.shape == (15,)
    expected = (predict(model, played).rewards[0, :15] - model.reward_mean.item()) / model.reward_deviation.item()
    np.testing.assert_allclose(series.learned["MLP"], expected, atol=1e-5)


def test_agents_of_our_tasks_have_names(replay):
    assert agent_names(replay) == ["agent 0", "agent 1"]
    replay.origin["task"] = "HalfCheetah-2x3"
    assert agent_names(replay) == ["back leg", "front leg"]


def test_the_command_reads_checkpoints_and_names_them(tmp_path, replay, monkeypatch):
    save_reward_model(model_of("MAPT-TPA", replay), {}).write(tmp_path / "a=b")
    assert list(load_models([str(tmp_path / "a=b")])) == ["a=b"]
    with pytest.raises(InvalidStudy, match="NAME=FOLDER"):
        load_models([str(tmp_path / "a=b"), str(tmp_path / "a=b")])
    arguments = ["--replay", replay.path, "--output", tmp_path / "report", "--pairs", 40]
    monkeypatch.setattr(sys, "argv", ["mapt", "report", f"MAPT-TPA={tmp_path / 'a=b'}", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert "MAPT-TPA" in (tmp_path / "report" / "report.html").read_text()


def test_a_checkpoint_that_is_not_there_is_told_in_one_sentence(tmp_path, replay, monkeypatch, capsys):
    arguments = [tmp_path / "nothing", "--replay", replay.path, "--output", tmp_path / "report"]
    monkeypatch.setattr(sys, "argv", ["mapt", "report", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "is missing" in capsys.readouterr().err
