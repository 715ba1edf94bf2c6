"""Features of a goal for the networks."""

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor


class GoalGapExtractor(BaseFeaturesExtractor):
    """Features extractor that scales the distance to the goal.

    Goals are in metres, and a centimetre decides about success. So the distance to the goal is
    divided by ``unit``. The features are the entry ``observation``, whose values are of order one,
    followed by (desired goal - achieved goal) / unit. The entry ``observation`` contains the
    achieved goal already.
    """

    def __init__(self, observation_space: spaces.Dict, unit: float = 0.05) -> None:
        """Set the size of the features; the extractor has no parameters to learn.

        Args:
            observation_space: Space with ``observation``, ``achieved_goal`` and ``desired_goal``.
            unit: Distance to the goal, m, whose feature is 1.
        """
        shown = ("observation", "desired_goal")
        size = sum(spaces.flatdim(observation_space[name]) for name in shown)
        super().__init__(observation_space, size)
        self.unit = float(unit)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the features of a batch, (n, observation size + goal size)."""
        gap = observations["desired_goal"] - observations["achieved_goal"]  # (n, goal size) m
        return torch.cat([observations["observation"], gap / self.unit], dim=1)
