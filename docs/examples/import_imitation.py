"""Train a reward model on a `PreferenceDataset` that imitation saved, and save it for `mapt train --reward reward`.

python docs/examples/import_imitation.py preferences.pkl
"""

import sys
from pathlib import Path

from mapt.preferences import read_imitation
from mapt.rewards import RewardConfig, TrainConfig, save_reward_model, train_reward_model


def main(path: str, folder: str = "reward") -> None:
    dataset = read_imitation(path).dataset()
    segments = dataset.segments
    print(f"{len(dataset)} comparisons of {segments.n_steps} steps of {segments.n_agents} agents")
    config = RewardConfig.named(
        "MAPT",
        observation_dim=segments.observation_dim,
        action_dim=segments.action_dim,
        n_agents=segments.n_agents,
        segment_steps=segments.n_steps,
    )
    trained = train_reward_model(dataset, config, TrainConfig())
    print(f"{trained.metrics['accuracy']:.0%} of the comparisons predicted")
    save_reward_model(trained.model, trained.metrics, segment_steps=segments.n_steps).write(Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
