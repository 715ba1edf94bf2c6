"""Tasks: scenes, goals, observations, rewards, controls, experts."""

from tpm_gym.tasks.conveyor import Conveyor
from tpm_gym.tasks.crossing import Crossing
from tpm_gym.tasks.cycle import Cycle
from tpm_gym.tasks.expert import Expert
from tpm_gym.tasks.motion import Motion, Move, hanging
from tpm_gym.tasks.pick_and_place import PickAndPlace
from tpm_gym.tasks.push import Push
from tpm_gym.tasks.reach import Reach
from tpm_gym.tasks.stack import Stack
from tpm_gym.tasks.task import Entry, Task, dense
from tpm_gym.tasks.throw import Throw

__all__ = [
    "Conveyor",
    "Crossing",
    "Cycle",
    "Entry",
    "Expert",
    "Motion",
    "Move",
    "PickAndPlace",
    "Push",
    "Reach",
    "Stack",
    "Task",
    "Throw",
    "dense",
    "hanging",
]
