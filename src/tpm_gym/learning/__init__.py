"""Training, resuming, evaluation and export with Stable-Baselines3."""
