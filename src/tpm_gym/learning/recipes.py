"""Recipes: hyperparameters by environment id, read from YAML and checked.

A file has one mapping for each environment id, in the style of rl-baselines3-zoo. Entries are the
arguments of the algorithm's constructor, plus ``n_timesteps``, ``n_envs``, ``policy``, and
``demonstrations``: episodes of the expert from which the policy learns before training starts.
Values are plain YAML, and nothing is evaluated. Where the zoo evaluates a string such as
``"dict(net_arch=[64, 64])"``, a recipe here has a mapping, which the zoo reads too. A file for
several algorithms has the recipes of each algorithm under its name: ``ppo``, ``sac``, ``tqc``.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from tpm_gym.envs.ids import env_ids
from tpm_gym.learning.algorithms import ALGORITHMS, NAMES
from tpm_gym.learning.errors import ConfigError
from tpm_gym.resources import RECIPES
from tpm_gym.simulation.engine import require_engine


@dataclass(frozen=True)
class Recipe:
    """Hyperparameters of one algorithm on one environment, as plain data.

    Attributes:
        n_timesteps: Number of environment steps, including the demonstrations.
        hindsight: Whether the replay buffer relabels goals.
        demonstrations: Arguments of :class:`~tpm_gym.learning.Demonstrations`; empty for none.
        arguments: Other arguments of the algorithm's constructor.
        written_for: Environment id that the recipe has in the recipe file.
    """

    n_timesteps: int
    n_envs: int
    policy: str
    hindsight: bool
    demonstrations: Mapping[str, Any]
    arguments: Mapping[str, Any]
    written_for: str = ""

    def entries(self) -> dict[str, Any]:
        """Return the recipe as it stands in a file."""
        found = {"n_timesteps": self.n_timesteps, "n_envs": self.n_envs, "policy": self.policy}
        if self.hindsight:
            found["replay_buffer_class"] = "HerReplayBuffer"
        if self.demonstrations:
            found["demonstrations"] = self.demonstrations
        return {**found, **self.arguments}

    def keywords(self, update: float = 0.0) -> dict[str, Any]:
        """Return keyword arguments for the algorithm's constructor, with classes, not their names.

        Args:
            update: Steps between two updates, as a fraction of all steps. If the learning
                rate falls, its last value is its first value multiplied by this fraction. With
                ``update=0``, as in Stable-Baselines3, the last value is zero, so the last update
                changes nothing.
        """
        entries = self.entries()
        for name in ("n_timesteps", "n_envs", "demonstrations"):
            entries.pop(name, None)
        rate = entries.get("learning_rate")
        if isinstance(rate, str):
            entries["learning_rate"] = partial(_falling, float(rate.removeprefix("lin_")), update)
        return with_classes(entries)


def _falling(start: float, update: float, remaining: float) -> float:
    """Return the learning rate of an update.

    Args:
        start: Learning rate at the start of the training.
        update: Steps between two updates, as a fraction of all steps.
        remaining: Steps after this update, as a fraction of all steps.
    """
    return start * max(0.0, min(1.0, remaining + update))


def recipe(env_id: str, algorithm: str = "sac", engine: str | None = None) -> dict[str, Any]:
    """Return the shipped recipe of an environment as keyword arguments for Stable-Baselines3.

    For example ``SAC(env=env, **recipe("TPMReach-v0"))``. ``n_timesteps``, ``n_envs`` and
    ``demonstrations`` are left out, since the algorithm's constructor has no such arguments. An id
    without a recipe gets the recipe of pick-and-place.

    Args:
        engine: Engine to train in; ``"analytic"`` has recipes of its own.

    Raises:
        ConfigError: There is no recipe for this environment and algorithm.
        ConfigurationError: There is no such engine.
    """
    if engine is not None:
        require_engine(engine)
    return read_recipe(recipe_file(algorithm, engine), algorithm, env_id).keywords()


def recipe_file(algorithm: str, engine: str | None = None) -> Path:
    """Return the file of an algorithm's shipped recipes; an engine may have its own file."""
    if algorithm not in ALGORITHMS:
        raise ConfigError(f"algorithm {algorithm!r} is none of {NAMES}")
    own = RECIPES / f"{algorithm}-{engine}.yml"
    return own if own.is_file() else RECIPES / f"{algorithm}.yml"


