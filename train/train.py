"""The same as ``tpm-gym train``."""

import sys

from tpm_gym.learning.command_line import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
