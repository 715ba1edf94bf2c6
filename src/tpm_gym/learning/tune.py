"""Search for hyperparameters: Optuna proposes, Ray Tune runs trainings in parallel.

Each trial trains a variant of the environment's recipe, in a run folder of its own. The score of a
trial is the mean success of its last three evaluations, plus a thousandth of their mean return. So
the return decides between trials with equal success.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Final

import tyro
import yaml

from tpm_gym.learning import provenance
from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.configuration import (
    UNSET,
    EnvOptions,
    GivenEnvOptions,
    Randomised,
    TrainingConfig,
    check_least,
    check_seed,
    complete,
    unset,
)
from tpm_gym.learning.environments import make_env
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.run_folder import evaluations

RECIPE_FILE: Final = "recipe.yml"
"""File of the best recipe in the folder of a search; give it to ``train --recipe``."""

_MOST_JOBS: Final = 10_000
# Options that TuneConfig and TrainingConfig have in common.
_SHARED: Final = ("algo", "env", "steps", "env_options", "randomisation")

_SPACE: Final[Mapping[str, Sequence[float]]] = {
    "learning_rate": (0.0003, 0.0006, 0.001, 0.002, 0.003),
    "gamma": (0.9, 0.95, 0.98),
    "batch_size": (128, 256, 512, 1024),
    "tau": (0.005, 0.02, 0.05),
    "n_epochs": (4, 8, 12),
    "gae_lambda": (0.8, 0.9, 0.95),
    "clip_range": (0.1, 0.2, 0.3),
    "max_grad_norm": (0.5, 2.0, 5.0),
    "policy_kwargs.log_std_init": (-1.5, -1.0, -0.5, 0.0),
}
"""Values to choose from, by entry of the recipe.

Entries that an algorithm does not have are not searched. If the recipe's learning rate falls to
zero during the training, the chosen learning rate is the initial value, and also falls to zero.
"""


@dataclass(frozen=True)
class TuneConfig:
    """Search for a recipe: many trainings, each with different hyperparameters, in parallel."""

    algo: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(ALGORITHMS) + "}")] = "ppo"
    """Algorithm."""

    env: Annotated[str, tyro.conf.arg(metavar="ID")] = "TPMReachDense-v0"
    """Environment id, or module:id if a module of yours registers it."""

    trials: int = 30
    """Number of trainings."""

    steps: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Steps of each training."""

    jobs: Annotated[int, unset(int, "one for each core", "INT")] = UNSET
    """Number of parallel trainings, on this computer or the Ray cluster that RAY_ADDRESS names."""

    seed: int = 0
    """Seed of the search; training i has this seed + i."""

    folder: Annotated[Path, unset(Path, "runs/tune-<env>-<algo>", "FOLDER")] = UNSET
    """New folder for the runs, their logs and the best recipe."""

    env_options: GivenEnvOptions = field(default_factory=EnvOptions)

    randomisation: Randomised = ()
    """Domain randomisation, as in the command tpm-gym train."""


def tune(config: TuneConfig) -> Path:
    """Run a search and write the best recipe; return its file. Ray Tune prints a table meanwhile.

    Raises:
        ConfigError: An option is not valid, the folder exists, or no training ended.
        MissingPackageError: Ray Tune or Optuna is missing.
    """
    provenance.require_packages({"ray": "cluster", "optuna": "cluster"})
    check_least(config, 1, "trials", "jobs", "steps")
    if (config.jobs or 1) > _MOST_JOBS:
        raise ConfigError(f"--jobs {config.jobs}: must be at most {_MOST_JOBS:,}")
    name = config.env.rpartition(":")[2]
    folder = config.folder or Path("runs", f"tune-{name}-{config.algo}")
    if folder.exists():
        raise ConfigError(f"--folder {folder}: exists; give another")
    shared = {name: getattr(config, name) for name in _SHARED}
    print("loading PyTorch ...", flush=True)
    base = complete(TrainingConfig(**shared, test_episodes=0))
    check_seed(config.seed, base.envs + config.trials - 1)  # of the last training, too
    with closing(make_env(**base.env_arguments)):  # refuses an unknown machine or engine
        pass
    provenance.require_writable("--folder", folder)
    print(f"{config.trials} trainings of {base.steps:,} steps; their logs: {folder}/NNN.log")
    print("starting Ray, which takes some seconds ...", flush=True)
    best = _search(config, base, folder.resolve())
    _write(folder / RECIPE_FILE, base, best)
    return folder / RECIPE_FILE


