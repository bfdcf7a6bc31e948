"""What an experiment's settings mean for its policy's learner; read without torch."""

from accord.domain.errors import InvalidExperiment
from accord.domain.experiment import ExperimentConfig
from mapt.errors import InvalidConfig
from mapt.policies.config import PolicyConfig


def policy_settings(config: ExperimentConfig, n_threads: int = 0) -> PolicyConfig:
    """The learner's defaults, the experiment's seed and device, then what the researcher set.

    Raises:
        InvalidExperiment: if a setting is unknown or out of its range, or a rollout is too short for a segment.
    """
    try:
        settings = PolicyConfig.from_dict(
            {"seed": config.seed, "device": config.device, "n_threads": n_threads, **config.policy}
        )
    except InvalidConfig as error:
        raise InvalidExperiment(f"policy: {error}") from error
    if config.reward_source == "preferences" and settings.rollout_steps < config.segment_steps:
        raise InvalidExperiment(
            f"segment_steps is {config.segment_steps}, but a rollout has {settings.rollout_steps} steps of each "
            f"environment, so no segment fits. Set policy.rollout_steps to {config.segment_steps} or more."
        )
    return settings
