from hypothesis import settings

# A busy machine is no failure.
settings.register_profile("unhurried", deadline=None, derandomize=True)
settings.load_profile("unhurried")