def _search(config: TuneConfig, base: TrainingConfig, folder: Path) -> Mapping[str, Any]:
    """Run all trials; return the best trial's changes to the recipe."""
    import ray
    from optuna.samplers import TPESampler
    from ray import tune as ray_tune
    from ray.tune.search.optuna import OptunaSearch

    here = Path.cwd()  # Ray Tune works in folders of its own

    def trainable(changes: dict[str, Any]) -> None:
        ray_tune.report({"score": _train(base, changes, folder, config.seed, here)})

    sampler, space = TPESampler(seed=config.seed), partial(_suggest, config.algo)
    search = OptunaSearch(space, metric="score", mode="max", sampler=sampler)
    settings = ray_tune.TuneConfig(
        search_alg=search, num_samples=config.trials, max_concurrent_trials=config.jobs
    )
    storage = ray_tune.RunConfig(name="ray", storage_path=str(folder), verbose=1)
    with _started(ray, config.jobs):
        results: Any = ray_tune.Tuner(trainable, tune_config=settings, run_config=storage).fit()
    if not (ended := [result for result in results if result.error is None]):
        raise ConfigError(f"--folder {folder}: no training ended; see {folder}/000.log")
    best: Mapping[str, Any] = max(ended, key=lambda result: result.metrics["score"]).config
    return best


@contextmanager
def _started(ray: Any, jobs: int | None) -> Iterator[None]:
    """Start Ray on this computer or join the cluster at RAY_ADDRESS, unless Ray runs already."""
    if ray.is_initialized():
        yield
        return
    address = os.environ.get("RAY_ADDRESS")
    quiet = {"include_dashboard": False, "log_to_driver": False}
    try:
        # "local" never joins a cluster of others on this computer. For the cluster at RAY_ADDRESS,
        # Ray refuses num_cpus.
        ray.init(**quiet) if address else ray.init("local", num_cpus=jobs, **quiet)
    except ConnectionError as error:
        raise ConfigError(f"RAY_ADDRESS {address}: {error}; start Ray there") from error
    try:
        yield
    finally:
        ray.shutdown()


def _suggest(algorithm: str, trial: Any) -> dict[str, Any]:
    """Let Optuna choose the values of a trial; return a dictionary with the trial's number.

    Ray Tune adds the chosen values to this dictionary and passes it to :func:`_train` as
    ``changes``.
    """
    known = ALGORITHMS[algorithm].entries().__annotations__
    for name, values in _SPACE.items():
        entries = known["policy_kwargs"].__annotations__ if "." in name else known
        if name.rpartition(".")[2] in entries:
            trial.suggest_categorical(name, values)
    return {"trial": trial.number}


def _train(
    base: TrainingConfig, changes: Mapping[str, Any], folder: Path, seed: int, here: Path
) -> float:
    """Train a variant of the recipe, with the working directory ``here``; return its score."""
    number = changes["trial"]
    run, recipe, log = (folder / f"{number:03d}{end}" for end in ("", ".yml", ".log"))
    _write(recipe, base, changes)
    options = {"algo": base.algo, "env": base.env, "steps": base.steps, "seed": seed + number}
    options |= {"recipe": recipe, "run": run, "test-episodes": 0, **base.env_options.given()}
    words = [f"--{key}={value}" for key, value in options.items()]
    words += ["--randomisation", *base.randomisation] if base.randomisation else []
    # In a process of its own: Ray Tune calls this in a thread, which cannot receive signals.
    with log.open("w", encoding="utf-8") as file:
        command = [sys.executable, "-m", "tpm_gym.learning", "train", *words]
        subprocess.run(command, stdout=file, stderr=file, cwd=here, check=True)
    last = evaluations(run)[-3:]
    return fmean(e["success_at_end"]["mean"] + e["return"]["mean"] / 1000 for e in last)


def _write(file: Path, base: TrainingConfig, changes: Mapping[str, Any]) -> None:
    """Write the recipe of ``base``, with the changes of a trial, to ``file``."""
    entries = {**base.recipe.entries(), "n_timesteps": base.steps}
    policy = entries["policy_kwargs"] = dict(entries.get("policy_kwargs", {}))
    for name, value in changes.items():
        if name.startswith("policy_kwargs."):
            policy[name.partition(".")[2]] = value
        elif name == "learning_rate" and isinstance(entries.get(name), str):
            entries[name] = f"lin_{value}"
        elif name != "trial":
            entries[name] = value
    text = yaml.safe_dump({base.env.rpartition(":")[2]: entries}, sort_keys=False)
    provenance.write_whole(file, lambda part: part.write_text(text, encoding="utf-8"))
