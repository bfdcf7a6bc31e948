"""One process per role, each a level-triggered loop over rows, and the supervisor that keeps them running.

`stop`, `lifeline`, `pulse`, `backoff` and `loop` are what every worker shares; `render`, `reward` and `policy` are the
roles; `supervisor` and `children` are the parent.
"""
