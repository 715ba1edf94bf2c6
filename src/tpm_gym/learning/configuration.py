"""What a training run is to do: the options of the command line, completed and checked."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro
from pydantic import ConfigDict, TypeAdapter, ValidationError

from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.environments import check_env_id
from tpm_gym.learning.errors import ConfigError, RunError
from tpm_gym.learning.recipes import Recipe, check_recipes, read_recipe, recipe_file
from tpm_gym.learning.rollout import SELECTION_SEED, TEST_SEED
from tpm_gym.learning.run_folder import CONFIG_FILE

UNSET: Final[Any] = None
"""Of an option that :func:`complete` works out, or that leaves a resumed run as it is."""


def unset(kind: Any, shown: str, metavar: str, name: str | None = None) -> Any:
    """Describe an option of a type that is ``UNSET`` where it is not given.

    ``shown`` is what the help says that the default is, ``name`` what the command line calls it.
    """
    return shown_default(shown, metavar, constructor=kind | None, name=name)


def shown_default(shown: str, metavar: str, **options: Any) -> Any:
    """Describe an option whose default has to be put into words."""
    hint = f"(default: {shown})"
    return tyro.conf.arg(help_behavior_hint=hint, metavar=metavar, **options)


@dataclass(frozen=True)
class EnvOptions:
    """What an environment is made with, by name; what is not given is as the id has it."""

    machine: Annotated[str, unset(str, "the id's own, mostly paper", "NAME")] = UNSET
    """Machine: paper, wide, or one that the module of --env module:id registers. What a policy was
    trained with is not known of it: evaluate asks again."""

    engine: Annotated[str, unset(str, "the id's own, mostly pybullet", "NAME")] = UNSET
    """Engine: pybullet, analytic (the closed form, many environments at a time), mujoco, or one
    that the module of --env module:id registers."""

    drive: Annotated[
        str, unset(Literal["ideal", "servo"], "the id's own, mostly ideal", "{ideal,servo}")
    ] = UNSET
    """How the motors follow their references: exactly, or as torque motors with servo drives."""

    @property
    def in_batches(self) -> bool:
        """Whether many environments are computed at a time."""
        return self.engine == "analytic"

    def given(self) -> dict[str, Any]:
        """Those that are given, as arguments of an environment."""
        return {name: value for name, value in vars(self).items() if value is not UNSET}


@dataclass(frozen=True)
class TrainingConfig:
    """Train a policy, and leave everything about the run in one folder."""

    algo: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(ALGORITHMS) + "}")] = "sac"
    """Algorithm. SAC and TQC use hindsight replay on sparse rewards; PPO wants a Dense id."""

    env: Annotated[str, tyro.conf.arg(metavar="ID")] = "TPMReach-v0"
    """Environment id, or module:id for one that a module of yours registers."""

    seed: int = 0
    """Seed of the networks, the exploration and the first training environment."""

    steps: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Environment steps, over all environments."""

    envs: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Parallel environments; several are in processes of their own, in --engine analytic in one."""

    recipe_file: Annotated[Path, unset(Path, "the shipped one of <algo>", "PATH", "recipe")] = UNSET
    """YAML file of hyperparameters by environment id."""

    recipe: tyro.conf.Suppress[Annotated[Recipe, unset(type(None), "", "")]] = UNSET
    """The hyperparameters in it."""

    demonstrations: Annotated[int | None, unset(int, "as the recipe says", "INT")] = None
    """Episodes of the expert in the replay buffer before training starts; 0 trains from scratch."""

    run: Annotated[Path, unset(Path, "runs/<env>-<algo>-s<seed>", "FOLDER")] = UNSET
    """Folder of the run."""

    penalty_weight: float = 1.0
    """Weight of the singularity penalty in the reward; 0 switches it off."""

    goals: Literal["sampled", "tempting"] = "sampled"
    """As the environment samples them, or goals that tempt towards the singularity; in training and
    in its evaluations."""

    env_options: tyro.conf.OmitArgPrefixes[EnvOptions] = field(default_factory=EnvOptions)

    eval_every: Annotated[
        int, unset(int, "a tenth of the steps; a twentieth in --engine analytic", "INT")
    ] = UNSET
    """Steps between evaluations on held-out seeds."""

    eval_episodes: Annotated[int, unset(int, "20; 200 in --engine analytic", "INT")] = UNSET
    """Episodes per evaluation."""

    test_episodes: int = 100
    """Episodes of the test in PyBullet with which a training in --engine analytic ends; 0: none."""

    checkpoint_every: Annotated[int | None, unset(int, "by time", "INT")] = None
    """Steps between checkpoints. By time means every half minute, or less often where that would
    take more than 2% of the time."""

    threads: int = 1
    """Threads of PyTorch. With one thread and one environment, or --engine analytic, a seed repeats
    exactly."""

    device: str = "cpu"
    """Device of PyTorch. The networks are small; a GPU pays only with large batches."""

    overwrite: bool = False
    """Replace an earlier run in the same folder."""

    @property
    def in_batches(self) -> bool:
        """Whether many environments are computed at a time."""
        return self.env_options.in_batches

    @property
    def title(self) -> str:
        """One line that names the run."""
        method = self.algo.upper() + (" + HER" if self.recipe.hindsight else "")
        return f"{self.env}   {method}, seed {self.seed}"

    def record(self) -> dict[str, Any]:
        """Return the configuration as plain data, without folders outside the run."""
        paths = {"run": self.run.name, "recipe_file": self.recipe_file.name}
        found = {**asdict(self), **paths, "env_options": self.env_options.given()}
        del found["overwrite"]
        return found


@dataclass(frozen=True)
class ResumeConfig:
    """Go on with a run from its last checkpoint; what is not given here is as the run has it."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""

    steps: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Environment steps in all; may be raised."""

    eval_every: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Steps between evaluations on held-out seeds."""

    checkpoint_every: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Steps between checkpoints."""

    threads: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Threads of PyTorch."""

    device: Annotated[str, unset(str, "the run's", "NAME")] = UNSET
    """Device of PyTorch."""