def algorithm_for(env_id: str, engine: str | None = None, path: Path | None = None) -> str:
    """Return the alphabetically first algorithm with a recipe for an id.

    If no algorithm has a recipe for the id, return the first algorithm for which
    :func:`read_recipe` returns the recipe of pick-and-place instead. If there is no such algorithm
    either, return ``"sac"``.

    Args:
        env_id: ``id`` or ``module:id``.
        engine: Engine to train in.
        path: File of the recipes; None for the shipped ones.
    """
    found = {}
    for algorithm in sorted(ALGORITHMS):
        with suppress(ConfigError):  # complete() raises it again for the chosen algorithm
            recipe = read_recipe(path or recipe_file(algorithm, engine), algorithm, env_id)
            found[algorithm] = recipe.written_for
    own = [algorithm for algorithm, name in found.items() if name == env_id.rpartition(":")[2]]
    return next(iter([*own, *found]), "sac")


def shipped_for(env_id: str) -> list[str]:
    """Return the options of ``tpm-gym train`` that select the shipped recipes for an id."""
    found = []
    for file in sorted(RECIPES.glob("*.yml"), key=lambda file: file.stem):
        algorithm, _, engine = file.stem.partition("-")
        if env_id.rpartition(":")[2] in read_recipes(file, algorithm):
            found.append(f"--algo {algorithm}" + (f" --engine {engine}" if engine else ""))
    return found


def with_classes(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of a recipe's entries in which classes replace their names."""
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

    An id without a recipe gets the recipe of pick-and-place, but without the demonstrations.
    """
    recipes = read_recipes(path, algorithm)
    module, _, name = env_id.rpartition(":")
    known = "TPMPickAndPlace" + "".join(re.findall(r"(?:Joints)?(?:Dense)?-v", name)[-1:]) + "0"
    if (module or name in env_ids()) and name not in recipes and known in recipes:
        name = known
        recipes[name].pop("demonstrations", None)
    if name not in recipes:
        elsewhere = "".join(f"; {options} has one" for options in shipped_for(name)[:1])
        there = f"it has {', '.join(recipes) or 'none'}{elsewhere}"
        own = "a file of yours with one is --recipe FILE"
        raise ConfigError(f"{path}: no recipe of {algorithm} for {name}; {there}; {own}")
    arguments = dict(recipes[name])
    return Recipe(
        n_timesteps=arguments.pop("n_timesteps"),
        n_envs=arguments.pop("n_envs", 1),
        policy=arguments.pop("policy"),
        hindsight=arguments.pop("replay_buffer_class", None) is not None,
        demonstrations=arguments.pop("demonstrations", {}),
        arguments=arguments,
        written_for=name,
    )


def read_recipes(path: Path, algorithm: str) -> dict[str, dict[str, Any]]:
    """Read and check all recipes of a file: environment id -> entries of its recipe."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: is not YAML: {error}") from error
    if isinstance(content, dict) and content and content.keys() <= ALGORITHMS.keys():
        content = content.get(algorithm, {})
    check_recipes(str(path), content, algorithm)
    found: dict[str, dict[str, Any]] = content
    return found


def check_recipes(source: str, recipes: Any, algorithm: str) -> None:
    """Raise ConfigError if recipes have an unknown key or an invalid value.

    Args:
        source: File or option that the message names as the origin of the recipes.
        recipes: Entries of each recipe, by name.
    """
    entries = ALGORITHMS[algorithm].entries()
    kind: Any = dict[str, entries]  # type: ignore[valid-type]
    strict = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    try:
        TypeAdapter(kind, config=strict).validate_python(recipes)
    except ValidationError as error:
        first, *_ = found = error.errors()
        # A value of several types has an error for each.
        place = first["loc"][:2]
        keyed = "missing", "extra_forbidden"
        problems = [
            e["msg"] + (f" ({e['loc'][-1]})" if e["type"] in keyed and e is not first else "")
            for e in found
            if e["loc"][:2] == place
        ]
        problem = " or ".join(dict.fromkeys(problems))
        if first["type"] == "extra_forbidden" and len(first["loc"]) == 2:
            problem = f"unknown key; valid keys: {', '.join(sorted(get_type_hints(entries)))}"
        where = ".".join(map(str, first["loc"]))
        raise ConfigError(f"{source}: {where}: {problem}, not {first['input']!r:.100}") from error
    for name, recipe in recipes.items():
        policy = recipe.get("policy_kwargs", {})
        for part, key, kind in (
            (recipe, "replay_buffer", "HerReplayBuffer"),
            (policy, "features_extractor", "GoalGapExtractor"),
        ):
            if f"{key}_kwargs" in part and f"{key}_class" not in part:
                where = f"{source}: {name}.{key}_kwargs"
                raise ConfigError(f"{where}: no effect without {key}_class: {kind}")
        dropped = ALGORITHMS[algorithm].argument(recipe, "top_quantiles_to_drop_per_net")
        there = ALGORITHMS[algorithm].argument(recipe, "n_quantiles")
        if dropped is not None and dropped >= there:
            where = f"{source}: {name}.top_quantiles_to_drop_per_net"
            raise ConfigError(f"{where}: must be less than n_quantiles, {there}, not {dropped}")
