"""Configuration of a training: the options of the command line, completed and checked."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro
from pydantic import ConfigDict, TypeAdapter, ValidationError
from tyro.constructors import PrimitiveConstructorSpec

from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.environments import check_env_id, import_module_of, set_by
from tpm_gym.learning.errors import ConfigError, RunError
from tpm_gym.learning.recipes import (
    Recipe,
    algorithm_for,
    check_recipes,
    read_recipe,
    recipe_file,
)
from tpm_gym.learning.rollout import SELECTION_SEED, TEST_SEED
from tpm_gym.learning.run_folder import CONFIG_FILE

UNSET: Final[Any] = None
"""Placeholder for an option that is not given. The option then gets its value from the recipe, the
policy, the resumed run, the environment id or another default."""

_MOST_PROCESSES: Final = 1000
_MOST_THREADS: Final = 1024


def unset(kind: Any, shown: str, metavar: str, name: str | None = None) -> Any:
    """Describe an option that is ``UNSET`` by default; ``shown`` is the default in the help."""
    hint = f"(default: {shown})"
    return tyro.conf.arg(
        help_behavior_hint=hint, metavar=metavar, constructor=kind | None, name=name
    )


GOALS: Final = unset(
    Literal["sampled", "tempting"], "the id's, mostly sampled", "{sampled,tempting}"
)
_RANDOMISED = tyro.conf.arg(
    metavar="KEY=VALUE ...", help_behavior_hint="(default: the id's, mostly none)"
)
Randomised = Annotated[tuple[str, ...], _RANDOMISED]


def parse_randomisation(words: Sequence[str]) -> dict[str, Any]:
    """Parse words such as ``friction=0.5:1`` into a mapping; environments check keys and values."""
    found: dict[str, Any] = {}
    for word in words:
        name, _, text = word.partition("=")
        try:
            numbers = [int(n) if n.isdecimal() else float(n) for n in text.split(":")]
        except ValueError:
            numbers = []
        if not name or name in found or len(numbers) not in (1, 2):
            valid = "must be KEY=NUMBER or KEY=LOW:HIGH, each key once"
            raise ConfigError(f"--randomisation {word}: {valid}")
        found[name] = numbers[0] if len(numbers) == 1 else tuple(numbers)
    return found


def parse_shield(words: Sequence[str]) -> bool | float:
    """Parse the words after ``--shield``: True, False or a conditioning.

    If there are no words, the result is True.
    """
    text = " ".join(words) or "True"
    return text == "True" if text in ("True", "False") else float(text)


_SHIELD: Final = PrimitiveConstructorSpec[Any](
    nargs="*",
    metavar="[True|False|CONDITIONING]",
    instance_from_str=parse_shield,
    is_instance=lambda value: value is UNSET or isinstance(value, bool | float),
    str_from_instance=lambda value: [str(value)],
)
_SHIELD_HINT: Final = tyro.conf.arg(help_behavior_hint="(default: False; evaluate: the policy's)")


@dataclass(frozen=True)
class EnvOptions:
    """Options of an environment. The environment id sets the defaults."""

    machine: Annotated[str, unset(str, "the id's; evaluate: the policy's", "NAME")] = UNSET
    """Robot: paper, wide, delta, or one that your module registers."""

    engine: Annotated[str, unset(str, "the id's, mostly pybullet; collect: analytic", "NAME")] = (
        UNSET
    )
    """Engine: pybullet, mujoco, analytic (many environments at once), or one that your module
    registers."""

    drive: Annotated[
        str,
        unset(Literal["ideal", "servo"], "the id's; evaluate: the policy's", "{ideal,servo}"),
    ] = UNSET
    """Drives of the motors: ideal drives follow their references exactly, up to the peak torque;
    servo drives lag behind."""

    shield: Annotated[bool | float | None, _SHIELD, _SHIELD_HINT] = UNSET
    """Replace actions by the nearest actions that keep clear of singularities."""

    @property
    def in_batches(self) -> bool:
        """Whether one process steps many environments at once."""
        return self.engine == "analytic"

    def given(self) -> dict[str, Any]:
        """Return the options that are given, as arguments of an environment."""
        return {name: value for name, value in vars(self).items() if value is not UNSET}


OF_TASK: Final[Mapping[str, Any]] = {"goals": "sampled", "penalty_weight": 1.0}
"""Options of a task, and their values if the registration of an id does not set them."""


def of_task(env_id: str) -> dict[str, Any]:
    """Return goals and penalty weight of an id."""
    own = set_by(env_id) or {}
    return {name: own.get(name, usual) for name, usual in OF_TASK.items()}


GivenEnvOptions = Annotated[
    tyro.conf.OmitArgPrefixes[EnvOptions], tyro.conf.arg(name="environment")
]
"""Options of an environment. The help shows them as a separate group."""


@dataclass(frozen=True)
class TrainingConfig:
    """Train a policy. Everything about the run goes to one folder."""

    algo: Annotated[
        str, unset(str, "one that has a recipe for <env>", "{" + ",".join(ALGORITHMS) + "}")
    ] = UNSET
    """Algorithm: sac, tqc, or ppo (needs a Dense id or demonstrations)."""

    env: Annotated[str, tyro.conf.arg(metavar="ID")] = "TPMReach-v0"
    """Environment id, or module:id if a module of yours registers it."""

    seed: int = 0
    """Seed of everything random."""

    steps: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Number of steps, in all environments together."""

    envs: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Number of environments. Each has its own process; with --engine analytic, they share one."""

    recipe_file: Annotated[Path, unset(Path, "the shipped one of <algo>", "PATH", "recipe")] = UNSET
    """YAML file of hyperparameters."""

    recipe: tyro.conf.Suppress[Annotated[Recipe, unset(type(None), "", "")]] = UNSET
    """Hyperparameters in ``recipe_file``."""

    demonstrations: Annotated[int | None, unset(int, "as the recipe says", "INT")] = None
    """Number of the expert's episodes to learn from at the start, rounded up to a multiple of
    <envs>; 0 for no demonstrations."""

    run: Annotated[Path, unset(Path, "runs/<env>-<algo>-s<seed>", "FOLDER")] = UNSET
    """Folder of the run."""

    penalty_weight: Annotated[float, unset(float, "the id's, mostly 1", "FLOAT")] = UNSET
    """Weight of the singularity penalty in the reward; 0 for none."""

    goals: Annotated[Literal["sampled", "tempting"], GOALS] = UNSET
    """Goals: sampled in the whole task region, or only next to a singularity (tempting)."""

    env_options: GivenEnvOptions = field(default_factory=EnvOptions)

    randomisation: Randomised = ()
    """Attributes of Randomisation, each with a number (encoder_noise=1e-4) or with a range LOW:HIGH
    (block_mass=0.5:2)."""

    eval_every: Annotated[
        int, unset(int, "a tenth of the steps; a twentieth in --engine analytic", "INT")
    ] = UNSET
    """Steps between evaluations."""

    eval_episodes: Annotated[int, unset(int, "20; 200 in --engine analytic", "INT")] = UNSET
    """Episodes of an evaluation."""

    test_episodes: int = 100
    """Episodes of each final test, in the analytic engine and in PyBullet; 0 for no test. Only
    trainings with --engine analytic have final tests."""

    checkpoint_every: Annotated[int | None, unset(int, "by time", "INT")] = None
    """Steps between checkpoints. By default, a checkpoint is saved every 30 s, or less often, so
    that saving takes at most 2% of the time."""

    threads: int = 1
    """PyTorch threads. With one thread, small networks are fastest, and results repeat exactly."""

    device: str = "cpu"
    """Device of PyTorch, such as cpu or cuda."""

    overwrite: bool = False
    """Replace the run that is in the folder."""

    @property
    def rollout(self) -> int:
        """Number of steps between two updates, summed over all environments."""
        return self.envs * int(self.argument("train_freq") or self.argument("n_steps"))

    def argument(self, name: str) -> Any:
        """Return an algorithm's argument, given or default; None if there is no such argument."""
        return ALGORITHMS[self.algo].argument(self.recipe.arguments, name)

    @property
    def horizon(self) -> int:
        """Number of steps of one full episode in each environment, summed over all environments."""
        return self.envs * (check_env_id(self.env).max_episode_steps or 0)

    @property
    def demonstrated(self) -> int:
        """Number of steps of the demonstrations, summed over all environments."""
        episodes = int(self.recipe.demonstrations.get("episodes", 0))
        return -(-episodes // self.envs) * self.horizon

    @property
    def env_arguments(self) -> dict[str, Any]:
        """Arguments of :func:`~tpm_gym.learning.environments.make_env`."""
        # A worker process must import the id's module, and may not have the id registered.
        env = self.env if ":" in self.env else check_env_id(self.env)
        found: dict[str, Any] = {"env": env}
        for name in OF_TASK:
            if (value := getattr(self, name)) is not UNSET:
                found[name] = value
        if self.randomisation:
            found["randomisation"] = parse_randomisation(self.randomisation)
        return found | self.env_options.given()

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
    """Continue a training from its last checkpoint; results equal those of an uninterrupted run."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""

    env: Annotated[str, unset(str, "the run's", "MODULE:ID")] = UNSET
    """Environment id of the run. If the id is module:id, this option is required: importing a
    module runs its code, so a module is imported only if you name it."""

    steps: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Total number of steps, including the steps that are already taken."""

    eval_every: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Steps between evaluations."""

    checkpoint_every: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Steps between checkpoints."""

    threads: Annotated[int, unset(int, "the run's", "INT")] = UNSET
    """Threads of PyTorch."""

    device: Annotated[str, unset(str, "the run's", "NAME")] = UNSET
    """Device of PyTorch."""


def complete(config: TrainingConfig) -> TrainingConfig:
    """Compute the options that are not given, and check all options."""
    import_module_of(config.env)
    check_env_id(config.env)
    _check_numbers(config)
    many, engine = config.env_options.in_batches, config.env_options.engine
    if config.algo is UNSET:
        found = algorithm_for(config.env, engine, config.recipe_file)
        config = replace(config, algo=found)
    shipped = recipe_file(config.algo, engine)
    file = shipped if config.recipe_file is UNSET else config.recipe_file
    recipe = read_recipe(file, config.algo, config.env)
    if (count := config.demonstrations) is not UNSET:
        changed = {**recipe.demonstrations, "episodes": count} if count else {}
        recipe = replace(recipe, demonstrations=changed)
        check_recipes(f"--demonstrations {count}", {config.algo: recipe.entries()}, config.algo)
    computed: dict[str, Any] = {
        "steps": recipe.n_timesteps,
        "envs": recipe.n_envs,
        "recipe_file": file,
        "run": Path("runs", f"{config.env.rpartition(':')[2]}-{config.algo}-s{config.seed}"),
        "eval_episodes": 200 if many else 20,
        **of_task(config.env),
    }
    missing = {name: v for name, v in computed.items() if getattr(config, name) is UNSET}
    config = replace(config, recipe=recipe, **missing)
    played = -(-int(recipe.demonstrations.get("episodes", 0)) // config.envs) * config.envs
    config = replace(config, demonstrations=played)
    if config.eval_every is UNSET:  # between updates the policy does not change
        often = max(config.rollout, config.steps // (20 if many else 10))
        config = replace(config, eval_every=often)
    _check(config)
    return _in_whole_rollouts(config, 0)


def _in_whole_rollouts(config: TrainingConfig, reached: int) -> TrainingConfig:
    """Round the steps up as Stable-Baselines3 does, so that schedules end with the last rollout."""
    start = max(reached, config.demonstrated)
    rollouts = -(-(config.steps - start) // config.rollout)
    return replace(config, steps=start + rollouts * config.rollout)


def resumed(config: ResumeConfig, stored: Mapping[str, Any], reached: int) -> TrainingConfig:
    """Return the ``stored`` configuration of a run, with the options in ``config`` applied.

    ``reached`` is the number of steps that the run has taken.
    """
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
    """Build the configuration of a run; raise RunError if an entry of it is missing or invalid."""
    names = {entry.name for entry in fields(TrainingConfig)} - {"overwrite"}
    text = json.dumps({CONFIG_FILE: {name: stored.get(name) for name in names}})
    kind = TypeAdapter(dict[str, TrainingConfig], config=ConfigDict(strict=True, extra="forbid"))
    try:
        found = kind.validate_json(text)[CONFIG_FILE]
        recipe_file(found.algo)  # refuses an unknown algorithm
        check_recipes(CONFIG_FILE, {"recipe": found.recipe.entries()}, found.algo)
    except (ValidationError, AttributeError, ConfigError) as error:  # AttributeError: recipe: null
        problem = " ".join(str(error).split())
        raise RunError(
            f"the configuration of {run} is damaged: {problem}; start the run anew with tpm-gym "
            "train --overwrite"
        ) from error
    return found


def check_least(config: Any, least: int, *names: str) -> None:
    """Refuse, with a ConfigError, an option that is given and too small."""
    for name in names:
        value = getattr(config, name)
        if value is not UNSET and not value >= least:  # NaN is refused, too
            raise ConfigError(f"--{name.replace('_', '-')} {value}: must be at least {least}")


def check_seed(seed: int, count: int) -> None:
    """Raise ConfigError if a seed from ``seed`` to ``seed + count - 1`` is not allowed.

    Seeds are not allowed if they are negative or held out for evaluations.
    """
    most = SELECTION_SEED - count
    problem = f"must lie in 0 ... {most}: seeds from {SELECTION_SEED} up are held out"
    _refuse(not 0 <= seed <= most, f"--seed {seed}: {problem}")


def _refuse(wrong: bool, problem: str) -> None:
    if wrong:
        raise ConfigError(problem)


def _check(config: TrainingConfig) -> None:
    """Check a completed configuration."""
    _check_numbers(config)
    _check_recipe(config)
    _check_device(config.device)


def _check_numbers(config: TrainingConfig) -> None:
    """Check the given numbers; make only the checks that need no recipe."""
    counts = ("steps", "envs", "eval_every", "eval_episodes", "checkpoint_every", "threads")
    check_least(config, 1, *counts)
    check_least(config, 0, "test_episodes", "demonstrations")
    envs, episodes, threads = config.envs or 1, config.eval_episodes or 1, config.threads
    _refuse(threads > _MOST_THREADS, f"--threads {threads}: must be at most {_MOST_THREADS:,}")
    most = TEST_SEED - SELECTION_SEED
    _refuse(episodes > most, f"--eval-episodes {episodes}: must be at most {most:,}")
    most = SELECTION_SEED if config.env_options.in_batches else _MOST_PROCESSES
    problem = f"--envs {envs} (n_envs of the recipe, if not given): must be at most {most:,}"
    _refuse(envs > most, problem)
    check_seed(config.seed, envs)


def _check_recipe(config: TrainingConfig) -> None:
    """Refuse a recipe that cannot work with the numbers of steps and environments."""
    shown, envs, where = f"--steps {config.steps}", config.envs, f"--recipe {config.recipe_file}"
    _refuse(
        config.steps <= config.demonstrated,
        f"{shown}: must be more than the {config.demonstrated:,} of the demonstrations; give "
        "more --steps, or fewer --demonstrations to tpm-gym train",
    )
    length = "train_freq" if config.argument("train_freq") else "n_steps"
    _refuse(
        config.steps - config.demonstrated < config.rollout,
        f"{shown}: one rollout takes {config.rollout:,} ({envs} environments x {length}); give "
        "more --steps, or fewer --envs to tpm-gym train",
    )
    if config.argument("normalize_advantage"):
        sizes = {length: config.rollout, "batch_size": config.argument("batch_size")}
        _refuse(
            min(sizes.values()) < 2,
            f"{where}: {min(sizes, key=sizes.__getitem__)}: 1: advantages of one step cannot be "
            "normalised; raise it, or set normalize_advantage: false",
        )
    if config.recipe.hindsight:  # hindsight samples from whole episodes only
        # A new episode deletes an earlier one from a full buffer, long before it is whole itself.
        for name, count, episodes in (
            ("learning_starts", 1, "an episode"),
            ("buffer_size", 2, "two episodes"),
        ):
            least = count * config.horizon
            few, most = config.argument(name), config.argument(name) * envs // least
            fewer = f", or give at most --envs {most}" if most else ""
            _refuse(
                few < least,
                f"{where}: {name}: {few} is less than the {least} steps of {episodes} in each of "
                f"{envs} environments; raise it in a --recipe of yours{fewer}",
            )


def _check_device(device: str) -> None:
    """Refuse a device that PyTorch does not have.

    PyTorch itself would refuse the device only after an earlier run in the folder was deleted.
    """
    import torch

    try:
        torch.zeros(1, device=device).item()  # fails on the device meta, which stores no numbers
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch without CUDA
        problem = str(error).partition("\n")[0]
        raise ConfigError(f"--device {device}: {problem}; try cpu") from error
