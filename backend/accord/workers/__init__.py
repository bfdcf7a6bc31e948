"""The worker processes: each polls the database for work of its role, claims it and does it.

`reward_worker`, `policy_worker` and `render_worker` are the roles. `query_planner` runs in a thread of the reward
worker. All share `runner` and `heartbeat`; `supervisor` starts and restarts them.
"""
