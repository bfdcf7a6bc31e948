import hashlib
import json

import pytest
import torch
from safetensors.torch import save

from mapt.errors import DamagedCheckpoint, NewerCheckpoint
from mapt.rewards.checkpoints import CARD_FILE, WEIGHTS_FILE, load_reward_model, save_reward_model

METRICS = {"holdout_loss": 0.25, "labels": 20.0}


def test_round_trip_gives_the_same_bits(build, variant):
    model = build(**variant)
    model.set_reward_scale(0.7, 2.5)
    saved = save_reward_model(model, METRICS)
    loaded = load_reward_model(saved.weights, saved.card)
    assert loaded.metrics == METRICS
    assert loaded.model.config == model.config
    assert not loaded.model.training
    assert loaded.model.state_dict().keys() == model.state_dict().keys()
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name], tensor), name
    assert save_reward_model(loaded.model, METRICS) == saved


def test_the_further_weights_of_format_4_are_left_out(build):
    model = build()
    stored = {**model.state_dict(), **{f"judged.{name}": 2 * tensor for name, tensor in model.state_dict().items()}}
    saved = save_reward_model(model, METRICS)
    weights = save({name: tensor.contiguous() for name, tensor in stored.items()})
    card = edited(saved.card, format_version=4, weights_sha256=hashlib.sha256(weights).hexdigest())
    loaded = load_reward_model(weights, card).model
    assert all(torch.equal(loaded.state_dict()[name], tensor) for name, tensor in model.state_dict().items())


def test_model_loads_from_files(build, tmp_path):
    model = build()
    save_reward_model(model, METRICS).write(tmp_path / "version-3")
    folder = tmp_path / "version-3"
    loaded = load_reward_model(folder / WEIGHTS_FILE, folder / CARD_FILE).model
    assert torch.equal(loaded.embedding.observation.weight, model.embedding.observation.weight)


def test_card_documents_the_model(build):
    model = build()
    model.set_reward_scale(0.5, 2.0)
    card = json.loads(save_reward_model(model, METRICS).card)
    assert (card["format_version"], card["networks"]) == (6, 1)
    assert "1 segment 0" in card["polarity"]
    assert (card["reward_mean"], card["reward_deviation"]) == (0.5, 2.0)
    assert card["config"]["n_agents"] == 3
    assert (card["score"], json.loads(save_reward_model(build(segment_steps=5), {}).card)["score"]) == ("mean", "sum")


def edited(card: bytes, **changes: object) -> bytes:
    return json.dumps({**json.loads(card), **changes}).encode()


def test_newer_format_is_refused(build):
    saved = save_reward_model(build(), METRICS)
    with pytest.raises(NewerCheckpoint):
        load_reward_model(saved.weights, edited(saved.card, format_version=7))


def test_model_of_format_1_loads(build):
    model = build()
    saved = save_reward_model(model, METRICS)
    config = json.loads(saved.card)["config"]
    for added_later in ("architecture", "discrete_actions", "segment_steps"):
        del config[added_later]
    loaded = load_reward_model(saved.weights, edited(saved.card, format_version=1, config=config)).model
    assert loaded.config == model.config


def test_model_of_format_2_keeps_its_mean_score(build):
    model = build(segment_steps=5)
    saved = save_reward_model(model, METRICS)
    config = json.loads(saved.card)["config"]
    del config["segment_steps"]
    loaded = load_reward_model(saved.weights, edited(saved.card, format_version=2, config=config)).model
    assert loaded.config.score == "mean"
    observations, actions = torch.randn(1, 3, 3, 4), torch.randn(1, 3, 3, 2)
    mask = torch.ones(1, 3, dtype=torch.bool)
    expected = model(observations, actions, mask).score * 5 / 3
    torch.testing.assert_close(loaded(observations, actions, mask).score, expected)


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "something else"},
        {"format_version": 0},
        {"format_version": "1"},
        {"weights_sha256": "0" * 64},
        {"config": None},
        {"config": {"observation_dim": 4}},
        {"metrics": None},
        {"metrics": {"loss": "low"}},
    ],
)
def test_altered_card_is_refused(build, changes):
    saved = save_reward_model(build(), METRICS)
    with pytest.raises(DamagedCheckpoint):
        load_reward_model(saved.weights, edited(saved.card, **changes))


@pytest.mark.parametrize("card", [b"", b"\xff\xfe", b"[]", b"{"])
def test_invalid_card_is_refused(build, card):
    with pytest.raises(DamagedCheckpoint):
        load_reward_model(save_reward_model(build(), METRICS).weights, card)


def test_truncated_weights_are_refused(build):
    saved = save_reward_model(build(), METRICS)
    with pytest.raises(DamagedCheckpoint):
        load_reward_model(saved.weights[:-1], saved.card)


def test_weights_of_another_network_are_refused(build):
    saved, other = save_reward_model(build(), METRICS), save_reward_model(build(cpa=False), METRICS)
    card = edited(saved.card, weights_sha256=json.loads(other.card)["weights_sha256"])
    with pytest.raises(DamagedCheckpoint):
        load_reward_model(other.weights, card)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(DamagedCheckpoint):
        load_reward_model(tmp_path / WEIGHTS_FILE, tmp_path / CARD_FILE)


def test_nan_metric_is_refused(build):
    with pytest.raises(ValueError, match="not JSON compliant"):
        save_reward_model(build(), {"loss": float("nan")})


def test_card_keeps_segment_steps(build):
    saved, without_steps = save_reward_model(build(), {}, segment_steps=50), save_reward_model(build(), {})
    assert load_reward_model(saved.weights, saved.card).segment_steps == 50
    assert load_reward_model(without_steps.weights, without_steps.card).segment_steps is None
    with pytest.raises(DamagedCheckpoint):
        load_reward_model(saved.weights, edited(saved.card, segment_steps="fifty"))


def test_sha256_identifies_the_weights(build):
    model = build()
    first = save_reward_model(model, METRICS)
    model.set_reward_scale(0.7, 2.5)
    other = save_reward_model(model, METRICS)
    hashes = [load_reward_model(saved.weights, saved.card).sha256 for saved in (first, first, other)]
    assert hashes[0] == hashes[1] != hashes[2]
