"""Command ``tpm-gym``, also as ``python -m tpm_gym.learning``."""

import sys


def main() -> None:
    """Run the command line; if a required package is missing, print its name and exit."""
    try:
        from tpm_gym.learning import command_line

        command_line.main()
    except ModuleNotFoundError as error:
        from tpm_gym.errors import MissingPackageError

        extra = {"view": "view", "collect": "data"}.get("".join(sys.argv[1:2]), "train")
        sys.exit(f"error: {MissingPackageError(str(error.name), extra)}")


if __name__ == "__main__":
    main()
