"""The errors of training and evaluation; all derive from :class:`tpm_gym.errors.TPMError`."""

from tpm_gym.errors import TPMError


class LearningError(TPMError):
    """Root of the errors here."""


class ConfigError(LearningError, ValueError):
    """An option, a recipe, or a combination of them is not valid."""


class RunError(LearningError):
    """A run folder cannot be used as asked: it is taken, in use, not a run, or not writable."""


class CheckpointError(LearningError):
    """A checkpoint is damaged, or cannot be written."""


class PolicyError(LearningError):
    """A policy cannot be found, loaded, exported or used in the environment."""


class RolloutError(LearningError):
    """An episode delivered a value that no statistic can be made of."""
