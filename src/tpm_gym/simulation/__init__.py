"""Simulation of robots: state, randomisation, drives, engines."""

from tpm_gym.simulation.drives import Servo
from tpm_gym.simulation.engine import Engine, register_engine
from tpm_gym.simulation.imaging import Camera
from tpm_gym.simulation.randomisation import Plant, Randomisation
from tpm_gym.simulation.simulation import Simulation, Snapshot
from tpm_gym.simulation.state import Belt, Block, Patch, Scene, State

__all__ = [
    "Belt",
    "Block",
    "Camera",
    "Engine",
    "Patch",
    "Plant",
    "Randomisation",
    "Scene",
    "Servo",
    "Simulation",
    "Snapshot",
    "State",
    "register_engine",
]
