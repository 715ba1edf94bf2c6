"""What the networks see of a goal."""

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor


class GoalGapExtractor(BaseFeaturesExtractor):
    """Shows a policy how far it is from the goal, on the scale on which that matters.

    Goals are in metres: achieved and desired differ by some centimetres, success by one, so a
    network that is fed with both sees numbers near zero whose small difference decides everything.
    The features are the observation, which is of order one, and (desired - achieved) / unit. The
    achieved goal itself is in the observation already, in its own scale.
    """

    def __init__(self, observation_space: spaces.Dict, unit: float = 0.05) -> None:
        """Set the features up; there is nothing to learn here.

        Args:
            observation_space: Holds ``observation``, ``achieved_goal`` and ``desired_goal``.
            unit: The distance that becomes 1, m.
        """
        shown = ("observation", "desired_goal")
        size = sum(spaces.flatdim(observation_space[name]) for name in shown)
        super().__init__(observation_space, size)
        self.unit = float(unit)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the features of a batch, (n, observation size + goal size)."""
        gap = observations["desired_goal"] - observations["achieved_goal"]  # (n, goal size) m
        return torch.cat([observations["observation"], gap / self.unit], dim=1)
