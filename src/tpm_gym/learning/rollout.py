"""Run a policy over seeded episodes, and condense what happened.

Seeds fall into three ranges that never meet, so no figure is taken on episodes that a policy has
trained on or was selected by:

- below ``SELECTION_SEED``: training;
- from ``SELECTION_SEED``: the periodic evaluations during training, which select ``best.zip``;
- from ``TEST_SEED``: ``tpm-gym evaluate``.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tpm_gym.learning.errors import RolloutError
from tpm_gym.learning.estimates import Estimate, bootstrap, wilson

SELECTION_SEED: Final = 1_000_000
TEST_SEED: Final = 2_000_000

Observation: TypeAlias = dict[str, NDArray[Any]]
Action: TypeAlias = NDArray[Any]
GoalEnv: TypeAlias = gym.Env[Observation, Action]


class Policy(Protocol):
    """What acts in an episode."""

    def reset(self, observation: Observation, seed: int) -> None:
        """Prepare for an episode that starts with ``observation`` and was reset with ``seed``."""

    def act(self, observation: Observation) -> Action:
        """Return the action for ``observation``."""


@dataclass(frozen=True)
class Episode:
    """What one episode came to.

    Attributes:
        success_at_end: Whether the last step was a success.
        total_reward: Undiscounted sum of rewards, the return.
        conditioning_min: Smallest 1/cond(J) of all steps, in [0, 1].
        conditioning_mean: Mean 1/cond(J) over the steps.
        closure_error_max: Largest loop gap of all steps, m.
        unsafe_share: Share of the steps with a singularity penalty, so below the machine's
            safe conditioning.
        fk_error_max: Largest distance of the observed point P (forward kinematics of the encoders)
            from that of the simulated platform, m.
        torque_rms: Root mean square of the motors' torques at the ends of the steps, over steps and
            motors, N m.
        torque_peak: Largest of these torques, N m.
    """

    seed: int
    success_at_end: bool
    success_once: bool
    total_reward: float
    conditioning_min: float
    conditioning_mean: float
    closure_error_max: float
    length: int
    unsafe_share: float
    fk_error_max: float
    torque_rms: float
    torque_peak: float

    def as_dict(self) -> dict[str, Any]:
        """Return the episode as plain data, ``total_reward`` under its name ``return``."""
        return {
            "return" if name == "total_reward" else name: value
            for name, value in vars(self).items()
        }


def run_episodes(
    env: GoalEnv,
    policy: Policy,
    episodes: int,
    first_seed: int,
    *,
    on_frame: Callable[[], object] | None = None,
    on_episode: Callable[[], object] | None = None,
) -> list[Episode]:
    """Run a policy for a number of episodes; the same arguments give the same records.

    Args:
        env: Left open.
        first_seed: Episode i is reset with ``first_seed + i``.
        on_frame: Called after every reset and every step, for example to record a video.
        on_episode: Called after every episode, for example to move a progress bar.

    Raises:
        RolloutError: A reward, a conditioning, a closure error, a distance of forward kinematics
            from the truth or a torque is not finite.
    """
    records = []
    for seed in range(first_seed, first_seed + episodes):
        records.append(_run_episode(env, policy, seed, on_frame))
        if on_episode is not None:
            on_episode()
    return records


def _run_episode(
    env: GoalEnv, policy: Policy, seed: int, on_frame: Callable[[], object] | None
) -> Episode:
    observation, _ = env.reset(seed=seed)
    policy.reset(observation, seed)
    if on_frame is not None:
        on_frame()
    rewards: list[float] = []
    infos: list[Mapping[str, Any]] = []
    states: list[Any] = []
    inner: Any = env.unwrapped
    done = False
    while not done:
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        done = terminated or truncated
        rewards.append(float(reward))
        infos.append(info)
        states.append(inner.state)
        if on_frame is not None:
            on_frame()
    return _record(seed, rewards, infos, states)


def _record(
    seed: int, rewards: list[float], infos: Sequence[Mapping[str, Any]], states: Sequence[Any]
) -> Episode:
    conditioning = [float(info["conditioning"]) for info in infos]
    closure = [float(info["closure_error"]) for info in infos]
    successes = [bool(info["is_success"]) for info in infos]
    gaps = np.array([state.fk_position - state.platform_position for state in states])  # (n, 3) m
    fk_errors: list[float] = np.linalg.norm(gaps, axis=-1).tolist()
    torques: list[float] = np.ravel([state.torque for state in states]).tolist()  # (3 n,) N m
    named = {
        "reward": rewards,
        "conditioning": conditioning,
        "closure_error": closure,
        "fk_error": fk_errors,
        "torque": torques,
    }
    for name, values in named.items():
        for step, value in enumerate(values):
            # A NaN would pass through min and max unseen, depending on where it stands.
            if not math.isfinite(value):
                where = f"episode with seed {seed}, step {step * len(rewards) // len(values)}"
                raise RolloutError(f"{where}: {name} is {value!r}, expected a finite number")
    return Episode(
        seed=seed,
        success_at_end=successes[-1],
        success_once=any(successes),
        total_reward=math.fsum(rewards),
        conditioning_min=min(conditioning),
        conditioning_mean=math.fsum(conditioning) / len(conditioning),
        closure_error_max=max(closure),
        length=len(rewards),
        unsafe_share=sum(info["singularity_penalty"] > 0 for info in infos) / len(infos),
        fk_error_max=max(fk_errors),
        torque_rms=math.hypot(*torques) / math.sqrt(len(torques)),
        torque_peak=max(map(abs, torques)),
    )


WORST: Final = {
    "conditioning_min": min,
    "closure_error_max": max,
    "fk_error_max": max,
    "torque_rms": max,
    "torque_peak": max,
}


def summarise(records: Sequence[Episode]) -> dict[str, Estimate]:
    """Return the metrics of an evaluation by name, each with its 95% interval over episodes.

    Success rates have Wilson intervals, which stay honest at 0 and 1; the others have percentile
    bootstrap intervals, and those that are the extreme of an episode the worst of all episodes.
    """
    values = {
        name: [record.as_dict()[name] for record in records]
        for name in records[0].as_dict()
        if name not in ("seed", "length")
    }
    return {
        name: wilson(column)
        if name.startswith("success")
        else bootstrap(column, worst=WORST[name](column) if name in WORST else None)
        for name, column in values.items()
    }
