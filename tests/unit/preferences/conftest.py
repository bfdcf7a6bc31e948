from hypothesis import settings

# A busy machine is no failure: the first torch call of a process alone can take a second.
settings.register_profile("unhurried", deadline=None, derandomize=True)
settings.load_profile("unhurried")
