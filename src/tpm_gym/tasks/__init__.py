"""What is to be done with the robot: scenes, goals, observations, rewards, experts."""

from tpm_gym.tasks.expert import Expert, Move
from tpm_gym.tasks.pick_and_place import PickAndPlace
from tpm_gym.tasks.reach import Reach
from tpm_gym.tasks.task import Entry, Task

__all__ = ["Entry", "Expert", "Move", "PickAndPlace", "Reach", "Task"]
