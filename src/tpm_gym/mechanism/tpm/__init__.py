"""The translational parallel mechanism of the paper, with the paper's or other lengths."""

from tpm_gym.mechanism.tpm.machine import PAPER_TPM, TPM, WIDE_TPM

__all__ = ["PAPER_TPM", "TPM", "WIDE_TPM"]
