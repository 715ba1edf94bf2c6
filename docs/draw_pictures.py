"""Draw the moving picture of the README: the published policy picks and places, in real time.

python docs/draw_pictures.py
"""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image

from tpm_gym import load_policy  # registers the ids as well
from tpm_gym.simulation import Camera
from tpm_gym.simulation.state import CONTROL_PERIOD

IMAGES = Path(__file__).resolve().parent / "images"
ENV_ID = "TPMPickAndPlace-v0"
EPISODES = (
    ((-0.17, -0.034, 0.015), (0.06, -0.030, 0.130)),
    ((0.08, -0.026, 0.015), (-0.20, -0.040, 0.100)),
    ((-0.22, -0.041, 0.015), (0.08, -0.030, 0.190)),
)
"""Start of the block and goal of each episode, m."""
WHOLE = Camera((0.02, 0.0, 0.49), 2.6, yaw=15.0, pitch=-10.0)
CLOSE = Camera((-0.02, -0.03, 0.12), 0.95, pitch=-16.0)
SIZE, SUPERSAMPLING, COLOURS = 400, 2, 128
PAUSE = 900  # ms, at the end of an episode


def episodes(camera: Camera) -> list[list[Image.Image]]:
    """Render all steps of each episode up to its success."""
    side = SUPERSAMPLING * SIZE
    env = gym.make(ENV_ID, render_mode="rgb_array", camera=camera, width=side, height=side)
    policy, films = load_policy(ENV_ID), []
    for start, goal in EPISODES:
        observation, info = env.reset(seed=0, options={"object": start, "goal": goal})
        film = [_frame(env)]
        truncated = False
        while not (info["is_success"] or truncated):
            observation, _, _, truncated, info = env.step(policy.act(observation))
            film.append(_frame(env))
        films.append(film)
    env.close()
    return films


def _frame(env: gym.Env[object, object]) -> Image.Image:
    picture = Image.fromarray(np.asarray(env.render()))
    return picture.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def main() -> None:
    """Write docs/images/pick_and_place.gif: the whole robot beside a close view."""
    pictures, pauses = [], []
    for pair in zip(episodes(WHOLE), episodes(CLOSE), strict=True):
        for whole, close in zip(*pair, strict=True):
            picture = Image.new("RGB", (2 * SIZE, SIZE))
            picture.paste(whole)
            picture.paste(close, (SIZE, 0))
            pictures.append(picture)
            pauses.append(round(1000 * CONTROL_PERIOD))
        pauses[-1] = PAUSE
    # One palette for all, so that colours do not flicker
    palette = pictures[len(pictures) // 2].quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    path = IMAGES / "pick_and_place.gif"
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=pauses, loop=0)
    print(f"{path}, {len(frames)} frames, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
