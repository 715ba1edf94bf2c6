"""The same as ``tpm-gym evaluate``."""

from __future__ import annotations

from tpm_gym.learning.evaluate import main

if __name__ == "__main__":
    main()
