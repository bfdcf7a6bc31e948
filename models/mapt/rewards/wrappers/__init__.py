"""Environments whose reward is swapped for a learned one.

`gymnasium` needs nothing more; `pettingzoo` is a module of its own, since that library is not required.
"""
