"""Command line, in the root of a checkout: ``python -m benchmarks.studies``."""

import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from tpm_gym import TPMError

from .page import Write, write
from .plan import Study
from .records import Collect, collect
from .running import study

Command = (
    Annotated[Study, subcommand("run")]
    | Annotated[Collect, subcommand("collect")]
    | Annotated[Write, subcommand("write")]
)


def main(words: Sequence[str] | None = None) -> None:
    """Run a command line, by default that of the process."""
    config: Any = tyro.cli(Command, prog="python -m benchmarks.studies", args=words)
    try:
        match config:
            case Study():
                study(config)
            case Collect():
                print(*collect(config), sep="\n")
            case Write():
                print(*write(config), sep="\n")
    except TPMError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