def complete(config: TrainingConfig) -> TrainingConfig:
    """Work out what was not given, and check all.

    Raises:
        ConfigError: An option, the recipe, or a combination of options is not valid.
    """
    check_env_id(config.env)
    shipped = recipe_file(config.algo, config.env_options.engine)
    file = shipped if config.recipe_file is UNSET else config.recipe_file
    recipe = read_recipe(file, config.algo, config.env)
    if config.demonstrations is not UNSET:
        recipe = _with_demonstrations(recipe, config)
    steps = recipe.n_timesteps if config.steps is UNSET else config.steps
    env = config.env.rpartition(":")[2]
    worked_out: dict[str, Any] = {
        "steps": steps,
        "envs": recipe.n_envs,
        "recipe_file": file,
        "run": Path("runs", f"{env}-{config.algo}-s{config.seed}"),
        "eval_every": max(1, steps // (20 if config.in_batches else 10)),
        "eval_episodes": 200 if config.in_batches else 20,
    }
    missing = {name: v for name, v in worked_out.items() if getattr(config, name) is UNSET}
    config = replace(config, recipe=recipe, **missing)
    _check(config)
    return config


def _with_demonstrations(recipe: Recipe, config: TrainingConfig) -> Recipe:
    """The recipe with so many of them as the configuration says."""
    check_least(config, 0, "demonstrations")
    count = config.demonstrations
    changed = {**recipe.demonstrations, "episodes": count} if count else {}
    recipe = replace(recipe, demonstrations=changed)
    check_recipes(f"--demonstrations {count}", {config.algo: recipe.entries()}, config.algo)
    return recipe


def resumed(config: ResumeConfig, stored: Mapping[str, Any], reached: int) -> TrainingConfig:
    """Return the configuration of a run, with what is to change in it.

    Args:
        stored: The run's config.json.
        reached: Steps that the run has taken.

    Raises:
        ConfigError: An option is not valid.
        RunError: ``stored`` is damaged.
    """
    _require_whole(config.run, stored)
    changes = {name: value for name, value in vars(config).items() if value is not UNSET}
    # A run of before an option was there had what is its default.
    names = {entry.name for entry in fields(TrainingConfig)} & stored.keys()
    objects = {
        "recipe": Recipe(**stored["recipe"]),
        "recipe_file": Path(stored["recipe_file"]),
        "env_options": EnvOptions(**stored.get("env_options", {})),
    }
    found = TrainingConfig(**{**{name: stored[name] for name in names}, **objects, **changes})
    if found.steps < reached:
        raise ConfigError(f"--steps {found.steps}: the run has already taken {reached:,}")
    _check(found)
    return found


def _require_whole(run: Path, stored: Mapping[str, Any]) -> None:
    """Refuse a stored configuration with entries that are missing or of other types."""
    entries = {
        field.name: stored.get(field.name)
        for field in fields(TrainingConfig)
        if field.name in stored or field.default is UNSET
    }
    text = json.dumps({CONFIG_FILE: {**entries, "run": run.name}})
    strict = ConfigDict(strict=True, extra="forbid")
    try:
        TypeAdapter(dict[str, TrainingConfig], config=strict).validate_json(text)
        TypeAdapter(list[Any]).validate_python(stored.get("resumed", []))
        recipe_file(stored["algo"])  # there is such an algorithm
        entries = Recipe(**stored["recipe"]).entries()
        check_recipes(CONFIG_FILE, {"recipe": entries}, stored["algo"])
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}, not {first['input']!r:.100}"
        raise _damaged(run, problem) from error
    except ConfigError as error:
        raise _damaged(run, str(error)) from error


