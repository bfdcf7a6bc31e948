"""The key of a clip changes with every input."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from accord.rendering.clip_key import clip_key, drawn_clip_key
from mapt.rendering.settings import CodecSettings, RenderSettings
from mapt.tasks import agent_geoms, load_model

TASK = "HalfCheetah-6x1"
QPOS = np.linspace(0, 1, 45).reshape(5, 9)
QVEL = np.linspace(1, 2, 45).reshape(5, 9)
SETTINGS = RenderSettings()


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return load_model(TASK)


def key_of(model: mujoco.MjModel, **changed: object) -> str:
    inputs = {"qpos": QPOS, "qvel": QVEL, "model": model, "agent_geoms": agent_geoms(TASK), "settings": SETTINGS}
    return clip_key(**inputs | changed)


def test_equal_inputs_give_an_equal_key(model: mujoco.MjModel) -> None:
    again = key_of(load_model(TASK), qpos=QPOS.copy(), settings=RenderSettings())
    assert again == key_of(model)


def test_memory_layout_of_the_states_does_not_matter(model: mujoco.MjModel) -> None:
    assert key_of(model, qpos=np.asfortranarray(QPOS)) == key_of(model)


def test_every_input_changes_the_key(model: mujoco.MjModel) -> None:
    heavier = load_model(TASK)
    heavier.geom_size[1, 0] *= 1.01
    keys = [
        key_of(model),
        key_of(model, qpos=np.nextafter(QPOS, 2)),
        key_of(model, qvel=-QVEL),
        key_of(model, qpos=QPOS[:4], qvel=QVEL[:4]),
        key_of(model, agent_geoms=agent_geoms("HalfCheetah-2x3")),
        key_of(heavier),
        key_of(model, settings=replace(SETTINGS, quality="pretty")),
        key_of(model, settings=replace(SETTINGS, frame_rate_hz=25)),
        key_of(model, settings=replace(SETTINGS, camera="top")),
        key_of(model, settings=replace(SETTINGS, codec=CodecSettings(crf=30))),
    ]
    assert len(set(keys)) == len(keys)


def test_key_is_safe_as_a_file_name(model: mujoco.MjModel) -> None:
    assert len(key_of(model)) == 64
    assert key_of(model).isalnum()


def test_every_input_changes_the_key_of_a_drawn_clip() -> None:
    inputs = {"qpos": QPOS, "task_name": "3m", "version": 1, "settings": SETTINGS}
    changes: list[dict[str, object]] = [
        {},
        {"qpos": np.nextafter(QPOS, 2)},
        {"qpos": QPOS[:4]},
        {"task_name": "MMM2"},
        {"version": 2},
        {"settings": replace(SETTINGS, width=320)},
    ]
    keys = [drawn_clip_key(**inputs | change) for change in changes]
    assert len(set(keys)) == len(keys)
    assert drawn_clip_key(np.asfortranarray(QPOS), "3m", 1, SETTINGS) == keys[0]
