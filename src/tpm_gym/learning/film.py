"""Pictures of a policy at work: a video of episodes, a contact sheet of one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym.learning.provenance import write_whole
from tpm_gym.simulation.imaging import tile

Frame = NDArray[np.uint8]
Play = Callable[[Callable[[Frame], object]], object]
"""Function that plays episodes, and calls its argument with every frame."""

_ROWS, _COLUMNS = 2, 3


def write_video(path: Path, play: Play, fps: float) -> None:
    """Write an MP4 of all frames, ``fps`` of them a second."""
    import imageio.v2 as imageio

    def write(part: Path) -> None:
        # H.264 needs an even width and height.
        writer: Any = imageio.get_writer(part, fps=fps, macro_block_size=2)
        with writer as video:
            play(video.append_data)

    write_whole(path, write)


def write_contact_sheet(path: Path, play: Play) -> None:
    """Write a PNG of six moments of an episode, evenly spaced up to the end of the motion."""
    import imageio.v3 as imageio

    frames: list[Frame] = []
    play(frames.append)
    # Two frames differ if more than the last millimetres of a motion lie between them.
    differ = [(frame != frames[-1]).any(axis=-1).mean() > 1e-2 for frame in frames]
    last = max(np.flatnonzero(differ), default=len(frames) - 2) + 1
    moments = np.linspace(0, last, _ROWS * _COLUMNS).round().astype(int)
    sheet = tile([frames[moment] for moment in moments], _COLUMNS)
    write_whole(path, lambda part: imageio.imwrite(part, sheet))
