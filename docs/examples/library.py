"""From a task to a policy that is trained on preferences, in one process and without the service."""

import mapt

task = mapt.make_task("HalfCheetah-6x1", n_envs=8)
replay = mapt.collect(task, steps=400)
data = mapt.label(replay.segments(50), teacher="oracle", pairs=300, seed=0)
reward = mapt.train_reward(data, "MAPT")
policy = mapt.train_policy(task, reward, algorithm="mat", steps=1_000_000)
print(mapt.evaluate(policy).describe())
reward.save("reward")
policy.save("policy.safetensors")
