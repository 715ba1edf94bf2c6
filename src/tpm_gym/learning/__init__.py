"""Training of policies: hindsight, features, demonstrations, recipes.

This package needs the extra ``train``. Importing the package imports neither PyTorch nor
Stable-Baselines3. A name is imported when it is first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from tpm_gym.errors import MissingPackageError

if TYPE_CHECKING:
    from tpm_gym.learning.configuration import EnvOptions as EnvOptions
    from tpm_gym.learning.configuration import ResumeConfig as ResumeConfig
    from tpm_gym.learning.configuration import TrainingConfig as TrainingConfig
    from tpm_gym.learning.datasets import CollectConfig as CollectConfig
    from tpm_gym.learning.datasets import collect as collect
    from tpm_gym.learning.demonstrations import Demonstrations as Demonstrations
    from tpm_gym.learning.errors import LearningError as LearningError
    from tpm_gym.learning.evaluation import EvaluationConfig as EvaluationConfig
    from tpm_gym.learning.evaluation import evaluate as evaluate
    from tpm_gym.learning.export import save_policy as save_policy
    from tpm_gym.learning.features import GoalGapExtractor as GoalGapExtractor
    from tpm_gym.learning.hindsight import PenaltyHerReplayBuffer as PenaltyHerReplayBuffer
    from tpm_gym.learning.recipes import recipe as recipe
    from tpm_gym.learning.training import resume as resume
    from tpm_gym.learning.training import train as train
    from tpm_gym.learning.vec_env import AnalyticVecEnv as AnalyticVecEnv

_MODULES = {
    "AnalyticVecEnv": "vec_env",
    "CollectConfig": "datasets",
    "Demonstrations": "demonstrations",
    "EnvOptions": "configuration",
    "EvaluationConfig": "evaluation",
    "GoalGapExtractor": "features",
    "LearningError": "errors",
    "PenaltyHerReplayBuffer": "hindsight",
    "ResumeConfig": "configuration",
    "TrainingConfig": "configuration",
    "collect": "datasets",
    "evaluate": "evaluation",
    "recipe": "recipes",
    "resume": "training",
    "save_policy": "export",
    "train": "training",
}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a public name from its module (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
    except ModuleNotFoundError as error:
        raise MissingPackageError(error.name or "a package", "train") from error
    return getattr(module, name)