def _damaged(run: Path, problem: str) -> RunError:
    anew = "start the run anew with tpm-gym train --overwrite"
    return RunError(f"the configuration of {run} is damaged: {problem}; {anew}")


def check_least(config: Any, least: int, *names: str) -> None:
    """Refuse, with a ConfigError, an option that is given and less than it may be."""
    for name in names:
        value = getattr(config, name)
        if value is not UNSET and value < least:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: must be at least {least}")


def _check(config: TrainingConfig) -> None:
    counts = ("steps", "envs", "eval_every", "eval_episodes", "checkpoint_every", "threads")
    check_least(config, 1, *counts)
    check_least(config, 0, "test_episodes")
    highest = SELECTION_SEED - config.envs
    if not 0 <= config.seed <= highest:
        held_out = f"seeds from {SELECTION_SEED} up are held out"
        raise ConfigError(f"--seed {config.seed}: must lie in 0 ... {highest}: {held_out}")
    most = TEST_SEED - SELECTION_SEED
    if config.eval_episodes > most:
        raise ConfigError(f"--eval-episodes {config.eval_episodes}: must be at most {most}")
    if not 0 <= config.penalty_weight < math.inf:
        weight = config.penalty_weight
        raise ConfigError(f"--penalty-weight {weight}: must be a finite number, 0 or more")
    _check_episodes(config)
    _check_device(config.device)


def _check_episodes(config: TrainingConfig) -> None:
    """Refuse to end before the demonstrations do, or to learn before an episode has ended.

    Demonstrations count as steps and teach nothing alone; hindsight would have nothing to draw.
    """
    horizon = check_env_id(config.env).max_episode_steps or 0
    recipe, envs = config.recipe, config.envs
    episodes = -(-int(recipe.demonstrations.get("episodes", 0)) // envs) * envs
    if episodes and config.steps <= episodes * horizon:
        raise ConfigError(
            f"--steps {config.steps}: must be more than the {episodes * horizon:,} of the "
            "demonstrations; for a short trial give fewer --demonstrations"
        )
    starts = int(recipe.arguments.get("learning_starts", 100))
    if recipe.hindsight and starts < horizon * envs:
        raise ConfigError(
            f"--recipe {config.recipe_file}: learning_starts: {starts} is before the first episode "
            f"ends (step {horizon * envs} with {envs} environments); raise it, or use fewer --envs"
        )
    room = int(recipe.arguments.get("buffer_size", 1_000_000))
    if recipe.hindsight and room < horizon * envs:
        raise ConfigError(
            f"--recipe {config.recipe_file}: buffer_size: {room} is less than the {horizon * envs} "
            f"steps of an episode in each of {envs} environments; raise it, or use fewer --envs"
        )


def _check_device(device: str) -> None:
    """Refuse a device that PyTorch does not have here, before anything is deleted for the run."""
    import torch

    try:
        kind = torch.device(device).type
        if kind != "cuda":
            torch.zeros(1, device=device).item()  # some hold no numbers
    except RuntimeError as error:
        raise ConfigError(f"--device {device}: is no device of PyTorch; try cpu") from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"--device {device}: PyTorch finds no GPU here; use cpu")
