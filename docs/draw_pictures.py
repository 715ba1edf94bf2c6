"""Draw the picture of the README: the published policy picking and placing, as a strip of frames.

python docs/draw_pictures.py
"""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tpm_gym import load_policy  # registers the ids as well
from tpm_gym.learning.film import contact_sheet
from tpm_gym.simulation import Camera
from tpm_gym.simulation.state import CONTROL_PERIOD

IMAGES = Path(__file__).resolve().parent / "images"
ENV_ID = "TPMPickAndPlace-v0"
START, GOAL = (-0.17, -0.034, 0.015), (0.06, -0.030, 0.130)
FRAMES = {2: "approach", 6: "grip, by vacuum", 12: "carry", 14: "at the goal"}
WIDTH, HEIGHT, SUPERSAMPLING = 400, 330, 3
CAMERA = Camera((-0.05, -0.03, 0.105), 0.82, pitch=-16.0)


def frames() -> dict[str, NDArray[np.uint8]]:
    """Render the steps of an episode that FRAMES names, with their captions."""
    size = {"width": SUPERSAMPLING * WIDTH, "height": SUPERSAMPLING * HEIGHT}
    env = gym.make(ENV_ID, render_mode="rgb_array", camera=CAMERA, **size)
    observation, _ = env.reset(seed=0, options={"object": START, "goal": GOAL})
    policy = load_policy(ENV_ID)
    pictures = {}
    for step in range(max(FRAMES) + 1):
        if step in FRAMES:
            picture = Image.fromarray(np.asarray(env.render()))
            picture = picture.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)
            caption = f"{CONTROL_PERIOD * step:.2f} s: {FRAMES[step]}"
            pictures[caption] = np.asarray(picture)
        observation, *_ = env.step(policy.act(observation))
    env.close()
    return pictures


def main() -> None:
    """Write docs/images/pick_and_place.png."""
    IMAGES.mkdir(exist_ok=True)
    path = IMAGES / "pick_and_place.png"
    contact_sheet(frames(), columns=len(FRAMES)).save(path, optimize=True)
    print(path)


if __name__ == "__main__":
    main()
