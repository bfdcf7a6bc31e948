"""Studies of reward models: recorded replays, the table of variants, the report on a trained model."""
