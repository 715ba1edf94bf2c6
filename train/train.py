"""The same as ``tpm-gym train``."""

from __future__ import annotations

from tpm_gym.learning.train import main

if __name__ == "__main__":
    main()
