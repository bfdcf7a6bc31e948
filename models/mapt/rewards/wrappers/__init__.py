"""Environments whose reward is a learned one: `gymnasium`, and `pettingzoo`, which needs that optional library."""
