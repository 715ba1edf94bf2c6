"""Pictures of a policy at work: a video of episodes, a contact sheet of one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning.provenance import write_whole
from tpm_gym.learning.rollout import Policy, run_episodes
from tpm_gym.simulation.imaging import tile

Frame = NDArray[np.uint8]

_ROWS, _COLUMNS = 2, 3


def write_video(
    path: Path, envs: TPMVectorEnv, policy: Policy, episodes: int, first_seed: int
) -> None:
    """Write an MP4 of consecutive episodes in real time; ``envs`` renders ``rgb_array``."""
    import imageio.v2 as imageio

    def write(part: Path) -> None:
        # H.264 needs an even width and height.
        options = {"fps": envs.metadata["render_fps"], "macro_block_size": 2}
        writer: Any = imageio.get_writer(part, **options)
        with writer as video:
            add = video.append_data
            run_episodes(
                envs, policy, episodes, first_seed, on_frame=lambda: add(envs.render_tile(1))
            )

    write_whole(path, write)


def write_contact_sheet(path: Path, envs: TPMVectorEnv, policy: Policy, seed: int) -> None:
    """Write a PNG of six moments of one episode, row by row; ``envs`` renders ``rgb_array``."""
    import imageio.v3 as imageio

    frames: list[Any] = []
    run_episodes(envs, policy, 1, seed, on_frame=lambda: frames.append(envs.render_tile(1)))
    sheet = contact_sheet(frames)
    write_whole(path, lambda part: imageio.imwrite(part, sheet))


def contact_sheet(frames: Sequence[Frame]) -> Frame:
    """Return evenly spaced frames, up to the end of the motion, as (2 * height, 3 * width, 3)."""
    # Two frames differ if more than the last millimetres of a motion lie between them.
    differ = [(frame != frames[-1]).any(axis=-1).mean() > 1e-2 for frame in frames]
    last = max(np.flatnonzero(differ), default=len(frames) - 2) + 1
    moments = np.linspace(0, last, _ROWS * _COLUMNS).round().astype(int)
    return tile([frames[moment] for moment in moments], _COLUMNS)
