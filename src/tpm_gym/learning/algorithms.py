"""Algorithms of Stable-Baselines3, and the entries of their recipes.

A row of ``ALGORITHMS`` and a file ``train/recipes/<name>.yml`` are enough to train, resume,
evaluate and export with another algorithm. If the algorithm has an argument that is not in
``_ENTRIES`` yet, add a row there.
"""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

from pydantic import Field
from typing_extensions import Required, TypedDict

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

_keys: Any = TypedDict  # made from tables, which no type checker follows

_COUNT: Final[Any] = Annotated[int, Field(gt=0)]
_NATURAL: Final[Any] = Annotated[int, Field(ge=0)]
_POSITIVE: Final[Any] = Annotated[float, Field(gt=0)]
_NOT_NEGATIVE: Final[Any] = Annotated[float, Field(ge=0)]
_FRACTION: Final[Any] = Annotated[float, Field(gt=0, le=1)]
_NUMBER: Final = r"(\d*\.\d*[1-9]\d*|\d*[1-9]\d*\.?\d*)(e-?\d+)?"  # positive, as text
_LAYERS: Final[Any] = Annotated[list[Annotated[int, Field(gt=0, le=4096)]], Field(max_length=20)]

_POLICY_ENTRIES: Final[Mapping[str, Any]] = {
    "log_std_init": float,
    "ortho_init": bool,
    "n_critics": Annotated[int, Field(gt=0, le=100)],
    "n_quantiles": Annotated[int, Field(gt=0, le=10_000)],
    "features_extractor_class": Literal["GoalGapExtractor"],
    "features_extractor_kwargs": _keys("Extractor", {"unit": _POSITIVE}, total=False),
}
_STRATEGY: Final[Any] = Literal["future", "final", "episode"]
_HINDSIGHT: Final = {"n_sampled_goal": _COUNT, "goal_selection_strategy": _STRATEGY}
_ENTRIES: Final[Mapping[str, Any]] = {
    # lin_<start> falls linearly to zero
    "learning_rate": _POSITIVE | Annotated[str, Field(pattern=f"^lin_{_NUMBER}$")],
    "gamma": _FRACTION,
    "batch_size": _COUNT,
    "buffer_size": _COUNT,
    "learning_starts": _NATURAL,
    "tau": _FRACTION,
    "train_freq": _COUNT,
    "gradient_steps": _COUNT | Literal[-1],  # -1: as many as steps were taken
    "ent_coef": _NOT_NEGATIVE,
    "target_entropy": float | Literal["auto"],
    "target_update_interval": _COUNT,
    "top_quantiles_to_drop_per_net": _NATURAL,
    "n_steps": _COUNT,
    "n_epochs": _COUNT,
    "gae_lambda": _FRACTION,
    "clip_range": _POSITIVE,
    "vf_coef": _NOT_NEGATIVE,
    "max_grad_norm": _POSITIVE,
    "normalize_advantage": bool,
    "target_kl": _POSITIVE,
    "replay_buffer_class": Literal["HerReplayBuffer"],
    "replay_buffer_kwargs": _keys("Hindsight", _HINDSIGHT, total=False),
}
_LEARNED_ENTROPY: Final[Any] = _NOT_NEGATIVE | Annotated[str, Field(pattern=f"^auto(_{_NUMBER})?$")]
_RECORDED: Final[Any] = {"episodes": Required[_COUNT], "noise": _NOT_NEGATIVE}
_CLONED: Final[Any] = {**_RECORDED, "epochs": _COUNT}


class Actor(NamedTuple):
    """Parts of a policy that compute its mean action, as dotted names of attributes."""

    features: str  # extractor
    hidden: str  # sequence of the hidden layers
    last: str  # layer
    output: str  # function of the last layer's output: tanh or clip


_SQUASHED: Final = Actor("actor.features_extractor", "actor.latent_pi", "actor.mu", "tanh")
_CLIPPED: Final = Actor("pi_features_extractor", "mlp_extractor.policy_net", "action_net", "clip")


@dataclass(frozen=True)
class Algorithm:
    """Algorithm of Stable-Baselines3: its class as ``module:name``, and the parts to export."""

    path: str
    actor: Actor

    def load_class(self) -> type[BaseAlgorithm]:
        """Return the class; this imports PyTorch."""
        found: type[BaseAlgorithm] = pkgutil.resolve_name(self.path)
        return found

    def argument(self, given: Mapping[str, Any], name: str) -> Any:
        """Return an argument of the constructor or of the policy: the given one, or the default.

        Args:
            given: Arguments of the constructor; ``policy_kwargs`` has those of the policy.
            name: Name of the argument. The result is None if there is no such argument.
        """
        kind: Any = self.load_class()
        policy, inner = kind.policy_aliases["MultiInputPolicy"], given.get("policy_kwargs", {})
        for owner, own in ((kind, given), (policy, inner)):
            parameters = inspect.signature(owner).parameters
            if name in parameters:
                return own.get(name, parameters[name].default)
        return None

    def hyperparameters(self) -> set[str]:
        """Return the names of the constructor's arguments that a recipe can have.

        A model stores these arguments in attributes of the same names.
        """
        return _ENTRIES.keys() & inspect.signature(self.load_class()).parameters.keys()

    def entries(self) -> Any:
        """Return the type of the algorithm's recipes, a TypedDict.

        Keys are ``n_timesteps``, ``n_envs``, ``demonstrations``, and arguments of the algorithm's
        constructor. The key ``policy_kwargs`` has the arguments of the policy.
        """
        kind: Any = self.load_class()
        arguments = inspect.signature(kind).parameters
        policy = inspect.signature(kind.policy_aliases["MultiInputPolicy"]).parameters
        off_policy = "replay_buffer_class" in arguments
        found = {name: entry for name, entry in _ENTRIES.items() if name in arguments}
        if "ent_coef" in found and isinstance(arguments["ent_coef"].default, str):
            found["ent_coef"] = _LEARNED_ENTROPY
        shown = _RECORDED if off_policy else _CLONED
        found["demonstrations"] = _keys("Demonstrations", shown, total=False)
        inner = {name: entry for name, entry in _POLICY_ENTRIES.items() if name in policy}
        networks = {"pi": _LAYERS, "qf" if off_policy else "vf": _LAYERS}
        # An algorithm with a replay buffer fails if one of its two networks is missing.
        inner["net_arch"] = _LAYERS | _keys("Networks", networks, total=off_policy)
        found |= {
            "n_timesteps": Required[_COUNT],
            "n_envs": _COUNT,
            "policy": Required[Literal["MultiInputPolicy"]],
            "policy_kwargs": _keys("Policy", inner, total=False),
        }
        return _keys("Recipe", found, total=False)


ALGORITHMS: Final[dict[str, Algorithm]] = {
    "sac": Algorithm("stable_baselines3:SAC", _SQUASHED),
    "tqc": Algorithm("sb3_contrib:TQC", _SQUASHED),
    "ppo": Algorithm("stable_baselines3:PPO", _CLIPPED),
}
NAMES: Final = ", ".join(ALGORITHMS)
