"""What a training run is to do: the options of the command line, completed and checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import gymnasium as gym

from tpm_gym.learning.errors import ConfigError, ResumeConflictError, UnknownEnvError
from tpm_gym.learning.options import default
from tpm_gym.learning.recipes import Recipe, read_recipe
from tpm_gym.learning.rollout import SELECTION_SEED, TEST_SEED
from tpm_gym.resources import RECIPES

_ALGO: Final = "sac"
_ENV: Final = "TPMReach-v0"
_SEED: Final = 0
_EVAL_EPISODES: Final = 20
_PENALTY_WEIGHT: Final = 1.0
_GOALS: Final = "sampled"
_FIXED: Final = ("algo", "env", "seed", "envs", "eval_episodes", "penalty_weight", "goals")


@dataclass(frozen=True)
class Config:
    """Train a policy on a tpm_gym environment."""

    algo: Annotated[Literal["sac", "tqc", "ppo"] | None, default(_ALGO, "{sac,tqc,ppo}")] = None
    """Algorithm. SAC and TQC use hindsight replay on sparse rewards; PPO wants a Dense id."""

    env: Annotated[str | None, default(_ENV, "ID")] = None
    """Environment id."""

    seed: Annotated[int | None, default(_SEED, "INT")] = None
    """Seed of the networks, the exploration and the first training environment."""

    steps: Annotated[int | None, default("as the recipe says", "INT")] = None
    """Environment steps, over all environments."""

    envs: Annotated[int | None, default("as the recipe says", "INT")] = None
    """Parallel environments, in processes of their own if several."""

    recipe: Annotated[Path | None, default("train/recipes/<algo>.yml", "PATH")] = None
    """YAML file of hyperparameters by environment id."""

    run: Annotated[Path | None, default("runs/<env>-<algo>-s<seed>", "FOLDER")] = None
    """Folder of the run."""

    penalty_weight: Annotated[float | None, default(_PENALTY_WEIGHT, "FLOAT")] = None
    """Weight of the singularity penalty in the reward; 0 switches it off."""

    goals: Annotated[
        Literal["sampled", "tempting"] | None, default(_GOALS, "{sampled,tempting}")
    ] = None
    """As the environment samples them, or goals that tempt towards the singularity; in training and
    in its evaluations."""

    eval_every: Annotated[int | None, default("a tenth of the steps", "INT")] = None
    """Steps between evaluations on held-out seeds."""

    eval_episodes: Annotated[int | None, default(_EVAL_EPISODES, "INT")] = None
    """Episodes per evaluation."""

    checkpoint_every: Annotated[int | None, default("by time", "INT")] = None
    """Steps between checkpoints. By time means every half minute, or less often where that would
    take more than 2% of the time."""

    threads: Annotated[int | None, default("1", "INT")] = None
    """Threads of PyTorch. With one thread and one environment a seed repeats exactly."""

    device: Annotated[str | None, default("cpu", "NAME")] = None
    """Device of PyTorch. The networks are small; a GPU pays only with large batches."""

    overwrite: bool = False
    """Replace an earlier run in the same folder."""

    resume: bool = False
    """Go on from the last checkpoint of the run. Everything is as the run has it; --steps may be
    raised, and --eval-every, --checkpoint-every, --threads and --device may be changed."""


@dataclass(frozen=True)
class Plan:
    """A configuration with every default filled in and checked.

    Attributes:
        algo: Algorithm.
        env: Environment id.
        seed: Seed; environment i of the training starts from ``seed + i``.
        steps: Environment steps.
        envs: Parallel environments.
        recipe_file: Where the recipe was read.
        recipe: The hyperparameters.
        run: The run folder.
        eval_every: Steps between evaluations.
        eval_episodes: Episodes per evaluation.
        checkpoint_every: Steps between checkpoints; None: by time.
        threads: Threads of PyTorch.
        device: Device of PyTorch.
        penalty_weight: Weight of the singularity penalty.
        goals: ``sampled`` or ``tempting``.
    """

    algo: str
    env: str
    seed: int
    steps: int
    envs: int
    recipe_file: Path
    recipe: Recipe
    run: Path
    eval_every: int
    eval_episodes: int
    checkpoint_every: int | None
    threads: int
    device: str
    penalty_weight: float = _PENALTY_WEIGHT
    goals: str = _GOALS

    @property
    def title(self) -> str:
        """One line that names the run."""
        method = self.algo.upper() + (" + HER" if self.recipe.hindsight else "")
        return f"{self.env}   {method}, seed {self.seed}"


def run_folder(config: Config) -> Path:
    """Return the folder of a run."""
    name = f"{config.env or _ENV}-{config.algo or _ALGO}-s{config.seed or _SEED}"
    return config.run or Path("runs", name)


def make_plan(config: Config) -> Plan:
    """Fill in the defaults of a configuration and check it.

    Raises:
        UnknownEnvError: tpm_gym does not register the environment.
        ConfigError: An option, or a combination of options, is not valid.
        RecipeError: The recipe is not valid.
    """
    import tpm_gym

    algo, env = config.algo or _ALGO, config.env or _ENV
    if env not in tpm_gym.ENV_IDS:
        raise UnknownEnvError(env, tpm_gym.ENV_IDS)
    recipe_file = config.recipe or RECIPES / f"{algo}.yml"
    recipe = read_recipe(recipe_file, algo, env)
    steps = _either(config.steps, recipe.n_timesteps)
    plan = Plan(
        algo=algo,
        env=env,
        seed=_either(config.seed, _SEED),
        steps=steps,
        envs=_either(config.envs, recipe.n_envs),
        recipe_file=recipe_file,
        recipe=recipe,
        run=run_folder(config),
        eval_every=_either(config.eval_every, max(1, steps // 10)),
        eval_episodes=_either(config.eval_episodes, _EVAL_EPISODES),
        checkpoint_every=config.checkpoint_every,
        threads=_either(config.threads, 1),
        device=_either(config.device, "cpu"),
        penalty_weight=_either(config.penalty_weight, _PENALTY_WEIGHT),
        goals=_either(config.goals, _GOALS),
    )
    _check(plan)
    return plan


def resume_plan(config: Config, stored: Mapping[str, Any], reached: int) -> Plan:
    """Return the plan of a run, with what a configuration may change in it.

    Args:
        config: The options given now.
        stored: The run's config.json.
        reached: Steps that the run has taken.

    Raises:
        ResumeConflictError: An option contradicts the run.
        ConfigError: An option is not valid.
        RecipeError: The recipe that was given is not valid.
    """
    # Runs of before these options had what is their default.
    stored = {"penalty_weight": _PENALTY_WEIGHT, "goals": _GOALS, **stored}
    for name in _FIXED:
        given = getattr(config, name)
        if given is not None and given != stored[name]:
            raise ResumeConflictError("--" + name.replace("_", "-"), given, stored[name])
    recipe = Recipe(**stored["recipe"])
    if config.recipe is not None:
        _compare_recipes(config.recipe, recipe, stored)
    if config.steps is not None and config.steps < reached:
        raise ConfigError("--steps", config.steps, f"the run has already taken {reached:,}")
    plan = Plan(
        algo=stored["algo"],
        env=stored["env"],
        seed=stored["seed"],
        steps=_either(config.steps, stored["steps"]),
        envs=stored["envs"],
        recipe_file=Path(stored["recipe_file"]),
        recipe=recipe,
        run=run_folder(config),
        eval_every=_either(config.eval_every, stored["eval_every"]),
        eval_episodes=stored["eval_episodes"],
        checkpoint_every=_either(config.checkpoint_every, stored["checkpoint_every"]),
        threads=_either(config.threads, stored["threads"]),
        device=_either(config.device, stored["device"]),
        penalty_weight=stored["penalty_weight"],
        goals=stored["goals"],
    )
    _check(plan)
    return plan


def _compare_recipes(path: Path, stored: Recipe, config: Mapping[str, Any]) -> None:
    """Refuse a recipe file whose recipe is not that of the run."""
    given = read_recipe(path, config["algo"], config["env"])
    new, old = ({**asdict(recipe), **recipe.arguments} for recipe in (given, stored))
    # How long and in how many environments: those have options of their own.
    for name in ("arguments", "n_timesteps", "n_envs"):
        del new[name], old[name]
    for name in sorted({*new, *old}):
        if new.get(name) != old.get(name):
            option = f"--recipe {path}: {name}"
            raise ResumeConflictError(option, new.get(name), old.get(name))


def _either(given: Any, default: Any) -> Any:
    """Return an option, or its default where it was not given."""
    return default if given is None else given


def _check(plan: Plan) -> None:
    """Refuse numbers that cannot work."""
    names = ("steps", "envs", "eval_every", "eval_episodes", "checkpoint_every", "threads")
    for name in names:
        value = getattr(plan, name)
        if value is not None and value < 1:
            raise ConfigError("--" + name.replace("_", "-"), value, "must be at least 1")
    highest = SELECTION_SEED - plan.envs
    if not 0 <= plan.seed <= highest:
        raise ConfigError(
            "--seed",
            plan.seed,
            f"must lie in 0 ... {highest}: seeds from {SELECTION_SEED} up are held out",
        )
    most = TEST_SEED - SELECTION_SEED
    if plan.eval_episodes > most:
        raise ConfigError("--eval-episodes", plan.eval_episodes, f"must be at most {most}")
    if not 0 <= plan.penalty_weight < math.inf:
        valid = "must be a finite number, 0 or more"
        raise ConfigError("--penalty-weight", plan.penalty_weight, valid)
    _check_hindsight(plan)
    _check_demonstrations(plan)
    _check_device(plan.device)


def _check_device(device: str) -> None:
    """Refuse a device that PyTorch does not have here, before anything is deleted for the run."""
    import torch

    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise ConfigError("--device", device, "is no device of PyTorch; try cpu") from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device", device, "PyTorch finds no GPU here; use cpu")


def _check_demonstrations(plan: Plan) -> None:
    """Refuse to end before the demonstrations do: they count as steps, and teach nothing alone."""
    episodes = -(-int(plan.recipe.demonstrations.get("episodes", 0)) // plan.envs) * plan.envs
    needed = episodes * (gym.spec(plan.env).max_episode_steps or 0)
    if episodes and plan.steps <= needed:
        raise ConfigError(
            "--steps",
            plan.steps,
            f"must be more than the {needed:,} of the recipe's demonstrations; for a short trial "
            "give a --recipe with fewer",
        )


def _check_hindsight(plan: Plan) -> None:
    """Refuse to learn before the first episode has ended: hindsight would have nothing to draw."""
    horizon = gym.spec(plan.env).max_episode_steps or 0
    needed = horizon * plan.envs
    starts = int(plan.recipe.arguments.get("learning_starts", 100))
    if plan.recipe.hindsight and starts < needed:
        raise ConfigError(
            "--recipe",
            plan.recipe_file,
            f"learning_starts: {starts} is before the first episode ends (step {needed} with "
            f"{plan.envs} environments); raise it, or use fewer --envs",
        )
