"""Pictures of a policy at work: a video of episodes, a contact sheet of one."""

from collections.abc import Callable, Sequence
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
    path: Path,
    envs: TPMVectorEnv,
    policy: Policy,
    episodes: int,
    first_seed: int,
    on_frame: Callable[[], object],
) -> None:
    """Write an MP4 of consecutive episodes in real time; ``envs`` renders ``rgb_array``."""
    import imageio.v2 as imageio

    def write(part: Path) -> None:
        # H.264 needs an even width and height.
        options = {"fps": envs.metadata["render_fps"], "macro_block_size": 2}
        writer: Any = imageio.get_writer(part, **options)
        with writer as video:
            _film(envs, policy, episodes, first_seed, video.append_data, on_frame)

    write_whole(path, write)


def write_contact_sheet(
    path: Path,
    envs: TPMVectorEnv,
    policy: Policy,
    episodes: int,
    first_seed: int,
    on_frame: Callable[[], object],
) -> None:
    """Write a PNG of six moments of the first episode; arguments as for :func:`write_video`."""
    import imageio.v3 as imageio

    frames: list[Frame] = []
    _film(envs, policy, episodes, first_seed, frames.append, on_frame)
    write_whole(path, lambda part: imageio.imwrite(part, contact_sheet(frames)))


def _film(
    envs: TPMVectorEnv,
    policy: Policy,
    episodes: int,
    first_seed: int,
    use: Callable[[Frame], object],
    on_frame: Callable[[], object],
) -> None:
    def frame() -> None:
        use(envs.render_tile(1))
        on_frame()

    run_episodes(envs, policy, episodes, first_seed, on_frame=frame)


def contact_sheet(frames: Sequence[Frame]) -> Frame:
    """Return evenly spaced frames, up to the end of the motion, as (2 * height, 3 * width, 3)."""
    # Two frames differ if more than the last millimetres of a motion lie between them.
    differ = [(frame != frames[-1]).any(axis=-1).mean() > 1e-2 for frame in frames]
    last = max(np.flatnonzero(differ), default=len(frames) - 2) + 1
    moments = np.linspace(0, last, _ROWS * _COLUMNS).round().astype(int)
    return tile([frames[moment] for moment in moments], _COLUMNS)
