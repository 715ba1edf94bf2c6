"""The algorithms: all that the code knows about one is its row in the table, and its recipes.

A row with the entries that its recipes may have, and ``train/recipes/<name>.yml``, is what it takes
to train, resume, evaluate, export and study with another algorithm of Stable-Baselines3.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias

from pydantic import Field, ValidationError, WrapValidator
from typing_extensions import Required, TypedDict

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


def _says(description: str) -> WrapValidator:
    """Say what an entry has to be, where its types would say it in several messages."""

    def check(value: Any, validate: Callable[[Any], Any]) -> Any:
        try:
            return validate(value)
        except ValidationError as error:
            raise ValueError(f"must be {description}") from error

    return WrapValidator(check)


_NUMBER: Final = r"(\d*\.\d*[1-9]\d*|\d*[1-9]\d*\.?\d*)(e-?\d+)?"  # positive, as text

_Count: TypeAlias = Annotated[int, Field(gt=0)]
_Positive: TypeAlias = Annotated[float, Field(gt=0)]
_NotNegative: TypeAlias = Annotated[float, Field(ge=0)]
_Fraction: TypeAlias = Annotated[float, Field(gt=0, le=1)]
_Layers: TypeAlias = list[_Count]
_NetArch: TypeAlias = Annotated[
    _Layers | dict[Literal["pi", "qf", "vf"], _Layers],
    _says("a list of positive integers, or one for each of pi, qf, vf"),
]
_LearningRate: TypeAlias = Annotated[
    _Positive | Annotated[str, Field(pattern=f"^lin_{_NUMBER}$")],
    _says("a positive number, or lin_<start> to fall linearly to zero"),
]


class _Policy(TypedDict, total=False):
    net_arch: _NetArch
    log_std_init: float
    features_extractor_class: Literal["GoalGapExtractor"]
    features_extractor_kwargs: _Unit


class _Unit(TypedDict, total=False):
    unit: _Positive


class _Critics(_Policy, total=False):
    n_critics: _Count


class _Quantiles(_Critics, total=False):
    n_quantiles: _Count


class _ActorCritic(_Policy, total=False):
    ortho_init: bool


class _Hindsight(TypedDict, total=False):
    n_sampled_goal: _Count
    goal_selection_strategy: Literal["future", "final", "episode"]


class _Demonstrations(TypedDict, total=False):
    episodes: Required[_Count]
    noise: _NotNegative


class _Common(TypedDict, total=False):
    n_timesteps: Required[_Count]
    n_envs: _Count
    policy: Required[Literal["MultiInputPolicy"]]
    learning_rate: _LearningRate
    gamma: _Fraction
    batch_size: _Count


class _OffPolicy(_Common, total=False):
    buffer_size: _Count
    learning_starts: Annotated[int, Field(ge=0)]
    tau: _Fraction
    train_freq: _Count
    gradient_steps: Annotated[
        _Count | Literal[-1], _says("a positive integer, or -1 for as many as steps were taken")
    ]
    ent_coef: Annotated[
        _NotNegative | Annotated[str, Field(pattern=f"^auto(_{_NUMBER})?$")],
        _says("auto, auto_<start>, or a number of at least 0"),
    ]
    target_entropy: Annotated[float | Literal["auto"], _says("auto or a number")]
    target_update_interval: _Count
    demonstrations: _Demonstrations
    replay_buffer_class: Literal["HerReplayBuffer"]
    replay_buffer_kwargs: _Hindsight


class _SAC(_OffPolicy, total=False):
    policy_kwargs: _Critics


class _TQC(_OffPolicy, total=False):
    top_quantiles_to_drop_per_net: Annotated[int, Field(ge=0)]
    policy_kwargs: _Quantiles


class _PPO(_Common, total=False):
    n_steps: _Count
    n_epochs: _Count
    gae_lambda: _Fraction
    clip_range: _Positive
    ent_coef: _NotNegative
    vf_coef: _NotNegative
    max_grad_norm: _Positive
    normalize_advantage: bool
    target_kl: _Positive
    policy_kwargs: _ActorCritic


@dataclass(frozen=True)
class Actor:
    """Where a policy computes its mean action, as an export takes it.

    Attributes:
        features: Attribute of the policy, dotted: the features extractor.
        hidden: The layers between; a sequence of modules.
        last: The last layer.
        output: What is done with its output: ``tanh`` or ``clip``.
    """

    features: str
    hidden: str
    last: str
    output: str


_SQUASHED: Final = Actor("actor.features_extractor", "actor.latent_pi", "actor.mu", "tanh")
_CLIPPED: Final = Actor("pi_features_extractor", "mlp_extractor.policy_net", "action_net", "clip")


@dataclass(frozen=True)
class Algorithm:
    """One algorithm.

    Attributes:
        path: Its class, as ``module:name``.
        entries: The entries of its recipes.
        actor: What an export takes.
    """

    path: str
    entries: type[Any]
    actor: Actor

    def load_class(self) -> type[BaseAlgorithm]:
        """Return the class; this imports PyTorch."""
        module, _, name = self.path.partition(":")
        found: type[BaseAlgorithm] = getattr(importlib.import_module(module), name)
        return found


ALGORITHMS: Final[dict[str, Algorithm]] = {
    "sac": Algorithm("stable_baselines3:SAC", _SAC, _SQUASHED),
    "tqc": Algorithm("sb3_contrib:TQC", _TQC, _SQUASHED),
    "ppo": Algorithm("stable_baselines3:PPO", _PPO, _CLIPPED),
}
NAMES: Final = ", ".join(ALGORITHMS)
