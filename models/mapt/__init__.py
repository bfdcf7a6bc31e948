"""MAPT: preference learning and training for teams of agents, as a library."""
