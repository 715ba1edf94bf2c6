"""Errors of training and evaluation; all derive from :class:`tpm_gym.errors.TPMError`."""

from tpm_gym.errors import TPMError


class LearningError(TPMError):
    """Root of the errors of this package."""


class ConfigError(LearningError, ValueError):
    """Option, recipe, or combination of options that is not valid."""


class RunError(LearningError):
    """Run folder that is not empty, is in use, holds no run, or cannot be written."""


class CheckpointError(LearningError):
    """Checkpoint that is damaged or cannot be written."""


class PolicyError(LearningError):
    """Policy that cannot be found, loaded, exported or used in the environment."""


class RolloutError(LearningError):
    """Value in an episode's record that is not finite."""


class DivergedError(LearningError, ArithmeticError):
    """Training in which weights of the networks became infinite or NaN."""
