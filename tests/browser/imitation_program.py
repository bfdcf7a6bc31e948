"""What users of imitation run, in an environment of its own (`make test-imitation`): it needs an older gymnasium.

python imitation_program.py write FILE STEPS PAIRS   label pairs of a random policy in gymnasium's HalfCheetah
python imitation_program.py read FILE                train a reward network on a file; print what is in it, as JSON
"""

import hashlib
import json
import sys
from typing import Any

import gymnasium
import numpy as np
from imitation.algorithms import preference_comparisons as comparisons
from imitation.data import rollout
from imitation.data.wrappers import RolloutInfoWrapper
from imitation.rewards.reward_nets import BasicRewardNet
from imitation.util.util import make_vec_env

N_JOINTS = 6


class States(gymnasium.Wrapper):
    """As in docs/how-to/import.md."""

    def step(self, action: Any) -> Any:
        data = self.unwrapped.data
        before = {"qpos": data.qpos.copy(), "qvel": data.qvel.copy()}
        *seen, info = self.env.step(action)
        return *seen, info | before


def write(path: str, n_steps: str, n_pairs: str) -> None:
    rng = np.random.default_rng(0)
    wrappers = [lambda env, _: States(env), lambda env, _: RolloutInfoWrapper(env)]
    venv = make_vec_env("HalfCheetah-v4", rng=rng, n_envs=1, post_wrappers=wrappers)
    trajectories = rollout.rollout(None, venv, rollout.make_min_episodes(1), rng=rng, exclude_infos=False)
    fragments = comparisons.RandomFragmenter(rng=rng)(trajectories, int(n_steps), int(n_pairs))
    dataset = comparisons.PreferenceDataset()
    dataset.push(fragments, comparisons.SyntheticGatherer(rng=rng, temperature=0)(fragments))
    dataset.save(path)


def read(path: str) -> None:
    dataset = comparisons.PreferenceDataset.load(path)
    (first, _), _ = dataset[0]
    spaces = [gymnasium.spaces.Box(-np.inf, np.inf, each.shape[1:]) for each in (first.obs, first.acts)]
    model = comparisons.PreferenceModel(BasicRewardNet(*spaces))
    trainer = comparisons.BasicRewardTrainer(
        model, comparisons.CrossEntropyRewardLoss(), rng=np.random.default_rng(0), epochs=1
    )
    trainer.train(dataset)
    labels = {f"{joints(a)} {joints(b)}": float(label) for (a, b), label in (dataset[at] for at in range(len(dataset)))}
    print(json.dumps({"labels": labels, "infos": sorted(first.infos[0])}))


def joints(fragment: Any) -> str:
    """A name for the joint actions of a fragment, of one agent or of six."""
    return hashlib.sha256(fragment.acts.reshape(-1, N_JOINTS).astype(np.float32).tobytes()).hexdigest()


if __name__ == "__main__":
    {"write": write, "read": read}[sys.argv[1]](*sys.argv[2:])
