"""Trained policies without pickle; :mod:`tpm_gym.policy.policy` needs PyTorch."""
