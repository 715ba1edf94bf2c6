"""Plans: trainings with their tests, and bisections; and the commands that are left of them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import gymnasium

from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.recipes import read_recipes, recipe_file
from tpm_gym.learning.run_folder import CONFIG_FILE, TESTS, WHOLE, is_finished
from tpm_gym.policy.files import published
from tpm_gym.simulation.engine import require_engine
from tpm_gym.simulation.randomisation import LIMITS
from tpm_gym.tasks.registry import TASKS
from tpm_gym.tasks.task import Task

from .bisection import OBJECT_ATTRIBUTES, SERVO_ATTRIBUTES, ends, halving

PENALTY_WEIGHTS: Final = (0.0, 1.0)
MACHINES: Final = ("wide", "delta")
"""Machines that docs/compare.md compares with the paper's, whose runs are those of "results"."""
STUDIED: Final = ("Reach", "PickAndPlace")
"""Tasks of the plans; others are studied where `--envs` names them."""


@dataclass(frozen=True)
class Study:
    """Run the trainings and tests of docs/results.md, except those that are done.

    "results" trains each recipe with each seed, and that of sac or tqc without demonstrations too
    if it has some. "penalty" trains without and with the singularity penalty on goals that tempt
    towards the singularity. "machines" trains pick-and-place on other machines than the paper's,
    for docs/compare.md. "robustness" tests the published policies on machines that differ in
    one attribute. "benchmark" trains each id that has a recipe: with ppo, or else with sac.

    A study can be stopped with Ctrl-C and started again: trainings resume from their last
    checkpoint. They also resume, on another node, when their process or node dies.
    """

    plan: Literal["results", "penalty", "machines", "robustness", "benchmark"]
    """Kind of study."""

    engine: str = "pybullet"
    """Engine to train in; for robustness, engine to test in."""

    envs: tuple[str, ...] = ()
    """Environment ids; default: all of the plan."""

    steps: int | None = None
    """Steps of each training; default: as in the recipes. Other lengths get folders of their
    own."""

    algos: tuple[str, ...] = ()
    """Algorithms; default: sac and ppo, for penalty and machines ppo, for
    benchmark one of both."""

    seeds: int = 5
    """Number of seeds, from 0 up."""

    episodes: int = 1000
    """Episodes of each test in --engine."""

    pybullet_episodes: int = 200
    """Episodes of each test in PyBullet of a policy that was trained in another engine."""

    folder: Path = Path("runs/study")
    """Folder of the run folders. All nodes of a cluster must see it, and the working folder, at
    the same path."""

    address: str | None = None
    """HOST:PORT of a Ray cluster, as printed by ray start --head. This machine must be one of its
    nodes. Default: this machine alone."""

    jobs: int = 2
    """Runs at a time on this machine alone; each uses one CPU core."""

    dry_run: bool = False
    """Print the commands that are left, and run none. A bisection shows its next command only."""


@dataclass(frozen=True)
class Run:
    """Training with its tests.

    Attributes:
        options: Further options of the training.
        tests: Name, number of episodes and options of each test.
    """

    folder: Path
    env: str
    algo: str
    options: tuple[str, ...]
    tests: tuple[tuple[str, int, tuple[str, ...]], ...]

    def left(self) -> list[list[str]]:
        """Return the commands that are left; an empty list if all is done."""
        left = []
        folder = str(self.folder)
        if not is_finished(self.folder):
            if (self.folder / CONFIG_FILE).is_file():
                left.append(["tpm-gym", "resume", folder])
            else:
                options = ["--env", self.env, "--algo", self.algo, *self.options, "--run", folder]
                left.append(["tpm-gym", "train", *options])
        for name, episodes, changes in self.tests:
            file = self.folder / TESTS / f"{name}.json"
            # Trainings delete the tests of earlier policies.
            if left or not (file.is_file() and _test(file)["episodes"] == episodes):
                left.append(_evaluation(folder, self.env, episodes, changes, file))
        return left


@dataclass(frozen=True)
class Bisection:
    """Tests of a published policy that find the size of an attribute at which success halves."""

    folder: Path
    env: str
    attribute: str
    episodes: int
    engine: str = "pybullet"

    def left(self) -> list[list[str]]:
        """Return the next command; an empty list if all is done."""
        successes = {}
        for file in sorted((self.folder / TESTS).glob(WHOLE)):
            test = _test(file)
            if test["episodes"] == self.episodes:
                value = test["randomisation"][self.attribute]
                successes[float(value)] = test["success_at_end"]["mean"]
        for end in ends(self.attribute):
            value = halving(self.attribute, end, successes).missing
            if value is not None:
                drive = ("--drive", "servo") if self.attribute in SERVO_ATTRIBUTES else ()
                engine = ("--engine", self.engine)
                changes = (*engine, *drive, "--randomisation", f"{self.attribute}={value:g}")
                file = self.folder / TESTS / f"{value:g}.json"
                return [_evaluation(self.env, self.env, self.episodes, changes, file)]
        return []


