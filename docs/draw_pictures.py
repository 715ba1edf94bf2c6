"""Draw the picture of the README: the published policy picking and placing, as a strip of frames.

python docs/draw_pictures.py
"""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tpm_gym import load_policy  # registers the ids as well
from tpm_gym.simulation.state import CONTROL_PERIOD

IMAGES = Path(__file__).resolve().parent / "images"
ENV_ID = "TPMPickAndPlace-v0"
START, GOAL = (-0.17, -0.034, 0.015), (0.05, -0.030, 0.015)
FRAMES = {0: "start", 6: "vacuum on: the cup seals", 10: "on the way", 21: "placed, vacuum off"}
SIZE, SUPERSAMPLING = 380, 3
CROP = (0.05, 0.0, 1.0, 0.94)  # left, top, right, bottom of the rendered picture


def frames() -> dict[int, Image.Image]:
    """Render the steps of an episode that FRAMES names."""
    side = SIZE * SUPERSAMPLING
    env = gym.make(ENV_ID, render_mode="rgb_array", width=side, height=side)
    observation, _ = env.reset(seed=0, options={"object": START, "goal": GOAL})
    policy = load_policy(ENV_ID)
    pictures = {}
    for step in range(max(FRAMES) + 1):
        if step in FRAMES:
            picture = np.asarray(env.render())
            pictures[step] = Image.fromarray(picture)
        observation, *_ = env.step(policy.act(observation))
    env.close()
    return pictures


def strip(pictures: dict[int, Image.Image]) -> Image.Image:
    """Crop, shrink and caption the frames, and put them side by side."""
    font = ImageFont.load_default(size=16)
    width, height = int(SIZE * (CROP[2] - CROP[0])), int(SIZE * (CROP[3] - CROP[1]))
    gap, caption = 8, 30
    sheet = Image.new("RGB", (len(pictures) * (width + gap) - gap, height + caption), "white")
    draw = ImageDraw.Draw(sheet)
    for column, (step, picture) in enumerate(pictures.items()):
        left, top, right, bottom = (edge * picture.width for edge in CROP)
        cropped = picture.crop((int(left), int(top), int(right), int(bottom)))
        x = column * (width + gap)
        sheet.paste(cropped.resize((width, height), Image.Resampling.LANCZOS), (x, 0))
        text = f"{CONTROL_PERIOD * step:.2f} s: {FRAMES[step]}"
        draw.text((x + width / 2, height + caption / 2), text, "black", font, anchor="mm")
    return sheet


def main() -> None:
    """Write docs/images/pick_and_place.png."""
    IMAGES.mkdir(exist_ok=True)
    path = IMAGES / "pick_and_place.png"
    strip(frames()).save(path, optimize=True)
    print(path)


if __name__ == "__main__":
    main()
