"""Benchmarks of reward models: recorded datasets, tables, figures and reports. See `mapt table` and `mapt report`."""