def _evaluation(
    policy: str, env: str, episodes: int, changes: tuple[str, ...], file: Path
) -> list[str]:
    test = ["tpm-gym", "evaluate", "--policy", policy, "--env", env]
    return [*test, "--episodes", str(episodes), *changes, "--json", str(file)]


def _test(file: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(file.read_bytes())
    return content


def plan_runs(study: Study) -> list[Run] | list[Bisection]:
    """Return the runs of a study; the seeds of an id follow each other.

    Raises:
        ConfigError: --envs leaves no run, or a number is too small.
        ConfigurationError: There is no such engine.
    """
    require_engine(study.engine)
    for name in ("steps", "seeds", "episodes", "pybullet_episodes", "jobs"):
        value = getattr(study, name)
        if value is not None and value < 1:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: must be at least 1")
    runs = _bisections(study) if study.plan == "robustness" else _trainings(study)
    if not runs:
        left = "no published policy" if study.plan == "robustness" else "no recipe of the plan"
        raise ConfigError(f"--envs {' '.join(study.envs)}: leaves {left}; the default is all")
    return runs


def _task(env: str) -> type[Task]:
    return TASKS[gymnasium.spec(env).kwargs["task"]]


def _bisections(study: Study) -> list[Bisection]:
    return [
        Bisection(
            study.folder / f"{env}-{attribute}-{study.engine}",
            env,
            attribute,
            study.episodes,
            study.engine,
        )
        for env in published()
        if not study.envs or env in study.envs
        for attribute in LIMITS
        if attribute not in OBJECT_ATTRIBUTES or _task(env).scene.objects
    ]


def _trainings(study: Study) -> list[Run]:
    # TQC takes almost twice as long as SAC, and has not learned better.
    usual = {"results": ("sac", "ppo"), "benchmark": ("ppo", "sac")}.get(study.plan, ("ppo",))
    runs = [
        run
        for algo in study.algos or usual
        for env, recipe in read_recipes(recipe_file(algo, study.engine), algo).items()
        if (env in study.envs if study.envs else _is_studied(study, env))
        for seed in range(study.seeds)
        for run in _runs_of_seed(study, env, algo, seed, "demonstrations" in recipe)
    ]
    first = {run.env: run.algo for run in reversed(runs)}
    return [run for run in runs if study.plan != "benchmark" or run.algo == first[run.env]]


def _is_studied(study: Study, env: str) -> bool:
    if study.plan == "benchmark":
        return True
    of_machines = env == "TPMPickAndPlaceDense-v0"
    return of_machines if study.plan == "machines" else _task(env).__name__ in STUDIED


def _runs_of_seed(study: Study, env: str, algo: str, seed: int, demonstrated: bool) -> list[Run]:
    name = f"{env}-{algo}-{study.engine}"
    options = ["--engine", study.engine, "--test-episodes", "0", "--seed", str(seed)]
    if study.steps is not None:
        name += f"-{study.steps}steps"
        options += ["--steps", str(study.steps)]
    engines = {"pybullet": study.pybullet_episodes, study.engine: study.episodes}

    def run(variant: str, *changes: str, goals: tuple[str, ...] = ()) -> Run:
        tests = tuple(
            (engine, episodes, ("--engine", engine, *goals)) for engine, episodes in engines.items()
        )
        folder = study.folder / f"{name}{variant}-s{seed}"
        return Run(folder, env, algo, (*options, *goals, *changes), tests)

    if study.plan == "benchmark":
        return [run("")]
    if study.plan == "results":
        # Without demonstrations and hindsight, PPO finds no sparse reward.
        tried = demonstrated and algo != "ppo"
        from_scratch = [run("-scratch", "--demonstrations", "0")] if tried else []
        return [run(""), *from_scratch]
    if study.plan == "machines":
        return [run(f"-{machine}", "--machine", machine) for machine in MACHINES]
    return [
        run(
            f"-tempting-w{weight:g}",
            *("--penalty-weight", f"{weight:g}"),
            goals=("--goals", "tempting"),
        )
        for weight in PENALTY_WEIGHTS
    ]
