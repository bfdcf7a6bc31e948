"""Policies learned from stored behaviour instead of a reward: behavioural cloning, OMAR, MAGAIL and O-MAPL.

`demonstrations` reads stored segments; each algorithm has a module of its own. `mapt imitate` runs them.
"""
