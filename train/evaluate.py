"""The same as ``tpm-gym evaluate``."""

import sys

from tpm_gym.learning.command_line import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
