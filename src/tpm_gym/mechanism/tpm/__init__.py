"""The translational parallel mechanism of the paper, with its lengths or others."""

from tpm_gym.mechanism.tpm.machine import PAPER_TPM, TPM, WIDE_TPM

__all__ = ["PAPER_TPM", "TPM", "WIDE_TPM"]
