"""The exceptions of the training scripts: one root, and leaves that carry what went wrong."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path


class TrainError(Exception):
    """Root of every error a user of the training scripts can cause."""


class RecipeError(TrainError):
    """A recipe file cannot be read, or one of its entries is not valid.

    Attributes:
        path: The recipe file.
        key: The offending entry, dotted for nested ones; empty for the file as a whole.
    """

    def __init__(self, path: Path, key: str, problem: str) -> None:
        """Store the values and compose the message."""
        self.path = path
        self.key = key
        where = f"{path}: {key}" if key else str(path)
        super().__init__(f"{where}: {problem}")


class ConfigError(TrainError):
    """An option, or a combination of options, is not valid.

    Attributes:
        option: The option as it is written on the command line.
        value: The value that was given.
    """

    def __init__(self, option: str, value: object, problem: str) -> None:
        """Store the values and compose the message."""
        self.option = option
        self.value = value
        super().__init__(f"{option} {value}: {problem}")


class UnknownEnvError(TrainError):
    """An environment id that tpm_gym does not register.

    Attributes:
        env_id: The id that was given.
    """

    def __init__(self, env_id: str, known: Iterable[str]) -> None:
        """Store the values and compose the message."""
        self.env_id = env_id
        super().__init__(f"unknown environment {env_id!r}; tpm_gym registers {', '.join(known)}")


class RunExistsError(TrainError):
    """The run folder already holds something.

    Attributes:
        run: The folder.
    """

    def __init__(self, run: Path) -> None:
        """Store the values and compose the message."""
        self.run = run
        super().__init__(
            f"{run} is not an empty folder; choose another with --run, continue the earlier run "
            "with --resume, or replace it with --overwrite"
        )


class NotARunError(TrainError):
    """``--overwrite`` was asked to replace a folder that no training run wrote.

    Attributes:
        run: The folder.
    """

    def __init__(self, run: Path, marker: str) -> None:
        """Store the values and compose the message."""
        self.run = run
        super().__init__(
            f"--overwrite would delete {run}, which holds no {marker} of train.py and so is no "
            "earlier run; choose another folder with --run"
        )


class PolicyError(TrainError):
    """A policy cannot be found, loaded or used in the environment.

    Attributes:
        spec: The policy as it was named.
    """

    def __init__(self, spec: str, problem: str) -> None:
        """Store the values and compose the message."""
        self.spec = spec
        super().__init__(f"policy {spec!r}: {problem}")


class RolloutError(TrainError):
    """An episode delivered a value that no statistic can be made of.

    Attributes:
        seed: Seed of the episode.
        step: Step within the episode, from 0.
        name: The quantity.
        value: What was delivered.
    """

    def __init__(self, seed: int, step: int, name: str, value: object) -> None:
        """Store the values and compose the message."""
        self.seed = seed
        self.step = step
        self.name = name
        self.value = value
        super().__init__(
            f"episode with seed {seed}, step {step}: {name} is {value!r}, expected a finite number"
        )


class ReplayBufferError(TrainError):
    """The replay buffer is set up in a way that would corrupt the penalty in the reward."""


class CheckpointDamagedError(TrainError):
    """A checkpoint is not what was written.

    Attributes:
        path: The offending file.
    """

    def __init__(self, path: Path, problem: str) -> None:
        """Store the values and compose the message."""
        self.path = path
        super().__init__(f"damaged checkpoint: {path} {problem}")


class NoCheckpointError(TrainError):
    """There is no checkpoint to resume from.

    Attributes:
        folder: Where it was looked for.
    """

    def __init__(self, folder: Path) -> None:
        """Store the values and compose the message."""
        self.folder = folder
        super().__init__(
            f"no checkpoint in {folder} to resume from; name another run with --run, or leave out "
            "--resume to start one (with --overwrite where the folder is not empty)"
        )


class NoWholeCheckpointError(TrainError):
    """All checkpoints of a run are damaged.

    Attributes:
        folder: Where they are.
        problems: What is wrong with each, newest first.
    """

    def __init__(self, folder: Path, problems: Sequence[str]) -> None:
        """Store the values and compose the message."""
        self.folder = folder
        self.problems = tuple(problems)
        listed = "".join(f"\n  {problem}" for problem in problems)
        super().__init__(
            f"no checkpoint in {folder} is whole; start the run anew with --overwrite:{listed}"
        )


class CheckpointWriteError(TrainError):
    """A checkpoint cannot be written.

    Attributes:
        path: The checkpoint.
        kept: Step of the newest whole one; None if there is none.
    """

    def __init__(self, path: Path, problem: str, kept: int | None) -> None:
        """Store the values and compose the message."""
        self.path = path
        self.kept = kept
        rest = "there is none yet" if kept is None else f"that of step {kept:,} stays"
        super().__init__(f"cannot write checkpoint {path}: {problem}; {rest}")


class RunWriteError(TrainError):
    """A file of the run other than a checkpoint cannot be written.

    Attributes:
        run: The run folder.
        kept: Step of the newest whole checkpoint; None if there is none.
    """

    def __init__(self, run: Path, problem: str, kept: int | None) -> None:
        """Store the values and compose the message."""
        self.run = run
        self.kept = kept
        rest = (
            "start it anew with --overwrite"
            if kept is None
            else f"continue from step {kept:,} with --run {run} --resume"
        )
        super().__init__(f"cannot write to {run}: {problem}; make room, then {rest}")


class ResumeConflictError(TrainError):
    """An option contradicts the run that is to be resumed.

    Attributes:
        option: The option as it is written on the command line.
        given: Its value there.
        stored: The value of the run.
    """

    def __init__(self, option: str, given: object, stored: object) -> None:
        """Store the values and compose the message."""
        self.option = option
        self.given = given
        self.stored = stored
        super().__init__(
            f"{option} is {given}, but the run to be resumed has {stored}; leave the option out, "
            "or start another run with another --run"
        )


class RunBusyError(TrainError):
    """Another process is training in the run folder.

    Attributes:
        run: The folder.
    """

    def __init__(self, run: Path) -> None:
        """Store the values and compose the message."""
        self.run = run
        super().__init__(
            f"another process is training in {run}; stop it first, or choose another with --run"
        )
