"""Accord: the labelling service around mapt."""
