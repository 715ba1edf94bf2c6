"""Run the trainings and tests of docs/results.md on Ray: some at once here, or on a cluster.

``results``: the recipes on their ids, five seeds each, from scratch too where they have
demonstrations.
``penalty``: PPO's with the singularity penalty off and on, on goals that tempt towards the
singularity. ``robustness``: the published policies on machines that differ more and more in one
thing, until success has halved. What is trained is tested in its engine, and in PyBullet.

It can be stopped with Ctrl-C at any time and started again: trainings go on from their last
checkpoint. So do, elsewhere and at once, those whose process or node dies. A training that fails is
reported, and the others go on.

Checkpoints travel by disk alone: all nodes of a cluster have to see the working folder and
``--folder``, at the same paths. Runs fail on a node that does not.
"""

import json
import os
import shlex
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from tpm_gym.learning import cluster
from tpm_gym.learning.configuration import UNSET, check_least, shown_default, unset
from tpm_gym.learning.environments import check_env_id
from tpm_gym.learning.errors import ConfigError, LearningError, RunError
from tpm_gym.learning.provenance import require_writable
from tpm_gym.learning.recipes import read_recipes, recipe_file
from tpm_gym.learning.robustness import OF_PUCK, OF_SERVOS, ends, halving
from tpm_gym.learning.run_folder import CONFIG_FILE, TESTS, WHOLE, claimed, is_finished
from tpm_gym.policy.files import published
from tpm_gym.simulation.engine import require_engine
from tpm_gym.simulation.randomisation import LIMITS
from tpm_gym.tasks.registry import TASKS

_WEIGHTS: Final = (0.0, 1.0)
_STOPPED: Final = (128 + signal.SIGINT, 128 + signal.SIGTERM)
_GRACE: Final = 30.0  # s


@dataclass(frozen=True)
class StudyConfig:
    """Run the trainings and tests of docs/results.md; what is done already is left out."""

    plan: Literal["results", "penalty", "robustness"]
    """What to run; robustness tests the published policies, and trains nothing."""

    engine: str = "pybullet"
    """Engine to train in, with its own recipes where there are; of robustness, to test in."""

    envs: Annotated[tuple[str, ...], shown_default("all", "ID ...")] = ()
    """Environment ids."""

    steps: Annotated[int, unset(int, "as the recipes say", "INT")] = UNSET
    """Steps of each training. Runs of other lengths than their recipes' have folders of their
    own."""

    algos: Annotated[tuple[str, ...], shown_default("sac ppo, for penalty ppo", "NAME ...")] = ()
    """Algorithms."""

    seeds: int = 5
    """Seeds of the trainings, from 0 up."""

    episodes: int = 1000
    """Episodes of each test in --engine."""

    pybullet_episodes: int = 200
    """Episodes of each test in PyBullet of what was trained in another engine."""

    folder: Path = Path("runs/study")
    """Folder of the run folders; all nodes of a cluster have to see it, and the working folder."""

    address: Annotated[str | None, unset(str, "this machine alone", "HOST:PORT")] = None
    """Ray cluster to run on, as ray start --head prints it, of which this machine is a node. It
    runs as much at once as it has CPUs."""

    jobs: int = 2
    """Runs at once on this machine alone; each uses one CPU core."""

    dry_run: bool = False
    """Print the commands that are left to run, and run none. Of a bisection that is the next."""


@dataclass(frozen=True)
class Run:
    """A training and its tests.

    Attributes:
        options: Options of the training besides the others.
        tests: Name of each test, number of its episodes, and options of its evaluation.
    """

    folder: Path
    env: str
    algo: str
    options: tuple[str, ...]
    tests: tuple[tuple[str, int, tuple[str, ...]], ...]

    def left(self) -> list[list[str]]:
        """Return the commands that are left; none where all is done."""
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
    """Tests of a published policy that find at which size of an attribute success halves."""

    folder: Path
    env: str
    attribute: str
    episodes: int
    engine: str = "pybullet"

    def left(self) -> list[list[str]]:
        """Return the next command; none where all is done."""
        successes = {}
        for file in sorted((self.folder / TESTS).glob(WHOLE)):
            test = _test(file)
            if test["episodes"] == self.episodes:
                value = test["randomisation"][self.attribute]
                successes[float(value)] = test["success_at_end"]["mean"]
        for end in ends(self.attribute):
            value = halving(self.attribute, end, successes).missing
            if value is not None:
                drive = ("--drive", "servo") if self.attribute in OF_SERVOS else ()
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


# -- plans ----------------------------------------------------------------------------------------


def plan_runs(config: StudyConfig) -> list[Run] | list[Bisection]:
    """Return the runs of a plan, the seeds of each id together.

    Raises:
        ConfigError: No run is left of the plan, or a number cannot work.
        ConfigurationError: There is no such engine.
    """
    require_engine(config.engine)
    check_least(config, 1, "steps", "seeds", "episodes", "pybullet_episodes", "jobs")
    runs = _bisections(config) if config.plan == "robustness" else _trainings(config)
    if not runs:
        left = "no published policy" if config.plan == "robustness" else "no recipe of the plan"
        raise ConfigError(f"--envs {' '.join(config.envs)}: leaves {left}; the default is all")
    return runs


def _bisections(config: StudyConfig) -> list[Bisection]:
    return [
        Bisection(
            config.folder / f"{env}-{attribute}-{config.engine}",
            env,
            attribute,
            config.episodes,
            config.engine,
        )
        for env in published()
        if not config.envs or env in config.envs
        for attribute in LIMITS
        if attribute not in OF_PUCK or TASKS[check_env_id(env).kwargs["task"]].scene.objects
    ]


