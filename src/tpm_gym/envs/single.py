"""Single environment with the interface of Gymnasium."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import FloatArray, finite
from tpm_gym.envs.core import (
    Core,
    EnvSnapshot,
    Observation,
    action_space,
    compute_reward,
    seed_of,
)
from tpm_gym.envs.rendering import RENDER_MODES
from tpm_gym.errors import ActionError, ConfigurationError, ModeChangeError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.display import has_display
from tpm_gym.simulation.drives import Servo
from tpm_gym.simulation.imaging import Camera
from tpm_gym.simulation.randomisation import Randomisation
from tpm_gym.simulation.simulation import Simulation
from tpm_gym.simulation.state import CONTROL_PERIOD, State
from tpm_gym.tasks.task import Task

Action = NDArray[Any]

_ROW = np.array([0])


class TPMEnv(gym.Env[Observation, Action]):
    """Environment of a 3-translational parallel mechanism over a table.

    ## Ids

    ``TPM<task>{,Joints}{,Dense}-v0``: Cartesian or joint increments, sparse or dense goal term.
    The classes of :mod:`tpm_gym.tasks` explain the tasks.

    | task | action | observation | goal | steps | what to do |
    | --- | --- | --- | --- | --- | --- |
    | Reach | 3 | 9 | 3 | 50 | bring P to the goal |
    | PickAndPlace | 4 | 21 | 3 | 50 | bring the block to the goal, on the table or above it |
    | Push | 3 | 23 | 3 | 50 | push the block to the goal |
    | Stack | 4 | 33 | 6 | 100 | put the first block on the goal and the second on it |
    | Throw | 4 | 21 | 3 | 60 | release the block in motion, so that it slides to the goal |
    | Conveyor | 4 | 22 | 3 | 80 | bring the block from the belt to the tray |
    | Cycle | 3 | 9 | 3 | 75 | carry a payload 25 mm up, 305 mm across, 25 mm down, fast |
    | Crossing | 3 | 9 | 3 | 50 | pass the parallel singularity; Cartesian increments only |

    A control step takes 40 ms. Episodes are truncated, never terminated. The numbers below apply
    to the paper's machine.

    ## Frames

    The world frame is right-handed, with z up and the table top at z = 0. The base hangs upside
    down at z = height: a point (x, y, z) of the paper's frame is (x, -y, height - z) in the world.
    In the world frame, the workspace is thin along y and lies at negative y. Point P is the middle
    of the platform; the vacuum cup ends 40 mm below it.

    ## Action

    Box of [-1, 1]; other values are clipped.

    | entries | meaning |
    | --- | --- |
    | 0 to 2, Cartesian | increment of the command for P, paper's x, y, z: at most 30, 5, 30 mm |
    | 0 to 2, joints | increments of theta_1 to theta_3: at most 0.08 rad each |
    | 3, with vacuum | above 0: vacuum on |

    Increments change the last command, and the result is projected into the task region. P
    follows the commands along a B-spline. In the world frame, the task region of P is
    -0.24 <= x <= 0.12, -0.046 <= y <= -0.012, 0.067 <= z <= 0.31 m. Along each axis, joint
    increments move P no farther than the largest Cartesian increment. Small turns of the joints
    move P far along y. Therefore the limit along y shortens random joint increments to about a
    tenth of their length (median), with one factor for all three joints. Cycle has control steps
    of 4 ms, smaller increments and bounded accelerations.

    ## Observation

    A dictionary. ``achieved_goal`` and ``desired_goal`` are points (m) in the world frame: P, or
    the centre of each block. ``observation`` has these entries, each scaled to order one
    (``env.unwrapped.task.decode`` gives SI units):

    | entry | size | meaning |
    | --- | --- | --- |
    | position | 3 | P by forward kinematics of the encoders |
    | velocity | 3 | J(theta) theta_dot, from the encoders |
    | command | 3 | commanded P minus position |
    | object_position | 3 | centre of the object, from a camera |
    | object_offset | 3 | top of the object minus lip of the cup |
    | object_velocity | 3 | velocity of the object, from a camera |
    | object_tilt | 2 | x and y of the unit vector along the object's z axis |
    | object_held | 1 | vacuum, measured by a gauge, 0 to 1; 0 if the object is not held |

    The entries of the object are repeated for each object. Push adds the object's turn about the
    vertical, and Conveyor the speed of the belt. Entries of the robot come from the encoders alone,
    never from the simulated platform.

    With ``observations="pixels"`` the dictionary has a fourth entry: ``pixels``, (84, 84, 3) uint8,
    a picture from the camera of the option ``camera``. ``observation`` then has no entries of
    objects. The goals stay vectors, as hindsight needs them. ``achieved_goal`` contains the
    position of the block; a policy for cameras alone must not use it.

    ## Reward

    The sum of the terms ``goal`` and ``singularity``. Cycle adds ``gate``, to sparse and dense
    rewards. Tasks with objects add ``approach``, to dense rewards only. In Stack, the distance is
    that of the block farther from its goal, and the cup approaches the upper block. In the step
    that passes a singularity, the term ``singularity`` is -penalty_weight, except at y = 0 in
    Crossing.

    | term | value |
    | --- | --- |
    | goal, sparse | -1; 0 if the distance is below the tolerance: 10 mm, Throw 20, Cycle 2 |
    | goal, dense | minus the distance in units of 0.1 m; Cycle: steeper within 10 mm of the goal |
    | singularity | -penalty_weight x (1 - (c / 0.08)^4) where c = 1/cond(J) < 0.08, else 0 |
    | approach | minus half the distance from cup to block in units of 0.1 m |
    | gate | -(d - 2 mm) / 5 mm, at most 0; d is the depth of P below Cycle's gate-shaped path |

    SB3's HerReplayBuffer calls ``compute_reward`` with an empty info, which gives the goal term
    alone. ``tpm_gym.learning.PenaltyHerReplayBuffer`` keeps the other terms; so does SB3's buffer
    with ``copy_info_dict=True``.

    ## Start

    The arm is at rest at home (Cycle: at one end). Blocks (square, 36 mm wide, 30 mm high, 50 g)
    are flat on the table or the belt. Goals and objects are sampled where 1/cond(J) >= 0.08, and
    at least 30 mm away from each other. In Reach, the goal is at least 30 mm away from P.
    ``reset(options={"object": (x, y, z), "goal": (x, y, z)})`` sets both; a block that starts above
    the table falls.

    ## Info

    | key | meaning |
    | --- | --- |
    | ``is_success`` | whether the goal is achieved |
    | ``closure_error`` | largest gap of the simulated loops, m; always 0 in the analytic engine |
    | ``vacuum`` | pressure in the cup below the ambient pressure, Pa |
    | ``conditioning`` | 1/cond(J), computed from the encoders |
    | ``singularity_penalty`` | penalty before weighting, 0 to 1 |
    | ``assembly_mode_changed`` | whether the platform passed y = 0, a parallel singularity |
    | ``working_mode_changed`` | whether the platform passed y = l7, a serial singularity |
    | ``object_lost`` | whether an object left the table or its allowed area |
    | ``reward_terms`` | the terms above by name; they sum to the reward |
    | ``randomisation`` | the episode's plant; only from reset(), if this option is set |

    Here y is in the paper's frame, and l7 is the length of link 7. The allowed area of an object is
    a rectangle that contains its starts, its goals and the places to which the cup can carry it.
    Crossing adds ``crossed``: whether P is on the other side of y = 0 than home;
    ``assembly_mode_changed`` does not report this passage. Push adds ``toppled``: whether the block
    lies on a side.

    An environment that is made as ``TPMEnv(...)`` has no time limit; ``gym.make`` adds it.

    Past a parallel singularity the encoders no longer determine the platform's position. Therefore
    the penalty is then 1, and the episode is truncated. Crossing is an exception: when P passes
    y = 0, the penalty still depends on the conditioning, and the episode goes on. With the nominal
    robot and ideal drives, no action leads past a parallel singularity, except in Crossing and in
    Cycle. In Cycle, adversarial actions at full speed can need more torque than the motors have;
    ``shield=True`` prevents this.

    Args:
        task: Name of a task (``"reach"``, ``"pick_and_place"``, or one that
            :func:`tpm_gym.register_task` has registered), a :class:`~tpm_gym.tasks.Task` class, or
            an instance, which keeps its own machine, reward, goals and penalty weight.
        control: ``"cartesian"`` or ``"joints"``.
        reward: ``"sparse"`` (also for None) or ``"dense"``.
        engine: ``"pybullet"``, ``"analytic"``, ``"mujoco"`` (with the extra of that name), or a
            name that :func:`tpm_gym.register_engine` has registered. The analytic engine draws with
            PyBullet, or with MuJoCo where PyBullet is not installed.
        machine: ``"paper"`` (also for None), ``"wide"``, a name that
            :func:`tpm_gym.register_machine` has registered, or a :class:`~tpm_gym.Machine`. To
            write the environment's spec as JSON, give a name.
        goals: ``"sampled"`` (also for None), or ``"tempting"``: goal and start of the block lie
            next to a singularity. This is possible only if the machine's region for goals has such
            places.
        penalty_weight: Weight of the singularity penalty, None for 1; 0 switches it off.
        drive: Drive of the motors. ``"ideal"`` (also for None) follows references exactly, with up
            to 100 N m at any speed. ``"servo"`` is a servo drive, which lags behind the references.
            Its gains are 7500 N m/rad, 60 N m s/rad; the torques of the nominal motion are fed
            forward. Its largest torque is 100 N m up to 18.75 rad/s, and falls to zero at
            25 rad/s. For a servo drive with other parameters, give a
            :class:`~tpm_gym.simulation.Servo` or a mapping of its attributes.
        randomisation: Differences from the nominal machine, drawn for each episode: a
            :class:`~tpm_gym.simulation.Randomisation` or a mapping of its attributes. If disturbed
            encoders report joint positions at which the mechanism cannot be assembled, the
            observation uses the last valid position of P and the last valid J.
        shield: Whether each action is replaced by the nearest one that keeps the conditioning at
            the machine's ``safe_conditioning`` or above, over the whole control period. With servo
            drives or randomisation, True keeps 15% more. A number is the conditioning to keep.
        physics: Numerical settings of the engine: a ``Physics`` from
            ``tpm_gym.simulation.{bullet,mujoco,analytic}.physics``, or a mapping of its attributes,
            such as ``time_step`` (s).
        observations: ``"state"``, or ``"pixels"``: see above.
        pixel_size: Width and height of the pictures in pixel observations.
        render_mode: Result of ``render()``. None: nothing. ``"human"``: a window, in real time, on
            a display. ``"rgb_array"``: (height, width, 3) uint8. ``"depth_array"``: (height, width)
            float32, distance along the camera's axis in m, infinite where there is no body.
            ``"rgbd_tuple"``: both. ``"segmentation"``: (height, width) int32, 0 background and
            floor, 1 table, 2 robot, 3 vacuum cup, 4 the first object, 5 the second, and so on.
            Goal markers are drawn in colour pictures, but not in distances or segmentation.
        renderer: Renderer of pictures; for PyBullet ``"tiny"`` (any computer) or ``"egl"`` (GPU),
            for MuJoCo ``"egl"``, ``"osmesa"`` or ``"glfw"``; None for the first that works.
        camera: ``"table"`` (task region, close by), ``"overview"`` (whole robot), ``"cup"``
            (follows the cup), a :class:`~tpm_gym.simulation.Camera`, or a mapping of its
            attributes.
        width: Width of pictures, pixels.
        height: Height of pictures, pixels.

    Raises:
        ConfigurationError: If an option is out of range.
        MissingPackageError: If the engine's package is not installed.

    An environment with PyBullet takes about 29 MB of memory until it is closed or deleted.
    PyBullet's client takes 28 MB of this memory.

    ## Version history

    * v0: not released yet; observations and physics still change.
    """

    # Gymnasium declares an instance attribute, so this cannot be a ClassVar.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        task: str | type[Task] | Task = "reach",
        control: str = "cartesian",
        reward: str | None = None,
        *,
        engine: str = "pybullet",
        machine: str | Machine | None = None,
        goals: str | None = None,
        penalty_weight: float | None = None,
        drive: str | Servo | Mapping[str, Any] | None = None,
        randomisation: Randomisation | Mapping[str, Any] | None = None,
        shield: bool | float = False,
        physics: Any = None,
        observations: str = "state",
        pixel_size: int = 84,
        render_mode: str | None = None,
        renderer: str | None = None,
        camera: str | Camera | Mapping[str, Any] = "table",
        width: int = 640,
        height: int = 480,
    ) -> None:
        """Check the options and start the simulation."""
        # Without a display an engine's window would end the process; offer what can be shown.
        modes = [mode for mode in self.metadata["render_modes"] if mode != "human" or has_display()]
        self.metadata = {**self.metadata, "render_modes": modes}
        if render_mode is not None and render_mode not in modes:
            valid = f"None, {', '.join(map(repr, modes))} ('human' needs a display)"
            raise ConfigurationError("render_mode", render_mode, valid)
        self.render_mode = render_mode
        self._core = Core(
            task,
            control,
            reward,
            engine=engine,
            machine=machine,
            goals=goals,
            penalty_weight=penalty_weight,
            drive=drive,
            randomisation=randomisation,
            shield=shield,
            physics=physics,
            observations=observations,
            pixel_size=pixel_size,
            render_mode=render_mode,
            renderer=renderer,
            camera=camera,
            width=width,
            height=height,
        )
        self.task, self.machine = self._core.task, self._core.machine
        self.metadata["render_fps"] = round(1 / self.task.control_period)
        self.control, self.drive = self._core.control, self._core.drive
        self.randomisation = self._core.randomisation
        self.observation_space = self._core.observation_space
        self.action_space = action_space(self.task)
        self._action = (self.task.action_size,)
        self._shown = 0.0  # when the last frame was due, s of the performance counter

    # -- the Gymnasium interface ----------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seeds the environment's rng; equal seeds give equal episodes.
            options: Start positions of objects (by name) and the ``goal``, m, world frame. A
                position or goal that is not given is sampled.

        Raises:
            ResetOptionError: If an option is unknown, has the wrong shape, is not finite, or would
                put an object into another or into the robot; the environment is then unchanged.
            UnreachableError: If an object or the goal is out of reach; the environment is then
                unchanged.
            EpisodeError: If the environment is closed.
            ConfigurationError: If a method of the task returns a wrong shape, type or value.
        """
        core, rng = self._core, None
        if seed is not None:
            rng, seed = seeding.np_random(seed)
        (randomisation,) = core.reset(_ROW, [self.np_random if rng is None else rng], options)
        if rng is not None:
            self._np_random, self._np_random_seed = rng, seed
        observation, _, info = _row(*core.report())
        if randomisation:
            info["randomisation"] = randomisation
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Run one control step.

        Raises:
            ActionError: If the action has the wrong shape or is not finite; the environment is then
                unchanged.
            EpisodeError: If there is no episode: before reset, after close or after a ClosureError.
            ClosureError: If a loop of the mechanism opened.
            ModeChangeError: If the mechanism passed a singularity earlier in this episode.
            ConfigurationError: If a result of the task is not finite.
        """
        core = self._core
        plain = type(action) is np.ndarray and action.dtype.char in "df"
        if not plain or action.shape != self._action or not np.isfinite(action).all():
            action = finite("action", action, self._action, ActionError)
        state = core.state
        if state.assembly_mode_changed[0] or state.working_mode_changed[0]:
            raise ModeChangeError("assembly" if state.assembly_mode_changed[0] else "working")
        core.step(action.astype(np.float64)[None], _ROW)
        observation, reward, info = _row(*core.report())
        truncated = info["assembly_mode_changed"] or info["working_mode_changed"]
        if self.render_mode == "human":
            self.render()
        return observation, reward, False, truncated, info

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Mapping[str, Any] | Sequence[Mapping[str, Any]] | NDArray[Any],
    ) -> Any:
        """Compute the reward of a transition, or of a batch of them, for any goal.

        Terms that do not depend on the goal are taken from ``info``. If ``info`` is empty, the
        result is the goal term alone; SB3's HerReplayBuffer passes an empty ``info``.

        Args:
            achieved_goal: (..., goal size) m.
            desired_goal: (..., goal size) m.
            info: The step's info, or one for each transition of the batch.

        Returns:
            The reward, a float; for a batch, an array (...,) of rewards.

        Raises:
            InputError: If the goals are no real numbers of these shapes, or ``info`` does not fit.
        """
        return compute_reward(self.task, achieved_goal, desired_goal, info)

    def render(self) -> Any:
        """Draw the scene in the ``render_mode``; in ``human`` mode, wait for real time.

        Returns:
            See the argument ``render_mode`` of the class.

        Raises:
            EpisodeError: If the environment is closed, or before the first reset.
            ConfigurationError: If the engine cannot draw in this ``render_mode``.
        """
        if self.render_mode == "human":
            self._core.show()
            now = time.perf_counter()
            self._shown = max(self._shown + self.task.control_period, now)
            time.sleep(self._shown - now)
            return None
        self._core.require_open()
        return None if self.render_mode is None else self._core.frame(0)

    def close(self) -> None:
        """Close the simulation; a second call does nothing."""
        self._core.close()

    # -- beyond Gymnasium -----------------------------------------------------------------------

    @property
    def simulation(self) -> Simulation:
        """The simulation behind the environment."""
        return self._core.simulation

    @property
    def episode(self) -> int:
        """Number of episodes that were started or restored."""
        return int(self._core.episode[0])

    @property
    def state(self) -> State:
        """The state after the last step or reset, without a leading axis.

        Raises:
            EpisodeError: If no episode is running.
        """
        return self._core.state.take(0)

    @property
    def goal(self) -> FloatArray:
        """The episode's goal, (goal size,) m, world."""
        goal: FloatArray = self._core.goals[0].copy()
        return goal

    def save_state(self) -> EnvSnapshot:
        """Return a snapshot of physics, rng, goal, delayed actions and grasp.

        Steps from here and steps after :meth:`restore_state` agree in every bit. With two blocks in
        PyBullet, they agree only up to rounding errors. The step count of the wrapper ``TimeLimit``
        is not part of the snapshot.

        Raises:
            EpisodeError: If no episode is running.
        """
        return self._core.save()

    def restore_state(self, snapshot: EnvSnapshot) -> Observation:
        """Continue from a snapshot of this environment or of an equal one.

        Returns:
            The observation at that moment.

        Raises:
            EpisodeError: If the environment is closed.
            InputError: If ``snapshot`` is no snapshot of an equal environment; the environment is
                then unchanged.
        """
        observation = self._core.restore(snapshot)
        (rng,) = self._core.rngs
        self._np_random, self._np_random_seed = rng, seed_of(rng)
        return {name: values[0] for name, values in observation.items()}


def _row(
    observation: Observation, reward: FloatArray, info: Mapping[str, Any]
) -> tuple[Observation, float, dict[str, Any]]:
    """Convert a report of one row to the results of one environment, in Python numbers."""
    plain: dict[str, Any] = {}
    for name, value in info.items():
        if name != "reward_terms":
            plain[name] = value.item()
    plain["reward_terms"] = terms = {}
    for name, value in info["reward_terms"].items():
        terms[name] = float(value.item())
    for name, value in observation.items():
        observation[name] = value[0]
    return observation, reward.item(), plain
