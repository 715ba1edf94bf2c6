"""Run all trainings and tests of docs/results.md, two at a time; what is done already is skipped.

    python train/study.py --plan results --envs TPMReach-v0 --dry-run
    python train/study.py --plan penalty
    python train/study.py --plan penalty --envs TPMPickAndPlaceJoints-v0 --steps 100000

``results``: every recipe on its ids, five seeds each, tested on 1000 held-out episodes.
``penalty``: the same recipes with the singularity penalty off and on, on goals that tempt towards
the singularity. ``robustness``: the policies of ``results`` on machines never seen in training.

It can be stopped with Ctrl-C at any time and started again: trainings go on from their last
checkpoint. A training that fails is reported, and the others go on.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import statistics
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro

from tpm_gym.learning.configuration import Config as TrainConfig
from tpm_gym.learning.configuration import make_plan
from tpm_gym.learning.errors import ConfigError, TrainError
from tpm_gym.learning.options import default
from tpm_gym.learning.policies import CONFIG_FILE, EVALUATIONS_FILE, TESTS
from tpm_gym.learning.recipes import read_recipes
from tpm_gym.learning.report import WHOLE, read_whole_lines
from tpm_gym.learning.report_page import NOMINAL, TEMPTING
from tpm_gym.resources import RECIPES

_HERE: Final = Path(__file__).parent
_PENALTY_IDS: Final = ("TPMReach-v0", "TPMReachJoints-v0", "TPMPickAndPlaceJoints-v0")
_ROBUSTNESS_IDS: Final = ("TPMReach-v0", "TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0")
_WEIGHTS: Final = (0.0, 1.0)
_MACHINES: Final = {
    "encoder_noise": "encoder_noise=1e-4",
    "length_error": "length_error=5e-4",
    "puck_mass": "puck_mass=2",
    "friction": "friction=0.5",
}
_NEEDS_PUCK: Final = ("puck_mass", "friction")

_stopping = threading.Event()
_running: set[subprocess.Popen[bytes]] = set()


@dataclass(frozen=True)
class Config:
    """Run the trainings and tests of docs/results.md."""

    plan: Literal["results", "penalty", "robustness"]
    """What to run; robustness needs the runs of results."""

    envs: Annotated[tuple[str, ...], default("all for results, else three", "ID ...")] = ()
    """Environment ids."""

    steps: Annotated[int | None, default("as the recipes say", "INT")] = None
    """Steps of each training. Runs of other lengths than their recipes' have folders of their own,
    which robustness, too, looks for."""

    algos: Annotated[tuple[str, ...], default("all for results, else sac", "NAME ...")] = ()
    """Algorithms: sac, tqc, ppo."""

    seeds: int = 5
    """Seeds, from 0 up."""

    episodes: int = 1000
    """Episodes of each test."""

    folder: Path = Path("runs/study")
    """Folder of the run folders."""

    jobs: int = 2
    """Runs at once; each uses one CPU core."""

    dry_run: bool = False
    """Print the commands that are left to run, and an estimate of their time, and run none."""


@dataclass(frozen=True)
class Run:
    """A training and its tests.

    Attributes:
        folder: The run folder.
        env: Environment id.
        algo: Algorithm.
        options: Options of train.py besides those; None: the run is only tested.
        tests: Name of each test and options of evaluate.py for it.
    """

    folder: Path
    env: str
    algo: str
    options: tuple[str, ...] | None
    tests: tuple[tuple[str, tuple[str, ...]], ...]


def plan_runs(config: Config) -> list[Run]:
    """Return the runs of a plan, the seeds of each id together.

    Raises:
        ConfigError: No run is left of the plan, or a number cannot work.
    """
    for option, value in {
        "--steps": config.steps,
        "--seeds": config.seeds,
        "--episodes": config.episodes,
        "--jobs": config.jobs,
    }.items():
        if value is not None and value < 1:
            raise ConfigError(option, value, "must be at least 1")
    usual = ("sac", "tqc", "ppo") if config.plan == "results" else ("sac",)
    runs = [
        run
        for algo in config.algos or usual
        for env in _ids(config, algo)
        for seed in range(config.seeds)
        for run in _runs_of(config, env, algo, seed)
    ]
    if not runs:
        raise ConfigError("--envs", " ".join(config.envs), "leaves no recipe of the plan")
    return runs


def _ids(config: Config, algo: str) -> list[str]:
    """Ids that the plan has for an algorithm."""
    file = RECIPES / f"{algo}.yml"
    if not file.is_file():
        raise ConfigError("--algos", algo, f"has no recipes in {RECIPES.name}/")
    usual = {"results": (), "penalty": _PENALTY_IDS, "robustness": _ROBUSTNESS_IDS}
    wanted = config.envs or usual[config.plan]
    return [env for env in read_recipes(file, algo) if not wanted or env in wanted]


def _runs_of(config: Config, env: str, algo: str, seed: int) -> list[Run]:
    """The runs of one id, algorithm and seed."""
    name = f"{env}-{algo}"
    options = ["--seed", str(seed)]
    if config.steps is not None:
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
    machines = {
        machine: ("--randomisation", entry)
        for machine, entry in _MACHINES.items()
        if "PickAndPlace" in env or machine not in _NEEDS_PUCK
    }
    return [Run(folder, env, algo, None, tuple(machines.items()))]


# -- what is left to do ---------------------------------------------------------------------------


def commands(run: Run, episodes: int) -> list[list[str]]:
    """Return the commands that are left to run, in order; none where all is done.

    Args:
        run: The run.
        episodes: Episodes of each test.
    """
    left = []
    where = ["--run", str(run.folder)]
    if run.options is not None and not _is_finished(run.folder):
        script = ["python", "train/train.py"]
        if (run.folder / CONFIG_FILE).is_file():
            left.append([*script, *where, "--resume"])
        else:
            left.append([*script, "--env", run.env, "--algo", run.algo, *run.options, *where])
    for name, changes in run.tests:
        file = run.folder / TESTS / f"{name}.json"
        if left or not _is_tested(file, episodes):
            test = ["python", "train/evaluate.py", "--policy", str(run.folder), "--env", run.env]
            left.append([*test, "--episodes", str(episodes), *changes, "--json", str(file)])
    return left


def _is_tested(file: Path, episodes: int) -> bool:
    """Whether a test has been, with as many episodes; train.py deletes those of other policies."""
    return file.is_file() and json.loads(file.read_bytes())["episodes"] == episodes


def _is_finished(folder: Path) -> bool:
    """Whether a training has gone to its end, and its policy was exported."""
    progress = _progress(folder)
    return (
        progress is not None
        and progress[0] >= progress[2]
        and (folder / "best.json").is_file()
        and (folder / "last.json").is_file()
    )


def _progress(folder: Path) -> tuple[int, float, int] | None:
    """Steps and seconds at the last evaluation of a run, and its steps in all; None before it."""
    lines = read_whole_lines(folder / EVALUATIONS_FILE)
    if not lines or not (folder / CONFIG_FILE).is_file():
        return None
    config = json.loads((folder / CONFIG_FILE).read_bytes())
    return int(lines[-1]["steps"]), float(lines[-1]["wall_seconds"]), int(config["steps"])


def estimate(run: Run, config: Config) -> tuple[float | None, float | None]:
    """Return the seconds that the training of a run and its tests will still take.

    Args:
        run: The run.
        config: The plan; other runs in its folder hold the times to estimate from.

    Returns:
        Seconds for the training and for the tests; None where nothing of its kind has been timed.
    """
    left = commands(run, config.episodes)
    training = 0.0 if _is_finished(run.folder) else _time_to_train(run, config)
    tests = sum("train/evaluate.py" in command for command in left)
    pace = _seconds_an_episode(run.env, config.folder)
    testing = tests * config.episodes * pace if pace is not None else None
    return training if run.options is not None else 0.0, testing if tests else 0.0


def _time_to_train(run: Run, config: Config) -> float | None:
    """Seconds from where a training is to its end, at the median pace of all of its kind."""
    found = [_progress(other) for other in config.folder.glob(f"{run.env}-{run.algo}-*")]
    paces = [progress[1] / progress[0] for progress in found if progress and progress[0] > 0]
    if not paces:
        return None
    own = _progress(run.folder)
    training = TrainConfig(algo=run.algo, env=run.env, steps=config.steps)  # type: ignore[arg-type]
    steps = make_plan(training).steps
    return statistics.median(paces) * (steps - (own[0] if own else 0))


def _seconds_an_episode(env: str, folder: Path) -> float | None:
    """Median over the tests that there are."""
    files = folder.glob(f"{env}-*/{TESTS}/{WHOLE}")
    found = [json.loads(path.read_bytes()) for path in files]
    return statistics.median(f["wall_seconds"] / f["episodes"] for f in found) if found else None


# -- running --------------------------------------------------------------------------------------


def execute(run: Run, episodes: int) -> bool:
    """Run what is left of a run, with the output in files beside its folder.

    Args:
        run: The run.
        episodes: Episodes of each test.

    Returns:
        Whether all went well.
    """
    log = run.folder.with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    for command in commands(run, episodes):
        if _stopping.is_set():
            return False
        print(shlex.join(command), flush=True)
        with log.open("ab") as file:
            script = str(_HERE / Path(command[1]).name)
            # Out of the terminal's process group: Ctrl-C is to reach a training once, from here.
            process = subprocess.Popen(
                [sys.executable, script, *command[2:]],
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


def _show(config: Config, runs: Sequence[Run]) -> None:
    """Print what is left to do, and for how long."""
    for run in runs:
        for command in commands(run, config.episodes):
            print(shlex.join(command))
    times = [estimate(run, config) for run in runs]
    for name, column in zip(("trainings", "tests"), zip(*times, strict=True), strict=True):
        known = [seconds for seconds in column if seconds is not None]
        hours = sum(known) / config.jobs / 3600
        parts = [f"{hours:.2f} h with {config.jobs} at once"] if known else []
        if unknown := len(column) - len(known):
            parts.append(f"{unknown} runs that nothing like has been timed here")
        print(f"# {name}: {', and '.join(parts)}")


def study(config: Config) -> int:
    """Run a plan, or show it.

    Args:
        config: The plan.

    Returns:
        How many runs failed.

    Raises:
        ConfigError: An option is not valid, or robustness lacks the runs of results.
    """
    runs = plan_runs(config)
    if config.dry_run:
        _show(config, runs)
        return 0
    for run in runs:
        if run.options is None and not _is_finished(run.folder):
            valid = f"needs the finished run {run.folder}; run --plan results first"
            raise ConfigError("--plan", config.plan, valid)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as many threads as cores would share them
    with ThreadPoolExecutor(config.jobs) as pool:
        outcomes = list(pool.map(partial(execute, episodes=config.episodes), runs))
    return outcomes.count(False)


def main() -> None:
    """Run the command line."""
    config = tyro.cli(Config, description=__doc__)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    try:
        failures = study(config)
    except TrainError as error:
        sys.exit(f"error: {error}")
    if failures:
        sys.exit(f"error: {failures} runs failed or were stopped; start again to go on")


if __name__ == "__main__":
    main()
