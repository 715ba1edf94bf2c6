"""Hyperparameters by environment id, read from YAML in the style of rl-baselines3-zoo, and checked.

A recipe file has one mapping per environment id. Its entries are the arguments of the algorithm's
constructor, plus ``n_timesteps``, ``n_envs`` and ``policy`` as in the zoo, and ``demonstrations``:
episodes of the expert that are in the replay buffer before training starts. Values are plain YAML:
where the zoo evaluates a string such as ``"dict(net_arch=[64, 64])"`` as Python, a mapping is
written here (the zoo reads it as well), and nothing is ever evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml

from tpm_gym.learning.errors import RecipeError


class _Rule(NamedTuple):
    """What an entry has to be."""

    description: str
    accepts: Callable[[Any], bool]


def _is_int(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _one_of(*choices: str) -> _Rule:
    return _Rule(f"one of {', '.join(choices)}", lambda value: value in choices)


def _is_layers(value: object) -> bool:
    return isinstance(value, list) and all(_is_int(width) and width > 0 for width in value)


def _is_net_arch(value: object) -> bool:
    if isinstance(value, dict):
        return set(value) <= {"pi", "qf", "vf"} and all(map(_is_layers, value.values()))
    return _is_layers(value)


def _is_ent_coef(value: object) -> bool:
    if isinstance(value, str):
        return value == "auto" or value.startswith("auto_")
    return _is_number(value) and float(value) >= 0  # type: ignore[arg-type]


def _is_learning_rate(value: object) -> bool:
    if isinstance(value, str):
        return value.startswith("lin_") and _is_positive_text(value.removeprefix("lin_"))
    return _is_number(value) and float(value) > 0  # type: ignore[arg-type]


def _is_positive_text(text: str) -> bool:
    try:
        return 0 < float(text) < math.inf
    except ValueError:
        return False


_COUNT = _Rule("a positive integer", lambda value: _is_int(value) and value > 0)
_NATURAL = _Rule("an integer of at least 0", lambda value: _is_int(value) and value >= 0)
_POSITIVE = _Rule("a positive number", lambda value: _is_number(value) and value > 0)
_NOT_NEGATIVE = _Rule("a number of at least 0", lambda value: _is_number(value) and value >= 0)
_NUMBER = _Rule("a number", _is_number)
_FRACTION = _Rule("a number in (0, 1]", lambda value: _is_number(value) and 0 < value <= 1)
_FLAG = _Rule("true or false", lambda value: isinstance(value, bool))

_Rules = Mapping[str, "_Rule | _Rules"]

_NET_ARCH = _Rule("a list of positive integers, or one for each of pi, qf, vf", _is_net_arch)
_COMMON: Final[_Rules] = {
    "n_timesteps": _COUNT,
    "n_envs": _COUNT,
    "policy": _one_of("MultiInputPolicy"),
    "learning_rate": _Rule(
        "a positive number, or lin_<start> to fall linearly to zero", _is_learning_rate
    ),
    "gamma": _FRACTION,
    "batch_size": _COUNT,
}
_OFF_POLICY: Final[_Rules] = {
    **_COMMON,
    "buffer_size": _COUNT,
    "learning_starts": _NATURAL,
    "tau": _FRACTION,
    "train_freq": _COUNT,
    "gradient_steps": _Rule(
        "a positive integer, or -1 for as many as steps were taken",
        lambda value: _is_int(value) and (value > 0 or value == -1),
    ),
    "ent_coef": _Rule("auto, auto_<start>, or a number of at least 0", _is_ent_coef),
    "target_entropy": _Rule("auto or a number", lambda value: value == "auto" or _is_number(value)),
    "target_update_interval": _COUNT,
    "demonstrations": {"episodes": _COUNT, "noise": _NOT_NEGATIVE},
    "replay_buffer_class": _one_of("HerReplayBuffer"),
    "replay_buffer_kwargs": {
        "n_sampled_goal": _COUNT,
        "goal_selection_strategy": _one_of("future", "final", "episode"),
    },
}
_POLICY: Final[_Rules] = {
    "net_arch": _NET_ARCH,
    "log_std_init": _NUMBER,
    "features_extractor_class": _one_of("GoalGapExtractor"),
    "features_extractor_kwargs": {"unit": _POSITIVE},
}
_Q_POLICY: Final[_Rules] = {**_POLICY, "n_critics": _COUNT}
_RULES: Final[Mapping[str, _Rules]] = {
    "sac": {**_OFF_POLICY, "policy_kwargs": _Q_POLICY},
    "tqc": {
        **_OFF_POLICY,
        "top_quantiles_to_drop_per_net": _NATURAL,
        "policy_kwargs": {**_Q_POLICY, "n_quantiles": _COUNT},
    },
    "ppo": {
        **_COMMON,
        "n_steps": _COUNT,
        "n_epochs": _COUNT,
        "gae_lambda": _FRACTION,
        "clip_range": _POSITIVE,
        "ent_coef": _NOT_NEGATIVE,
        "vf_coef": _NOT_NEGATIVE,
        "max_grad_norm": _POSITIVE,
        "normalize_advantage": _FLAG,
        "target_kl": _POSITIVE,
        "policy_kwargs": {**_POLICY, "ortho_init": _FLAG},
    },
}
_REQUIRED: Final = ("n_timesteps", "policy")


@dataclass(frozen=True)
class Recipe:
    """How one algorithm is trained on one environment.

    Attributes:
        n_timesteps: Number of environment steps, those of the demonstrations included.
        n_envs: Number of parallel environments.
        policy: Name of the policy class.
        hindsight: Whether the replay buffer relabels goals.
        demonstrations: Arguments of :class:`demonstrations.Demonstrations`; empty for none.
        arguments: The other arguments of the algorithm's constructor.
    """

    n_timesteps: int
    n_envs: int
    policy: str
    hindsight: bool
    demonstrations: Mapping[str, Any]
    arguments: Mapping[str, Any]


def read_recipe(path: Path, algorithm: str, env_id: str) -> Recipe:
    """Read the recipe of an environment, after checking the whole file.

    Args:
        path: The YAML file.
        algorithm: ``sac``, ``tqc`` or ``ppo``.
        env_id: The environment's id.

    Raises:
        RecipeError: The file cannot be read, has no recipe for ``env_id``, or an entry anywhere in
            it is unknown or has a value it cannot have.
    """
    recipes = read_recipes(path, algorithm)
    if env_id not in recipes:
        raise RecipeError(path, "", f"no recipe for {env_id}; there are {_listed(recipes)}")
    arguments = dict(recipes[env_id])
    return Recipe(
        n_timesteps=arguments.pop("n_timesteps"),
        n_envs=arguments.pop("n_envs", 1),
        policy=arguments.pop("policy"),
        hindsight=arguments.pop("replay_buffer_class", None) is not None,
        demonstrations=arguments.pop("demonstrations", {}),
        arguments=arguments,
    )


def read_recipes(path: Path, algorithm: str) -> dict[str, dict[str, Any]]:
    """Read and check all recipes of a file: environment id -> entries.

    Args:
        path: The YAML file.
        algorithm: ``sac``, ``tqc`` or ``ppo``.

    Raises:
        RecipeError: The file cannot be read, or an entry anywhere in it is unknown or has a value
            it cannot have.
    """
    recipes = _read_mapping(path)
    for name, entries in recipes.items():
        _check(path, name, entries, _RULES[algorithm])
        _check_required(path, name, entries)
    return recipes


def _read_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds a mapping."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecipeError(path, "", f"cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RecipeError(path, "", f"is not YAML: {error}") from error
    if not isinstance(content, dict):
        raise RecipeError(path, "", "must hold one mapping per environment id")
    return content


def _check(path: Path, key: str, value: object, rule: _Rule | _Rules) -> None:
    """Check one entry, and those below it."""
    if isinstance(rule, _Rule):
        if not rule.accepts(value):
            raise RecipeError(path, key, f"must be {rule.description}, not {value!r}{_hint(value)}")
        return
    if not isinstance(value, dict):
        raise RecipeError(path, key, f"must be a mapping, not {value!r}; keys: {_listed(rule)}")
    for name, entry in value.items():
        if name not in rule:
            raise RecipeError(path, f"{key}.{name}", f"unknown key; valid keys: {_listed(rule)}")
        _check(path, f"{key}.{name}", entry, rule[name])


def _check_required(path: Path, key: str, entries: Mapping[str, Any]) -> None:
    """Check what a recipe cannot do without."""
    for name in _REQUIRED:
        if name not in entries:
            raise RecipeError(path, f"{key}.{name}", "is missing")
    if "replay_buffer_kwargs" in entries and "replay_buffer_class" not in entries:
        raise RecipeError(
            path,
            f"{key}.replay_buffer_kwargs",
            "has no effect without replay_buffer_class: HerReplayBuffer",
        )


def _hint(value: object) -> str:
    """Explain the one surprise of YAML that meets everybody who writes numbers."""
    try:
        number = float(value) if isinstance(value, str) else None
    except ValueError:
        return ""
    return "" if number is None else f" (YAML takes {value} for text; write {number!r})"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(map(str, names)))
