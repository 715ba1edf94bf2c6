"""Rollouts of a policy over seeded episodes, and their metrics.

Training uses seeds below ``SELECTION_SEED``. The periodic evaluations that select ``best.zip`` use
seeds from ``SELECTION_SEED`` on. ``tpm-gym evaluate`` uses seeds from ``TEST_SEED`` on. So no
result comes from episodes that trained or selected the policy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, TypeAlias

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tpm_gym.learning.errors import RolloutError
from tpm_gym.learning.estimates import Estimate, bootstrap, wilson

if TYPE_CHECKING:
    from tpm_gym.envs.vector import TPMVectorEnv

SELECTION_SEED: Final = 1_000_000
TEST_SEED: Final = 2_000_000
_TOLD: Final = ("conditioning", "closure_error", "is_success", "singularity_penalty")
BATCH: Final = 1000
"""Largest number of environments that are evaluated at once."""

Observation: TypeAlias = dict[str, NDArray[Any]]
Action: TypeAlias = NDArray[Any]
GoalEnv: TypeAlias = gym.Env[Observation, Action]


class Policy(Protocol):
    """Policy that acts in n episodes at a time."""

    def reset(self, observation: Observation, seeds: Sequence[int]) -> None:
        """Prepare for n episodes that start with ``observation`` and were reset with ``seeds``."""

    def act(self, observation: Observation) -> Action:
        """Return the actions (n, ...) for ``observation``."""


@dataclass(frozen=True)
class Episode:
    """Outcome of one episode.

    Attributes:
        total_reward: Undiscounted sum of rewards, the return.
        conditioning_min: Smallest 1/cond(J) of all steps, in [0, 1].
        closure_error_max: Largest loop gap of all steps, m.
        unsafe_share: Share of the steps below the machine's safe conditioning.
        fk_error_max: Largest distance of the observed point P (forward kinematics of the encoders)
            from the simulated point P, m.
        torque_rms: Root mean square of the motors' torques at the ends of the steps, N m.
        torque_peak: Largest of these torques, N m.
        events: For each event of the task, as in ``{"crossed_once": True}``, whether the info of
            at least one step reported it.
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
    events: Mapping[str, bool] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, with ``total_reward`` as ``"return"`` and an entry for each event."""
        values = {
            "return" if name == "total_reward" else name: value
            for name, value in vars(self).items()
        }
        events: Mapping[str, bool] = values.pop("events")
        return {**values, **events}


class Step(NamedTuple):
    """A control step of n environments.

    Attributes:
        seen: Observation before the step.
        known: Info before the step.
        running: (n,) whether the episode was running before the step.
        told: Info after the step.
    """

    seen: Observation
    known: dict[str, Any]
    running: NDArray[np.bool_]
    action: Action
    after: Observation
    reward: NDArray[Any]
    truncated: NDArray[np.bool_]
    told: dict[str, Any]


def play(
    envs: TPMVectorEnv,
    policy: Policy,
    first_seed: int,
    count: int,
    on_frame: Callable[[], object] | None = None,
) -> Iterator[Step]:
    """Run an episode in each environment, and yield the steps.

    Stop when the episodes of environments 0 to ``count - 1`` have ended.

    Args:
        first_seed: Environment i is reset with ``first_seed + i``.
        on_frame: Called after the reset and after each step.
    """
    seen, known = envs.reset(seed=first_seed)
    policy.reset(seen, range(first_seed, first_seed + envs.num_envs))
    if on_frame is not None:
        on_frame()
    running = np.ones(envs.num_envs, dtype=np.bool_)
    while running[:count].any():
        action = policy.act(seen)
        after, reward, _, truncated, told = envs.step(action)
        yield Step(seen, known, running, action, after, reward, truncated, told)
        seen, known, running = after, told, running & ~truncated
        if on_frame is not None:
            on_frame()


def run_episodes(
    envs: TPMVectorEnv,
    policy: Policy,
    episodes: int,
    first_seed: int,
    *,
    on_frame: Callable[[], object] | None = None,
    on_episodes: Callable[[int], object] | None = None,
) -> list[Episode]:
    """Run a policy for a number of episodes; equal arguments give equal records.

    Args:
        envs: Environments with next-step autoreset. Each environment plays one episode at a time.
            The environments are not closed.
        first_seed: Episode i is reset with ``first_seed + i``.
        on_frame: Called after every reset and every step, for example to record a video.
        on_episodes: Called with the number of episodes that have just ended, as for a progress bar.

    Raises:
        RolloutError: A value of a record is not finite.
    """
    records = []
    for first in range(first_seed, first_seed + episodes, envs.num_envs):
        count = min(envs.num_envs, first_seed + episodes - first)
        records += _run_together(envs, policy, first, count, on_frame)
        if on_episodes is not None:
            on_episodes(count)
    return records


def _run_together(
    envs: TPMVectorEnv,
    policy: Policy,
    first_seed: int,
    count: int,
    on_frame: Callable[[], object] | None,
) -> list[Episode]:
    """Run an episode in each environment; return records of environments 0 to ``count - 1``."""
    steps: list[dict[str, Any]] = []
    lengths = np.zeros(envs.num_envs, dtype=np.int64)
    # The metric of an event is the share of episodes that had it.
    events = {f"{event}_once": event for event in envs.task.events}
    for step in play(envs, policy, first_seed, count, on_frame):
        state = envs.state
        gap = state.fk_position - state.platform_position
        told = {name: step.told[name] for name in _TOLD}
        told["fk_error"] = np.sqrt((gap * gap).sum(axis=-1))
        told |= {metric: step.told[event] for metric, event in events.items()}
        steps.append({"reward": step.reward, "torque": state.torque, **told})
        lengths += step.running
    table = {name: np.array([step[name] for step in steps]) for name in steps[0]}
    records = []
    for k in range(count):
        own = {name: values[: lengths[k], k] for name, values in table.items()}
        records.append(_record(first_seed + k, own, [*events]))
    return records


def _record(seed: int, steps: Mapping[str, NDArray[Any]], events: Sequence[str]) -> Episode:
    """Compute the outcome of an episode from the values (n, ...) of its n steps."""
    for name, values in steps.items():
        if not np.isfinite(values).all():
            place = tuple(np.argwhere(~np.isfinite(values))[0].tolist())
            where = f"episode with seed {seed}, step {place[0]}"
            raise RolloutError(f"{where}: {name} is {values[place]}, expected a finite number")
    conditioning, successes = steps["conditioning"].tolist(), steps["is_success"].tolist()
    torques: list[float] = steps["torque"].ravel().tolist()
    length = len(successes)
    try:
        total = math.fsum(steps["reward"].tolist())
    except OverflowError as error:
        raise RolloutError(
            f"episode with seed {seed}: its return overflows; give smaller rewards, or a smaller "
            "penalty_weight"
        ) from error
    return Episode(
        seed=seed,
        success_at_end=successes[-1],
        success_once=any(successes),
        total_reward=total,
        conditioning_min=min(conditioning),
        conditioning_mean=math.fsum(conditioning) / length,
        closure_error_max=float(steps["closure_error"].max()),
        length=length,
        unsafe_share=int((steps["singularity_penalty"] > 0).sum()) / length,
        fk_error_max=float(steps["fk_error"].max()),
        torque_rms=math.hypot(*torques) / math.sqrt(len(torques)),
        torque_peak=max(map(abs, torques)),
        events={name: bool(steps[name].any()) for name in events},
    )


_WORST: Final[Mapping[str, Any]] = {
    "conditioning_min": min,
    **dict.fromkeys(("closure_error_max", "fk_error_max", "torque_rms", "torque_peak"), max),
}


def summarise(records: Sequence[Episode]) -> dict[str, Estimate]:
    """Return the metrics of an evaluation by name, each with its 95% interval over episodes.

    Success rates and shares of episodes with an event have Wilson intervals, which are also valid
    for rates and shares of 0 and 1. Other metrics have percentile bootstrap intervals. The lowest
    conditioning, the largest errors and the torques also have the value of the worst episode.
    """
    rows = [record.as_dict() for record in records]
    found = {}
    for name in (name for name in rows[0] if name not in ("seed", "length")):
        column = [row[name] for row in rows]
        worst = _WORST[name](column) if name in _WORST else None
        yes_or_no = isinstance(column[0], bool)
        found[name] = wilson(column) if yes_or_no else bootstrap(column, worst)
    return found
