"""Hyperparameters by environment id, read from YAML in the style of rl-baselines3-zoo, and checked.

A recipe file has one mapping per environment id. Its entries are the arguments of the algorithm's
constructor, plus ``n_timesteps``, ``n_envs`` and ``policy`` as in the zoo, and ``demonstrations``:
episodes of the expert that are in the replay buffer before training starts. Values are plain YAML:
where the zoo evaluates a string such as ``"dict(net_arch=[64, 64])"`` as Python, a mapping is
written here (the zoo reads it as well), and nothing is ever evaluated.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from tpm_gym.learning.algorithms import ALGORITHMS, NAMES
from tpm_gym.learning.errors import ConfigError
from tpm_gym.resources import RECIPES
from tpm_gym.simulation.engine import require_engine


@dataclass(frozen=True)
class Recipe:
    """How one algorithm is trained on one environment, as plain data.

    Attributes:
        n_timesteps: Number of environment steps, those of the demonstrations included.
        hindsight: Whether the replay buffer relabels goals.
        demonstrations: Arguments of :class:`~tpm_gym.learning.Demonstrations`; empty for none.
        arguments: The other arguments of the algorithm's constructor.
    """

    n_timesteps: int
    n_envs: int
    policy: str
    hindsight: bool
    demonstrations: Mapping[str, Any]
    arguments: Mapping[str, Any]

    def entries(self) -> dict[str, Any]:
        """Return what a file has it as."""
        optional = {
            "replay_buffer_class": "HerReplayBuffer" if self.hindsight else None,
            "demonstrations": self.demonstrations,
        }
        return {
            "n_timesteps": self.n_timesteps,
            "n_envs": self.n_envs,
            "policy": self.policy,
            **{name: value for name, value in optional.items() if value},
            **self.arguments,
        }

    def keywords(self) -> dict[str, Any]:
        """Return the keyword arguments of the algorithm's constructor, with classes for names."""
        entries = {"policy": self.policy, **self.arguments}
        if self.hindsight:
            entries["replay_buffer_class"] = "HerReplayBuffer"
        rate = entries.get("learning_rate")
        if isinstance(rate, str):
            from stable_baselines3.common.utils import LinearSchedule

            entries["learning_rate"] = LinearSchedule(float(rate.removeprefix("lin_")), 0.0, 1.0)
        return with_classes(entries)


def recipe(env_id: str, algorithm: str = "sac", engine: str | None = None) -> dict[str, Any]:
    """Return the shipped recipe of an environment as keyword arguments for Stable-Baselines3.

    For example ``SAC(env=env, **recipe("TPMReach-v0"))``. What is no argument of the constructor is
    left out: the number of steps and of environments, and the demonstrations.

    Args:
        engine: What is trained in; ``"analytic"`` has recipes of its own.

    Raises:
        ConfigError: There is none for this environment and algorithm.
        ConfigurationError: There is no such engine.
    """
    if engine is not None:
        require_engine(engine)
    return read_recipe(recipe_file(algorithm, engine), algorithm, env_id).keywords()


def recipe_file(algorithm: str, engine: str | None = None) -> Path:
    """Return the shipped recipes of an algorithm, for an engine if that has some of its own.

    Raises:
        ConfigError: There is no such algorithm.
    """
    if algorithm not in ALGORITHMS:
        raise ConfigError(f"algorithm {algorithm!r} is none of {NAMES}")
    own = RECIPES / f"{algorithm}-{engine}.yml"
    return own if own.is_file() else RECIPES / f"{algorithm}.yml"


def with_classes(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return entries of a recipe with our classes in place of their names."""
    found = dict(entries)
    if "replay_buffer_class" in found:
        from tpm_gym.learning.hindsight import PenaltyHerReplayBuffer

        found["replay_buffer_class"] = PenaltyHerReplayBuffer
    if "features_extractor_class" in found.get("policy_kwargs", {}):
        from tpm_gym.learning.features import GoalGapExtractor

        extractor = {"features_extractor_class": GoalGapExtractor}
        found["policy_kwargs"] = {**found["policy_kwargs"], **extractor}
    return found


def read_recipe(path: Path, algorithm: str, env_id: str) -> Recipe:
    """Read the recipe of an environment, ``id`` or ``module:id``, after checking the whole file.

    Raises:
        ConfigError: The file cannot be read, has no recipe for ``env_id``, or an entry anywhere in
            it is unknown or has a value it cannot have.
    """
    recipes = read_recipes(path, algorithm)
    name = env_id.rpartition(":")[2]
    if name not in recipes:
        elsewhere = [
            f"; --engine {file.stem.partition('-')[2]} has one"
            for file in RECIPES.glob(f"{algorithm}-*.yml")
            if name in read_recipes(file, algorithm)
        ]
        there = f"there are {_listed(recipes)}{''.join(elsewhere)}"
        own = "a file of yours with one is --recipe FILE"
        raise ConfigError(f"{path}: no recipe for {name}; {there}; {own}")
    arguments = dict(recipes[name])
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

    Raises:
        ConfigError: The file cannot be read, or an entry anywhere in it is unknown or has a value
            it cannot have.
    """
    recipes = _read_mapping(path)
    check_recipes(str(path), recipes, algorithm)
    return recipes


def check_recipes(source: str, recipes: Mapping[str, Any], algorithm: str) -> None:
    """Check recipes, name -> entries.

    Raises:
        ConfigError: An entry is unknown or has a value it cannot have; ``source`` is where.
    """
    kind: Any = dict[str, ALGORITHMS[algorithm].entries()]  # type: ignore[misc]
    strict = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    try:
        TypeAdapter(kind, config=strict).validate_python(recipes)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explained(error, kind)}") from error
    for name, entries in recipes.items():
        if "replay_buffer_kwargs" in entries and "replay_buffer_class" not in entries:
            where = f"{source}: {name}.replay_buffer_kwargs"
            raise ConfigError(f"{where}: no effect without replay_buffer_class: HerReplayBuffer")


def _read_mapping(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not YAML: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: must hold one mapping per environment id")
    return content


def _explained(error: ValidationError, kind: Any) -> str:
    """Name the first entry that is not valid, and what would be."""
    first = error.errors()[0]
    names = [str(name) for name in first["loc"]]
    entry = ".".join(names)
    if first["type"] == "extra_forbidden":
        valid: Any = get_args(kind)[1]
        for name in names[1:-1]:
            valid = get_type_hints(valid)[name]
        return f"{entry}: unknown key; valid keys: {_listed(get_type_hints(valid))}"
    if first["type"] == "missing":
        return f"{entry}: is missing"
    needed = first["msg"].removeprefix("Value error, ").replace("Input should", "must", 1)
    return f"{entry}: {needed}, not {first['input']!r}{_hint(first['input'])}"


def _hint(value: object) -> str:
    """Explain the one surprise of YAML that meets everybody who writes numbers."""
    try:
        number = float(value) if isinstance(value, str) else None
    except ValueError:
        return ""
    return "" if number is None else f" (YAML takes {value} for text; write {number!r})"


def _listed(names: Iterable[object]) -> str:
    return ", ".join(sorted(map(str, names)))
