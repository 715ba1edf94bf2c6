"""Command ``tpm-gym``."""

import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, subcommand

from tpm_gym import TPMError, learning
from tpm_gym.learning.configuration import (
    UNSET,
    EnvOptions,
    GivenEnvOptions,
    ResumeConfig,
    TrainingConfig,
    unset,
)
from tpm_gym.learning.datasets import CollectConfig, collect
from tpm_gym.learning.evaluation import EvaluationConfig, evaluate
from tpm_gym.learning.tune import TuneConfig, tune
from tpm_gym.viewer import ViewConfig, run


@dataclass(frozen=True)
class ExportConfig:
    """Write a trained policy as safetensors and JSON. Loading these files runs no code."""

    model: Annotated[Positional[Path], tyro.conf.arg(metavar="MODEL")]
    """Folder of a run (its best policy), a .zip of Stable-Baselines3, such as last.zip in such a
    folder, or an exported policy (.json)."""

    out: Annotated[Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Path of the new files without their endings. Files of an earlier policy or model card are
    replaced, other files never."""

    trust_pickle: bool = False
    """Load a .zip file, which can run any code."""

    env: Annotated[str, unset(str, "the run's", "ID")] = UNSET
    """Environment id of the training, or module:id. This option is required for a .zip outside the
    folder of a run."""

    env_options: GivenEnvOptions = field(default_factory=EnvOptions)

    evaluation: Annotated[Path | None, unset(Path, "no card", "PATH")] = None
    """File that evaluate --json wrote. If it is given, a model card for the Hugging Face Hub is
    written too, with these results."""


Command = (
    Annotated[TrainingConfig, subcommand("train")]
    | Annotated[ResumeConfig, subcommand("resume")]
    | Annotated[EvaluationConfig, subcommand("evaluate")]
    | Annotated[ExportConfig, subcommand("export")]
    | Annotated[CollectConfig, subcommand("collect")]
    | Annotated[TuneConfig, subcommand("tune")]
    | Annotated[ViewConfig, subcommand("view")]
)


def _say_loading() -> None:
    print("loading PyTorch ...", flush=True)


def main(words: Sequence[str] | None = None) -> None:
    """Run a command line, by default ``sys.argv``, and exit with its status.

    If a signal stops the command, the status is 128 plus the signal's number, as in shells.
    """
    about = "Train and test policies for the robot of tpm_gym."
    options: Any = {"config": (tyro.conf.FlagCreatePairsOff,), "args": words}
    command: Any = tyro.cli(Command, prog="tpm-gym", description=about, **options)
    # Without a handler, Python would end at once and leave temporary files.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    stopped_by = None
    try:
        match command:
            case TrainingConfig():
                _say_loading()
                stopped_by = learning.train(command)
            case ResumeConfig():
                _say_loading()
                stopped_by = learning.resume(command)
            case EvaluationConfig():
                evaluate(command)
            case CollectConfig():
                collect(command)
            case TuneConfig():
                print(tune(command))
            case ViewConfig():
                run(command)
            case ExportConfig():
                print(f"exporting {command.model} and comparing its actions ...", flush=True)
                from tpm_gym.learning import export, model_card  # PyTorch is needed here only

                evaluation = command.evaluation
                policy = export.convert(
                    command.model,
                    command.out,
                    trust_pickle=command.trust_pickle,
                    env_id=command.env,
                    env_options=command.env_options,
                    evaluation=evaluation,
                )
                print(policy)
                if evaluation is not None:
                    print(model_card.write(policy, evaluation))
    except TPMError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        stopped_by = signal.SIGINT
    if stopped_by is not None:
        sys.exit(128 + stopped_by)