def _trainings(config: StudyConfig) -> list[Run]:
    # TQC needs two and a half times SAC's time, and has not learned better.
    usual = ("sac", "ppo") if config.plan == "results" else ("ppo",)
    return [
        run
        for algo in config.algos or usual
        for env in _recipes(config, algo)
        if not config.envs or env in config.envs
        for seed in range(config.seeds)
        for run in _runs_of(config, env, algo, seed)
    ]


def _recipes(config: StudyConfig, algo: str) -> dict[str, dict[str, Any]]:
    return read_recipes(recipe_file(algo, config.engine), algo)


def _runs_of(config: StudyConfig, env: str, algo: str, seed: int) -> list[Run]:
    name = f"{env}-{algo}-{config.engine}"
    options = ["--engine", config.engine, "--test-episodes", "0", "--seed", str(seed)]
    if config.steps is not UNSET:
        name += f"-{config.steps}steps"
        options += ["--steps", str(config.steps)]
    engines = {"pybullet": config.pybullet_episodes, config.engine: config.episodes}

    def run(variant: str, *changes: str, goals: tuple[str, ...] = ()) -> Run:
        tests = tuple(
            (engine, episodes, ("--engine", engine, *goals)) for engine, episodes in engines.items()
        )
        folder = config.folder / f"{name}{variant}-s{seed}"
        return Run(folder, env, algo, (*options, *goals, *changes), tests)

    if config.plan == "results":
        from_scratch = [run("-scratch", "--demonstrations", "0")]
        demonstrated = "demonstrations" in _recipes(config, algo)[env]
        return [run(""), *(from_scratch if demonstrated else ())]
    goals = ("--goals", "tempting")
    return [
        run(f"-tempting-w{weight:g}", "--penalty-weight", f"{weight:g}", goals=goals)
        for weight in _WEIGHTS
    ]


# -- running --------------------------------------------------------------------------------------


def study(config: StudyConfig) -> None:
    """Run a plan, or show it.

    Raises:
        ConfigError: An option is not valid.
        LearningError: Some runs failed, or were stopped.
        MissingPackageError: Ray is not installed.
    """
    runs = plan_runs(config)
    if config.dry_run:
        left = [command for run in runs for command in run.left()]
        print(*map(shlex.join, left), sep="\n")
        return
    if failures := run_all(runs, config):
        raise LearningError(f"{failures} runs failed or were stopped; start again to go on")


def run_all(runs: Sequence[Run | Bisection], config: StudyConfig) -> int:
    """Run what is left of all, as the configuration says where; return how many did not end well.

    Raises:
        ConfigError: There is no cluster at the address, or the folder cannot be written.
        MissingPackageError: Ray is not installed.
    """
    ended_well = 0
    require_writable("--folder", config.folder / "log")
    with (
        cluster.connected(config.address, config.jobs),
        tempfile.NamedTemporaryFile(prefix=".", dir=config.folder) as seen,
    ):
        given = (Path.cwd(), Path(seen.name))
        for run, problem in cluster.each(execute_there, runs, *given):
            print(f"{run.folder}: {problem or 'done'}", flush=True)
            ended_well += problem is None
    return len(runs) - ended_well


def execute_there(run: Run | Bisection, here: Path, seen: Path) -> str | None:
    """Execute a run on a node of a cluster, if that sees the working folder and a file in --folder.

    Returns:
        As :func:`execute`.
    """
    try:
        os.chdir(here)
        is_shared = seen.is_file()
    except OSError:
        is_shared = False
    if is_shared:
        return execute(run)
    return (
        f"failed: {socket.gethostname()} does not see {here} and {seen.parent} as they are here; "
        "choose a working folder and a --folder on a disk that all nodes share"
    )


def execute(run: Run | Bisection) -> str | None:
    """Run what is left in this process, with the output in a file beside the run.

    Returns:
        None where all went well, else a line that says what did not.
    """
    log = run.folder.with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    _outlast(run.folder)
    while left := run.left():
        status = _run_command(left[0], log)
        if status != 0:
            how = "stopped" if status in _STOPPED else f"failed with status {status}, see {log}"
            return f"{how}: {shlex.join(left[0])}"
    return None


def _outlast(run: Path) -> None:
    """Wait for the end of a training in this folder whose node has just died; it takes seconds."""
    latest = time.monotonic() + _GRACE
    while run.is_dir() and time.monotonic() < latest:
        with suppress(RunError), claimed(run):
            return
        time.sleep(1.0)


def _run_command(command: list[str], log: Path) -> int:
    """Run a command in this process, which dies with its node, and return its status."""
    from tpm_gym.learning.command_line import main  # here, since it imports this

    before, sys.argv = sys.argv, command  # what the run says that it was made with
    with log.open("a", encoding="utf-8") as file, redirect_stdout(file), redirect_stderr(file):
        print(f"$ {shlex.join(command)}", flush=True)
        try:
            main(command[1:])
        except KeyboardInterrupt:  # before the command could see to it
            return 128 + signal.SIGINT
        except SystemExit as left:
            if isinstance(left.code, str):
                print(left.code)
            return left.code if isinstance(left.code, int) else int(left.code is not None)
        except Exception:
            traceback.print_exc()
            return 1
        finally:
            sys.argv = before
    return 0
