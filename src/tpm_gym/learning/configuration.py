"""Configuration of a training: the options of the command line, completed and checked."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro
from pydantic import ConfigDict, TypeAdapter, ValidationError

from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.environments import check_env_id, import_module_of
from tpm_gym.learning.errors import ConfigError, RunError
from tpm_gym.learning.recipes import Recipe, check_recipes, read_recipe, recipe_file
from tpm_gym.learning.rollout import SELECTION_SEED, TEST_SEED
from tpm_gym.learning.run_folder import CONFIG_FILE

UNSET: Final[Any] = None
"""Value of an option that :func:`complete` computes, or that a resumed run keeps."""

_MOST_PROCESSES: Final = 1000


def unset(kind: Any, shown: str, metavar: str, name: str | None = None) -> Any:
    """Describe an option that is ``UNSET`` by default; ``shown`` is the default in the help."""
    hint = f"(default: {shown})"
    return tyro.conf.arg(
        help_behavior_hint=hint, metavar=metavar, constructor=kind | None, name=name
    )


@dataclass(frozen=True)
class EnvOptions:
    """Options of an environment, by name; the id decides those that are not given."""

    machine: Annotated[str, unset(str, "the policy's in evaluate, else the id's", "NAME")] = UNSET
    """Machine: paper, wide, or one that the module of --env module:id registers."""

    engine: Annotated[str, unset(str, "the id's, mostly pybullet", "NAME")] = UNSET
    """Engine: pybullet, analytic (many environments at once), mujoco, or one that the module of
    --env module:id registers."""

    drive: Annotated[
        str,
        unset(
            Literal["ideal", "servo"], "the policy's in evaluate, else the id's", "{ideal,servo}"
        ),
    ] = UNSET
    """Drives of the motors: ideal ones follow their references exactly, servo drives are torque
    motors."""

    @property
    def in_batches(self) -> bool:
        """Whether one process steps many environments at once."""
        return self.engine == "analytic"

    def given(self) -> dict[str, Any]:
        """Return the options that are given, as arguments of an environment."""
        return {name: value for name, value in vars(self).items() if value is not UNSET}


@dataclass(frozen=True)
class TrainingConfig:
    """Train a policy, and leave everything about the run in one folder."""

    algo: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(ALGORITHMS) + "}")] = "sac"
    """Algorithm. SAC and TQC use hindsight replay on sparse rewards; PPO needs a Dense id."""

    env: Annotated[str, tyro.conf.arg(metavar="ID")] = "TPMReach-v0"
    """Environment id, or module:id for one that a module of yours registers."""

    seed: int = 0
    """Seed of the networks, the exploration and the first training environment."""

    steps: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Environment steps, over all environments; rounded up to whole rollouts."""

    envs: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Parallel environments, each in its own process; in --engine analytic all in one."""

    recipe_file: Annotated[Path, unset(Path, "the shipped one of <algo>", "PATH", "recipe")] = UNSET
    """YAML file of hyperparameters by environment id."""

    recipe: tyro.conf.Suppress[Annotated[Recipe, unset(type(None), "", "")]] = UNSET
    """Hyperparameters in that file."""

    demonstrations: Annotated[int | None, unset(int, "as the recipe says", "INT")] = None
    """Episodes of the expert in the replay buffer before training starts; 0 trains from scratch."""

    run: Annotated[Path, unset(Path, "runs/<env>-<algo>-s<seed>", "FOLDER")] = UNSET
    """Folder of the run."""

    penalty_weight: float = 1.0
    """Weight of the singularity penalty in the reward; 0 switches it off."""

    goals: Literal["sampled", "tempting"] = "sampled"
    """Goals of training and evaluations: as the environment samples them, or tempting towards the
    singularity."""

    env_options: tyro.conf.OmitArgPrefixes[EnvOptions] = field(default_factory=EnvOptions)

    eval_every: Annotated[
        int, unset(int, "a tenth of the steps; a twentieth in --engine analytic", "INT")
    ] = UNSET
    """Steps between evaluations on held-out seeds."""

    eval_episodes: Annotated[int, unset(int, "20; 200 in --engine analytic", "INT")] = UNSET
    """Episodes per evaluation."""

    test_episodes: int = 100
    """Episodes of the test in PyBullet that ends a training in --engine analytic; 0 for none."""

    checkpoint_every: Annotated[int | None, unset(int, "by time", "INT")] = None
    """Steps between checkpoints. By time: every 30 s, or less often if checkpoints would take more
    than 2% of the time."""

    threads: int = 1
    """Threads of PyTorch. With one thread and one environment, or --engine analytic, a seed repeats
    exactly."""

    device: str = "cpu"
    """Device of PyTorch. The networks are small; a GPU pays only with large batches."""

    overwrite: bool = False
    """Replace an earlier run in the same folder."""

    @property
    def rollout(self) -> int:
        """Number of steps between two updates, over all environments."""
        return self.envs * int(self.argument("train_freq") or self.argument("n_steps"))

    def argument(self, name: str) -> Any:
        """Return an argument of the algorithm: the recipe's or its default; None if it has none."""
        return ALGORITHMS[self.algo].argument(self.recipe.arguments, name)

    @property
    def horizon(self) -> int:
        """Number of steps after which an episode is truncated, over all environments."""
        return self.envs * (check_env_id(self.env).max_episode_steps or 0)

    @property
    def demonstrated(self) -> int:
        """Number of steps of the demonstrations, over all environments."""
        episodes = int(self.recipe.demonstrations.get("episodes", 0))
        return -(-episodes // self.envs) * self.horizon

    @property
    def title(self) -> str:
        """Name of the run in one line."""
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
    """Continue a run from its last checkpoint; options that are not given stay as they are."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""

    env: Annotated[str, unset(str, "the run's", "MODULE:ID")] = UNSET
    """Environment id of the run; needed if it is module:id, since no file decides what is
    imported."""

    steps: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Environment steps in all, rounded up to whole rollouts; may be raised."""

    eval_every: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Steps between evaluations on held-out seeds."""

    checkpoint_every: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Steps between checkpoints."""

    threads: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Threads of PyTorch."""

    device: Annotated[str, unset(str, "the run's", "NAME")] = UNSET
    """Device of PyTorch."""


@dataclass(frozen=True)
class TuneConfig:
    """Search for a recipe: many trainings with varied hyperparameters, several at a time."""

    algo: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(ALGORITHMS) + "}")] = "ppo"
    """Algorithm."""

    env: Annotated[str, tyro.conf.arg(metavar="ID")] = "TPMReachDense-v0"
    """Environment id, or module:id for one that a module of yours registers."""

    trials: int = 30
    """Number of trainings."""

    steps: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Environment steps of each training."""

    jobs: Annotated[int, unset(int, "one for each core", "INT")] = UNSET
    """Trainings at a time, on this machine or on the Ray cluster that RAY_ADDRESS names."""

    seed: int = 0
    """Seed of the search; training i has this seed + i."""

    folder: Annotated[Path, unset(Path, "runs/tune-<env>-<algo>", "FOLDER")] = UNSET
    """Folder of the runs and of the best recipe; must not exist."""

    env_options: tyro.conf.OmitArgPrefixes[EnvOptions] = field(default_factory=EnvOptions)


def complete(config: TrainingConfig) -> TrainingConfig:
    """Compute the options that are not given, and check all."""
    import_module_of(config.env)
    check_env_id(config.env)
    shipped = recipe_file(config.algo, config.env_options.engine)
    file = shipped if config.recipe_file is UNSET else config.recipe_file
    recipe = read_recipe(file, config.algo, config.env)
    if config.demonstrations is not UNSET:
        check_least(config, 0, "demonstrations")
        count = config.demonstrations
        changed = {**recipe.demonstrations, "episodes": count} if count else {}
        recipe = replace(recipe, demonstrations=changed)
        check_recipes(f"--demonstrations {count}", {config.algo: recipe.entries()}, config.algo)
    steps = recipe.n_timesteps if config.steps is UNSET else config.steps
    env = config.env.rpartition(":")[2]
    computed: dict[str, Any] = {
        "steps": steps,
        "envs": recipe.n_envs,
        "recipe_file": file,
        "run": Path("runs", f"{env}-{config.algo}-s{config.seed}"),
        "eval_episodes": 200 if config.env_options.in_batches else 20,
    }
    missing = {name: v for name, v in computed.items() if getattr(config, name) is UNSET}
    config = replace(config, recipe=recipe, **missing)
    if config.eval_every is UNSET:  # more often, it would evaluate equal policies
        often = steps // (20 if config.env_options.in_batches else 10)
        config = replace(config, eval_every=max(config.rollout, often))
    _check(config)
    return _in_whole_rollouts(config, 0)


def _in_whole_rollouts(config: TrainingConfig, reached: int) -> TrainingConfig:
    """Round the steps up as Stable-Baselines3 does, so that schedules end with the last rollout."""
    start = max(reached, config.demonstrated)
    rollouts = -(-(config.steps - start) // config.rollout)
    return replace(config, steps=start + rollouts * config.rollout)


def resumed(config: ResumeConfig, stored: Mapping[str, Any], reached: int) -> TrainingConfig:
    """Change the configuration ``stored`` of a run that has ``reached`` a step."""
    found = _stored(config.run, stored)
    if config.env not in (UNSET, found.env):
        raise ConfigError(f"--env {config.env}: the run was trained in {found.env}; give that")
    if config.env is not UNSET:
        import_module_of(config.env)
    changes = {name: value for name, value in vars(config).items() if value is not UNSET}
    found = replace(found, **changes)
    if found.steps < reached:
        raise ConfigError(f"--steps {found.steps}: the run has already taken {reached:,}")
    _check(found)
    return _in_whole_rollouts(found, reached)


def _stored(run: Path, stored: Mapping[str, Any]) -> TrainingConfig:
    """Build the configuration of a run; refuse missing entries, and entries of other types."""
    names = {entry.name for entry in fields(TrainingConfig)} - {"overwrite"}
    text = json.dumps({CONFIG_FILE: {name: stored.get(name) for name in names}})
    kind = TypeAdapter(dict[str, TrainingConfig], config=ConfigDict(strict=True, extra="forbid"))
    try:
        found = kind.validate_json(text)[CONFIG_FILE]
        TypeAdapter(list[Any]).validate_python(stored.get("resumed", []))
        recipe_file(found.algo)  # refuses an unknown algorithm
        check_recipes(CONFIG_FILE, {"recipe": found.recipe.entries()}, found.algo)
    except (ValidationError, AttributeError, ConfigError) as error:  # a recipe of null
        problem = str(error)
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise RunError(
            f"the configuration of {run} is damaged: {problem}; start the run anew with tpm-gym "
            "train --overwrite"
        ) from error
    return found


def check_least(config: Any, least: int, *names: str) -> None:
    """Refuse, with a ConfigError, an option that is given and too small."""
    for name in names:
        value = getattr(config, name)
        if value is not UNSET and value < least:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: must be at least {least}")


def _refuse(wrong: bool, problem: str) -> None:
    if wrong:
        raise ConfigError(problem)


def _check(config: TrainingConfig) -> None:
    counts = ("steps", "envs", "eval_every", "eval_episodes", "checkpoint_every", "threads")
    check_least(config, 1, *counts)
    check_least(config, 0, "test_episodes")
    envs, seed, most = config.envs, config.seed, TEST_SEED - SELECTION_SEED
    _refuse(config.eval_episodes > most, f"--eval-episodes: must be at most {most}")
    most = SELECTION_SEED if config.env_options.in_batches else _MOST_PROCESSES
    problem = f"--envs {envs} (n_envs of the recipe, if not given): must be at most {most:,}"
    _refuse(envs > most, problem)
    most = SELECTION_SEED - envs
    problem = f"must lie in 0 ... {most}: seeds from {SELECTION_SEED} up are held out"
    _refuse(not 0 <= seed <= most, f"--seed {seed}: {problem}")
    weight = config.penalty_weight
    problem = f"--penalty-weight {weight}: must be a finite number, 0 or more"
    _refuse(not 0 <= weight < math.inf, problem)
    _check_recipe(config)
    _check_device(config.device)


def _check_recipe(config: TrainingConfig) -> None:
    """Refuse a recipe that cannot work with the numbers of steps and environments."""
    shown, envs, where = f"--steps {config.steps}", config.envs, f"--recipe {config.recipe_file}"
    _refuse(
        config.steps <= config.demonstrated,
        f"{shown}: must be more than the {config.demonstrated:,} of the demonstrations; for a "
        "short trial give fewer --demonstrations",
    )
    length = "train_freq" if config.argument("train_freq") else "n_steps"
    _refuse(
        config.steps - config.demonstrated < config.rollout,
        f"{shown}: one rollout takes {config.rollout:,} ({envs} environments x {length}); give "
        "more steps, or fewer --envs",
    )
    if config.argument("normalize_advantage"):
        sizes = {length: config.rollout, "batch_size": config.argument("batch_size")}
        _refuse(
            min(sizes.values()) < 2,
            f"{where}: {min(sizes, key=sizes.__getitem__)}: 1: advantages of one step cannot be "
            "normalised; raise it, or set normalize_advantage: false",
        )
    if config.recipe.hindsight:  # it draws from whole episodes
        for name in ("learning_starts", "buffer_size"):
            _refuse(
                config.argument(name) < config.horizon,
                f"{where}: {name}: {config.argument(name)} is less than the {config.horizon} steps "
                f"of an episode in each of {envs} environments; raise it, or use fewer --envs",
            )


def _check_device(device: str) -> None:
    """Refuse a device that PyTorch does not have, before anything is deleted for the run."""
    import torch

    try:
        torch.zeros(1, device=device).item()  # the device meta holds no numbers
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch without CUDA
        problem = str(error).partition("\n")[0]
        raise ConfigError(f"--device {device}: {problem}; try cpu") from error
