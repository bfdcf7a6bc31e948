# %% [markdown]
# # What reward models have learned
#
# A notebook of cells (`# %%`) for VS Code, PyCharm, or Jupyter with jupytext. `python docs/examples/report.py` runs
# all of them and writes `report/report.html`.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from mapt.benchmarks.recorded_dataset import Recording, record_dataset
from mapt.benchmarks.report import ReportPlan, make_report
from mapt.preferences import PreferenceDataset
from mapt.rewards import RewardConfig, TrainConfig, train_reward_model

TASK, STEPS, PAIRS, MODELS = "HalfCheetah-6x1", 100_000, 500, ("MA-MLP", "MAPT")
# Networks of this size gain little from several threads, which wait for each other where other programs run.
torch.set_num_threads(1)

# %% [markdown]
# Segments of a policy while it trains on the true reward, on disk.

# %%
recording = Recording(TASK, policy_steps=STEPS, segment_steps=50, segments=2_000, seed=0)
recorded = record_dataset(recording, Path("recorded"))
plt.hist(recorded.returns, bins=40)
plt.xlabel("true return of a segment")
plt.savefig("returns.png")

# %% [markdown]
# An oracle compares random pairs of them, and each model trains on the same labels.

# %%
rng = np.random.default_rng(0)
pairs = np.array([rng.choice(len(recorded), 2, replace=False) for _ in range(PAIRS)])
labels = np.float32(np.diff(recorded.returns[pairs], axis=1)[:, 0] < 0)
dataset = PreferenceDataset(recorded.source, pairs, labels)
models = {}
for name in MODELS:
    config = RewardConfig.named(
        name,
        observation_dim=recorded.source.observation_dim,
        action_dim=recorded.source.action_dim,
        n_agents=recorded.source.n_agents,
        segment_steps=recorded.source.n_steps,
    )
    trained = train_reward_model(dataset, config, TrainConfig())
    print(f"{name}: {trained.metrics['holdout_accuracy']:.1%} of the held-out pairs predicted")
    models[name] = trained.model

# %% [markdown]
# The report: rewards by agent, learned and true, along a rollout; calibration; weights of steps; attention.

# %%
plan = ReportPlan(teacher="oracle", n_pairs=4_000, held_out_seed=None)
for path in make_report(models, recorded, plan, Path("report")):
    print(path)
