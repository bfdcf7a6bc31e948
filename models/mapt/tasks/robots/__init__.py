"""One module per robot: its rewards, start states, terminations and partitions among agents."""
