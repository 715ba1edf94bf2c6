"""Run the trainings and tests of docs/results.md as processes, some at once.

``results``: every recipe on its ids, five seeds each, tested on 1000 held-out episodes.
``penalty``: the same recipes with the singularity penalty off and on, on goals that tempt towards
the singularity. ``robustness``: the policies of ``results`` on machines never seen in training.

It can be stopped with Ctrl-C at any time and started again: trainings go on from their last
checkpoint. A training that fails is reported, and the others go on.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.configuration import UNSET, check_least, shown_default, unset
from tpm_gym.learning.environments import check_env_id
from tpm_gym.learning.errors import ConfigError, LearningError
from tpm_gym.learning.recipes import read_recipes, recipe_file
from tpm_gym.learning.report.page import NOMINAL, TEMPTING
from tpm_gym.learning.run_folder import CONFIG_FILE, TESTS, is_finished
from tpm_gym.tasks.registry import TASKS

_PENALTY_IDS: Final = ("TPMReach-v0", "TPMReachJoints-v0", "TPMPickAndPlaceJoints-v0")
_ROBUSTNESS_IDS: Final = ("TPMReach-v0", "TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0")
_WEIGHTS: Final = (0.0, 1.0)
_MACHINES: Final = ("encoder_noise=1e-4", "length_error=5e-4")
_MACHINES_WITH_PUCK: Final = (*_MACHINES, "puck_mass=2", "friction=0.5")

_stopping = threading.Event()
_running: set[subprocess.Popen[bytes]] = set()


@dataclass(frozen=True)
class StudyConfig:
    """Run the trainings and tests of docs/results.md; what is done already is left out."""

    plan: Literal["results", "penalty", "robustness"]
    """What to run; robustness needs the runs of results."""

    envs: Annotated[tuple[str, ...], shown_default("all for results, else three", "ID ...")] = ()
    """Environment ids."""

    steps: Annotated[int, unset(int, "as the recipes say", "INT")] = UNSET
    """Steps of each training. Runs of other lengths than their recipes' have folders of their own,
    which robustness, too, looks for."""

    algos: Annotated[tuple[str, ...], shown_default("all for results, else sac", "NAME ...")] = ()
    """Algorithms."""

    seeds: int = 5
    """Seeds, from 0 up."""

    episodes: int = 1000
    """Episodes of each test."""

    folder: Path = Path("runs/study")
    """Folder of the run folders."""

    jobs: int = 2
    """Runs at once; each uses one CPU core."""

    dry_run: bool = False
    """Print the commands that are left to run, and run none."""


@dataclass(frozen=True)
class Run:
    """A training and its tests.

    Attributes:
        options: Options of the training besides the others; None: the run is only tested.
        tests: Name of each test and options of its evaluation.
    """

    folder: Path
    env: str
    algo: str
    options: tuple[str, ...] | None
    tests: tuple[tuple[str, tuple[str, ...]], ...]


def plan_runs(config: StudyConfig) -> list[Run]:
    """Return the runs of a plan, the seeds of each id together.

    Raises:
        ConfigError: No run is left of the plan, or a number cannot work.
    """
    check_least(config, 1, "steps", "seeds", "episodes", "jobs")
    usual = tuple(ALGORITHMS) if config.plan == "results" else ("sac",)
    runs = [
        run
        for algo in config.algos or usual
        for env in _ids(config, algo)
        for seed in range(config.seeds)
        for run in _runs_of(config, env, algo, seed)
    ]
    if not runs:
        raise ConfigError(f"--envs {' '.join(config.envs)}: leaves no recipe of the plan")
    return runs


def _ids(config: StudyConfig, algo: str) -> list[str]:
    usual = {"results": (), "penalty": _PENALTY_IDS, "robustness": _ROBUSTNESS_IDS}
    wanted = config.envs or usual[config.plan]
    return [env for env in read_recipes(recipe_file(algo), algo) if not wanted or env in wanted]


def _runs_of(config: StudyConfig, env: str, algo: str, seed: int) -> list[Run]:
    name = f"{env}-{algo}"
    options = ["--seed", str(seed)]
    if config.steps is not UNSET:
        name += f"-{config.steps}steps"
        options += ["--steps", str(config.steps)]
    if config.plan == "penalty":
        goals = ("--goals", "tempting")
        return [
            Run(
                config.folder / f"{name}-tempting-w{weight:g}-s{seed}",
                env,
                algo,
                (*options, *goals, "--penalty-weight", f"{weight:g}"),
                ((TEMPTING, goals),),
            )
            for weight in _WEIGHTS
        ]
    folder = config.folder / f"{name}-s{seed}"
    if config.plan == "results":
        return [Run(folder, env, algo, tuple(options), ((NOMINAL, ()),))]
    puck = bool(TASKS[check_env_id(env).kwargs["task"]].scene.objects)
    machines = _MACHINES_WITH_PUCK if puck else _MACHINES
    tests = tuple((entry.split("=")[0], ("--randomisation", entry)) for entry in machines)
    return [Run(folder, env, algo, None, tests)]


# -- what is left to do ---------------------------------------------------------------------------


def commands(run: Run, episodes: int) -> list[list[str]]:
    """Return the commands that are left, tests of so many episodes; none where all is done."""
    left = []
    folder = str(run.folder)
    if run.options is not None and not is_finished(run.folder):
        if (run.folder / CONFIG_FILE).is_file():
            left.append(["tpm-gym", "resume", folder])
        else:
            options = ["--env", run.env, "--algo", run.algo, *run.options, "--run", folder]
            left.append(["tpm-gym", "train", *options])
    for name, changes in run.tests:
        file = run.folder / TESTS / f"{name}.json"
        if left or not _is_tested(file, episodes):
            test = ["tpm-gym", "evaluate", "--policy", folder, "--env", run.env]
            left.append([*test, "--episodes", str(episodes), *changes, "--json", str(file)])
    return left


def _is_tested(file: Path, episodes: int) -> bool:
    """Whether a test has been, with as many episodes; trainings delete those of other policies."""
    return file.is_file() and json.loads(file.read_bytes())["episodes"] == episodes


# -- running --------------------------------------------------------------------------------------


def execute(run: Run, episodes: int) -> bool:
    """Run what is left, with the output in a file beside the run; return whether all went well."""
    log = run.folder.with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    for command in commands(run, episodes):
        if _stopping.is_set():
            return False
        print(shlex.join(command), flush=True)
        with log.open("ab") as file:
            # Out of the terminal's process group: Ctrl-C is to reach a training once, from here.
            process = subprocess.Popen(
                [sys.executable, "-m", "tpm_gym.learning", *command[1:]],
                stdout=file,
                stderr=file,
                start_new_session=True,
            )
            _running.add(process)
            if _stopping.is_set():
                process.terminate()
            status = process.wait()
            _running.discard(process)
        if status != 0:
            how = "stopped" if _stopping.is_set() else f"failed with status {status}, see {log}"
            print(f"{how}: {shlex.join(command)}", flush=True)
            return False
    return True


def _stop(*_: Any) -> None:
    """Let the trainings save a checkpoint and end, and start nothing more."""
    _stopping.set()
    for process in list(_running):
        process.terminate()


def study(config: StudyConfig) -> None:
    """Run a plan, or show it.

    Raises:
        ConfigError: An option is not valid, or robustness lacks the runs of results.
        LearningError: Some runs failed, or were stopped.
    """
    runs = plan_runs(config)
    if config.dry_run:
        left = [command for run in runs for command in commands(run, config.episodes)]
        print(*map(shlex.join, left), sep="\n")
        return
    for run in runs:
        if run.options is None and not is_finished(run.folder):
            needed = f"needs the finished run {run.folder}; run --plan results first"
            raise ConfigError(f"--plan {config.plan}: {needed}")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as many threads as cores would share them
    with ThreadPoolExecutor(config.jobs) as pool:
        outcomes = list(pool.map(partial(execute, episodes=config.episodes), runs))
    if failures := outcomes.count(False):
        raise LearningError(f"{failures} runs failed or were stopped; start again to go on")
