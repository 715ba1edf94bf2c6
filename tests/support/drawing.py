"""The first frame of an episode, in every engine."""

from typing import Any

import gymnasium as gym

ENGINES = ("pybullet", "mujoco", "analytic")
_DRAWN: dict[str, Any] = {}
STARTS: dict[str, Any] = {"object": (-0.12, -0.034, 0.015), "goal": (0.05, -0.03, 0.10)}


def drawn(engine: str, starts: Any = STARTS, mode: str = "rgb_array", **options: Any) -> Any:
    """Return the first frame of an episode of pick-and-place, drawn once: not to be changed."""
    key = repr((engine, starts, mode, sorted(options.items())))
    if key not in _DRAWN:
        env = gym.make("TPMPickAndPlace-v0", engine=engine, render_mode=mode, **options)
        env.reset(seed=0, options=starts)
        _DRAWN[key] = env.render()
        env.close()
    return _DRAWN[key]
