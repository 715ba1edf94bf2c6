"""Pictures of a policy at work: a video of several episodes, a contact sheet of one episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym.learning.provenance import write_whole

if TYPE_CHECKING:
    from PIL import Image

Frame = NDArray[np.uint8]
Play = Callable[[Callable[[Frame], object]], object]
"""Function that plays episodes, and calls its argument with every frame."""

_MOMENTS, _COLUMNS = 6, 3
_GAP, _CAPTION, _FONT = 8, 32, 18  # pixels


def write_video(path: Path, play: Play, fps: float) -> None:
    """Write an MP4 of all frames, ``fps`` of them a second."""
    import imageio.v2 as imageio

    def write(part: Path) -> None:
        # H.264 needs an even width and height.
        writer: Any = imageio.get_writer(part, fps=fps, macro_block_size=2)
        with writer as video:
            play(video.append_data)

    write_whole(path, write)


def write_contact_sheet(path: Path, play: Play, fps: float) -> None:
    """Write a PNG of the six most different moments of an episode, with the time below each."""
    frames: list[Frame] = []
    play(frames.append)
    sheet = contact_sheet({f"{k / fps:.3g} s": frames[k] for k in _moments(frames)}, _COLUMNS)
    write_whole(path, lambda part: sheet.save(part, "PNG"))


def contact_sheet(pictures: Mapping[str, Frame], columns: int) -> Image.Image:
    """Draw equally large pictures row by row, with a caption below each picture."""
    from PIL import Image, ImageDraw, ImageFont

    height, width, _ = next(iter(pictures.values())).shape
    rows = -(-len(pictures) // columns)
    size = columns * (width + _GAP) - _GAP, rows * (height + _CAPTION)
    sheet = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=_FONT)
    for place, (caption, picture) in enumerate(pictures.items()):
        row, column = divmod(place, columns)
        x, y = column * (width + _GAP), row * (height + _CAPTION)
        sheet.paste(Image.fromarray(picture), (x, y))
        middle = x + width / 2, y + height + _CAPTION / 2
        draw.text(middle, caption, "black", font, anchor="mm")
    return sheet


def _moments(frames: list[Frame]) -> list[int]:
    """Return the indices of six frames that differ most from each other.

    Choose the first and the last frame. Then compare each remaining frame with the chosen frame
    most similar to it, and choose the frame with the largest difference. Repeat this step.
    """
    pictures = np.stack(frames)[:, ::2, ::2].astype(np.int16)

    def differences(index: int) -> NDArray[Any]:
        found: NDArray[Any] = np.abs(pictures - pictures[index]).mean(axis=(1, 2, 3))
        return found

    last = len(frames) - 1
    chosen, nearest = {0, last}, np.minimum(differences(0), differences(last))
    while len(chosen) < min(_MOMENTS, len(frames)):
        nearest[list(chosen)] = -1.0  # not again, even if all frames are equal
        index = int(nearest.argmax())
        chosen.add(index)
        nearest = np.minimum(nearest, differences(index))
    return sorted(chosen)
