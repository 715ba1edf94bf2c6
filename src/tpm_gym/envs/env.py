"""The Gymnasium environment."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import FloatArray, Vector, floats, is_whole
from tpm_gym.envs.report import (
    GOAL_BOUND,
    OBSERVATION_BOUND,
    Observation,
    compute_reward,
    observe,
    report,
)
from tpm_gym.errors import (
    ActionError,
    ConfigurationError,
    EpisodeError,
    InputError,
    ModeChangeError,
)
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.display import has_display
from tpm_gym.simulation.drives import Servo, drives_and_randomisation
from tpm_gym.simulation.engine import SIMULATIONS
from tpm_gym.simulation.randomisation import Randomisation
from tpm_gym.simulation.simulation import Simulation, Snapshot, make_simulation
from tpm_gym.simulation.state import CONTROL_PERIOD, State
from tpm_gym.tasks.control import make_control
from tpm_gym.tasks.registry import make_task
from tpm_gym.tasks.task import Task

__all__ = ["EnvSnapshot", "TPMEnv"]

Action = NDArray[Any]

_PLAIN = {bool, int, float}  # Python's own numbers


@dataclass(frozen=True)
class EnvSnapshot:
    """Everything that the next steps of an unwrapped environment depend on."""

    simulation: Snapshot
    rng: dict[str, Any]
    goal: FloatArray
    pending: tuple[tuple[float, ...], ...]
    kind: Mapping[str, Any]
    digest: str

    def is_intact(self) -> bool:
        """Whether nothing has been changed since it was taken, by the digest."""
        own = (self.simulation, self.rng, self.goal, self.pending, self.kind)
        try:
            return bool(self.digest == _digest(own))
        except Exception:  # of the repr of whatever somebody put in
            return False


class TPMEnv(gym.Env[Observation, Action]):
    """A 3-translational parallel mechanism over a table.

    ## Ids

    ``TPM{Reach,PickAndPlace}{,Joints}{,Dense}-v0``: Cartesian or joint increments, sparse or dense
    reward. Control at 25 Hz, episodes of 50 steps, truncation only. Numbers below are those of the
    paper's machine.

    ## Frames

    World: z up, table top at z = 0, x and y as seen from above. The base hangs upside down, so
    world = (x, -y, height - z) of the paper's frame; the workspace is a slab of negative world y.
    Point P is the middle of the platform; the vacuum cup ends 40 mm below it.

    ## Action

    Box of [-1, 1]; values beyond are clipped.

    | entries | meaning |
    | --- | --- |
    | 0 to 2, Cartesian | increment of the command for P, paper's x, y, z: at most 30, 5, 30 mm |
    | 0 to 2, joints | increment of theta_1 to theta_3: at most 0.08 rad, P at most as above |
    | 3 (PickAndPlace) | above 0: vacuum on |

    Commands accumulate, are projected into the task region, and are followed along a B-spline. The
    region is -0.24 <= x <= 0.12, -0.046 <= y <= -0.012, 0.067 <= z <= 0.31 m for P, world. Small
    turns of the joints move P far along y, so the limit for P slows most random joint actions down
    to a tenth, all three joints together.

    ## Observation

    A dictionary. ``achieved_goal`` and ``desired_goal`` are (3,) m in the world frame: point P
    (Reach) or the centre of the puck (PickAndPlace). ``observation``, 9 numbers (Reach) or 21,
    holds what follows, each scaled to order one (``env.unwrapped.task.decode`` gives SI units):

    | entry | size | meaning |
    | --- | --- | --- |
    | position | 3 | P by forward kinematics of the encoders |
    | velocity | 3 | J(theta) theta_dot, from the encoders |
    | command | 3 | commanded P minus position |
    | object_position | 3 | centre of the object, from a camera |
    | object_offset | 3 | top of the object minus lip of the cup |
    | object_velocity | 3 | velocity of the object, from a camera |
    | object_tilt | 2 | x and y of the object's axis |
    | object_held | 1 | share of the vacuum that holds the object, by a gauge |

    The object's entries exist in PickAndPlace only. The robot's come from the three encoders alone,
    never from the simulator's platform.

    ## Reward

    ``goal`` term + ``singularity`` term (+ ``approach`` term in PickAndPlaceDense).

    | term | value |
    | --- | --- |
    | goal, sparse | 0 if the distance to the goal is below 10 mm, else -1 |
    | goal, dense | minus the distance in units of 0.1 m |
    | singularity | -penalty_weight x (1 - (c / 0.08)^4) where c = 1/cond(J) < 0.08, else 0 |
    | approach | minus half the distance from cup to puck in units of 0.1 m |

    With an empty info, as SB3's HerReplayBuffer calls it, ``compute_reward`` gives the goal term
    alone; ``tpm_gym.learning.PenaltyHerReplayBuffer`` or ``copy_info_dict=True`` keep the others.

    ## Start

    The arm at rest at home, the puck (square, 36 mm wide, 30 mm high, 50 g) flat on the table, the
    goal at least 30 mm away from where the puck (or P) starts. Goals and objects are sampled where
    1/cond(J) >= 0.08.
    ``reset(options={"object": (x, y, z), "goal": (x, y, z)})`` chooses them instead; a puck that
    starts above the table falls.

    ## Info

    | key | meaning |
    | --- | --- |
    | ``is_success`` | whether the goal is achieved |
    | ``closure_error`` | largest gap of the simulated loops, m; 0 in closed form, by construction |
    | ``vacuum`` | how far the pressure in the cup is below the ambient's, Pa |
    | ``conditioning`` | 1/cond(J) by the encoders |
    | ``singularity_penalty`` | before weighting, 0 to 1 |
    | ``assembly_mode_changed`` | whether the platform passed y = 0, a parallel singularity |
    | ``working_mode_changed`` | whether it passed y = l7, a serial one |
    | ``object_lost`` | whether an object is off the table or where the robot cannot get to |
    | ``reward_terms`` | the terms above by name; they sum to the reward |
    | ``randomisation`` | in a reset's, with that option: what differs in the episode |

    An environment that is made as ``TPMEnv(...)`` has no time limit; ``gym.make`` adds it.

    Past a parallel singularity the encoders no longer tell where the platform is. No action of the
    nominal robot with ideal drives leads past one; if it happens, the penalty is 1 and the episode
    truncated.

    Args:
        task: Name of a task (``"reach"``, ``"pick_and_place"``, or one that
            :func:`tpm_gym.register_task` knows), a :class:`~tpm_gym.tasks.Task` class, or a task; a
            task that is made has its own machine, reward, goals and penalty weight, and takes none.
        control: ``"cartesian"`` or ``"joints"``.
        reward: ``"sparse"`` (None too) or ``"dense"``.
        engine: ``"pybullet"``, ``"analytic"`` (the closed form), ``"mujoco"`` (with the extra of
            that name; neither of these two opens a window), or a name that
            :func:`tpm_gym.register_engine` knows.
        machine: ``"paper"`` (None too), ``"wide"``, a name that :func:`tpm_gym.register_machine`
            knows, or a :class:`~tpm_gym.Machine`; a spec that goes through JSON needs a name.
        goals: ``"sampled"`` (None too), or ``"tempting"``: the goal, and where the puck starts, lie
            next to the singularity, which not every machine has near its goals.
        penalty_weight: Weight of the singularity penalty, None for 1; 0 switches it off.
        drive: How the motors follow their references. ``"ideal"`` (None too): exactly, with up to
            100 N m at any speed. ``"servo"``, a :class:`~tpm_gym.simulation.Servo` or a mapping of
            its attributes: with 7500 N m/rad, 60 N m s/rad, the torques of the nominal motion fed
            forward, and 100 N m up to 18.75 rad/s, which fall to none at 25 rad/s.
        randomisation: What differs from the nominal machine, drawn anew for each episode: a
            :class:`~tpm_gym.simulation.Randomisation` or a mapping of its attributes. Where
            disturbed encoders report angles that cannot be assembled, position and velocity keep
            their last values.
        physics: Numerical settings of the engine, or a mapping of them: for all of them
            ``time_step``, s; more in ``tpm_gym.simulation.{bullet,mujoco,analytic}.physics``.
        render_mode: None, ``"rgb_array"`` or ``"human"``.
        renderer: What draws pictures; for PyBullet ``"tiny"`` (any machine) or ``"egl"`` (GPU),
            for MuJoCo ``"egl"``, ``"osmesa"`` or ``"glfw"``; None for what works.
        width: Of rendered pictures, pixels.
        height: Of rendered pictures, pixels.

    Raises:
        ConfigurationError: If an option is out of range.
        MissingPackageError: If the engine's package is not installed.

    An environment keeps some 29 MB, 28 of them PyBullet's client, until it is closed or dropped.

    ## Version history

    * v0: not released yet; observations and physics still change.
    """

    # Gymnasium declares this as an instance's, so it cannot be a ClassVar.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
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
        physics: Any = None,
        render_mode: str | None = None,
        renderer: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        """Check the options and start the simulation."""
        # Without a display an engine's window would end the process; offer what can be shown.
        modes = [mode for mode in self.metadata["render_modes"] if mode != "human" or has_display()]
        self.metadata = {**self.metadata, "render_modes": modes}
        if render_mode is not None and render_mode not in modes:
            valid = f"None, {', '.join(map(repr, modes))} ('human' needs a display and PyBullet)"
            raise ConfigurationError("render_mode", render_mode, valid)
        self.render_mode = render_mode
        self.task = make_task(
            task, machine=machine, reward=reward, goals=goals, penalty_weight=penalty_weight
        )
        self.machine = self.task.machine
        self.control = make_control(control, self.machine)
        self.drive, self.randomisation = drives_and_randomisation(drive, randomisation)
        self._size = _pixels("width", width), _pixels("height", height)
        self.observation_space = observation_space(self.task)
        self.action_space = action_space(self.task)
        self.episode = 0  # how many have been started or restored
        self._home = tuple(self.machine.require_inverse(self.machine.home).tolist())
        self._state: State | None = None
        self._goal = np.full(self.task.goal_size, np.nan)
        self._pending: tuple[tuple[float, ...], ...] = ()  # actions that come late
        self._closed = False
        self._shown = 0.0  # when the last frame was due, s of the performance counter
        self._engine, self._physics, self._renderer = engine, physics, renderer
        # As a dictionary, which is what a spec that went through JSON has.
        numerics = physics
        if is_dataclass(physics) and not isinstance(physics, type):
            numerics = asdict(physics)
        self._kind = {
            "task": type(self.task),
            "machine": self.machine,
            "engine": engine,
            "drive": self.drive,
            "randomisation": self.randomisation,
            "physics": numerics,
        }
        self.simulation = self._start()

    def _start(self) -> Simulation:
        return make_simulation(
            self.task.scene,
            machine=self.machine,
            engine=self._engine,
            physics=self._physics,
            drive=self.drive,
            gui=self.render_mode == "human",
            renderer=self._renderer,
        )

    # -- the Gymnasium interface ----------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seeds the environment's rng; equal seeds give equal episodes.
            options: Where objects (by name) start and the ``goal`` is, m, world frame, instead of
                sampled ones.

        Raises:
            ResetOptionError: If an option is unknown, not so many finite numbers, or would put an
                object into another or into the robot.
            UnreachableError: If an object or the goal is out of reach.
            EpisodeError: If the environment is closed.
            ConfigurationError: If a method of the task does not give what it has to.
        """
        self._require_open()
        super().reset(seed=seed)
        rng = self.np_random
        start = self.task.start(rng, options)
        plant = self.randomisation.draw(rng, self.machine)
        self._goal = start.pop("goal")
        self._pending = ((0.0,) * self.task.action_size,) * self.randomisation.latency
        self._state = None
        self.episode += 1
        self._show_goal()
        self._state = self.simulation.reset(self._home, start, plant, self._draw_noise())
        self.task.check(self._state)
        observation, _, info = self._report(self._state)
        if self.randomisation != Randomisation():
            info["randomisation"] = self.randomisation.told(plant)
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Run one control step of 40 ms.

        Raises:
            ActionError: If the action has the wrong shape or is not finite; nothing has moved then.
            EpisodeError: If there is no episode: before reset, after close, after a lost loop.
            ClosureError: If a loop of the mechanism opened.
            ModeChangeError: If the mechanism passed a singularity earlier in this episode.
            ConfigurationError: If the task makes something of the state that is no number.
        """
        asked = floats("action", action, self.task.action_size, ActionError)
        state = self.state
        clipped = tuple([-1.0 if x < -1.0 else 1.0 if x > 1.0 else x for x in asked])
        now, *pending = (*self._pending, clipped)
        command = self._command(now[:3], state.command)  # type: ignore[arg-type]
        vacuum = self.task.vacuum and now[3] > 0
        self._state = None  # until the step has gone well
        try:
            self._state = self.simulation.move(command, vacuum, self._draw_noise())
        except ModeChangeError:
            self._state = state  # nothing has moved
            raise
        self._pending = tuple(pending)
        observation, reward, info = self._report(self._state)
        if self.render_mode == "human":
            self.render()
        return observation, reward, False, bool(self._state.passed_singularity), info

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Mapping[str, Any] | Sequence[Mapping[str, Any]] | NDArray[Any],
    ) -> Any:
        """The reward of a transition, or of a batch of them, for any goal.

        Terms that do not depend on the goal are taken from ``info``; where it is empty, as SB3's
        HerReplayBuffer hands it over, they are left out, and what remains is the goal term.

        Args:
            achieved_goal: (..., goal size) m.
            desired_goal: (..., goal size) m.
            info: The step's info, or one for each transition of the batch.

        Returns:
            A float, or (...,) of them.

        Raises:
            InputError: If the goals are no real numbers of these shapes, or ``info`` is neither.
        """
        return compute_reward(self.task, achieved_goal, desired_goal, info)

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as (height, width, 3) RGB; in ``human`` mode, wait for real time."""
        self._require_open()
        if self.render_mode == "rgb_array":
            return self.simulation.render(*self._size)
        if self.render_mode == "human":
            now = time.perf_counter()
            self._shown = max(self._shown + CONTROL_PERIOD, now)
            time.sleep(self._shown - now)
        return None

    def close(self) -> None:
        """Close the simulation; harmless the second time."""
        if not self._closed:
            self._closed = True
            self._state = None
            self.simulation.close()

    # -- beyond Gymnasium -----------------------------------------------------------------------

    @property
    def state(self) -> State:
        """What the simulation reported last.

        Raises:
            EpisodeError: If there is no episode.
        """
        self._require_open()
        if self._state is None:
            raise EpisodeError("no episode is running; call reset() first")
        return self._state

    @property
    def goal(self) -> FloatArray:
        """The episode's goal, (goal size,) m, world."""
        return np.array(self._goal)

    def save_state(self) -> EnvSnapshot:
        """Take down physics, rng, goal, commands and grasp; TimeLimit's count is not part of it.

        What follows, here or after :meth:`restore_state`, is equal to the last bit.

        Raises:
            EpisodeError: If there is no episode.
        """
        _ = self.state  # there has to be an episode
        rng = dict(self.np_random.bit_generator.state)
        moment = (self.simulation.save(), rng, self.goal, self._pending, self._kind)
        return EnvSnapshot(*moment, _digest(moment))

    def restore_state(self, snapshot: EnvSnapshot) -> Observation:
        """Go back to a moment that :meth:`save_state` took down.

        Returns:
            The observation at that moment.

        Raises:
            EpisodeError: If the environment is closed.
            InputError: If the moment is none, was changed, or is that of another kind of
                environment; nothing has happened then.
        """
        self._require_open()
        if not isinstance(snapshot, EnvSnapshot) or not snapshot.is_intact():
            raise InputError("snapshot", type(snapshot), "what save_state() returned, unchanged")
        require_same(snapshot.kind, self._kind)
        self.np_random.bit_generator.state = snapshot.rng
        self._goal, self._pending = snapshot.goal.copy(), snapshot.pending
        self._state = None
        self.episode += 1  # what was planned for the one before is void
        self._show_goal()
        self._state = self.simulation.restore(snapshot.simulation)
        return observe(self.task, self._state, self._goal)

    # -- inside ---------------------------------------------------------------------------------

    def _require_open(self) -> None:
        if self._closed:
            raise EpisodeError("the environment is closed; make a new one")

    def __getstate__(self) -> dict[str, Any]:
        """For :func:`copy.deepcopy` and :mod:`pickle`: all of it, in the midst of an episode.

        Raises:
            ConfigurationError: With a window, of which PyBullet opens only one in a process.
        """
        if self.render_mode == "human":
            valid = "None or 'rgb_array' for an environment that is copied or pickled"
            raise ConfigurationError("render_mode", self.render_mode, valid)
        running = self._state is not None
        snapshot = self.simulation.save() if running else None
        return {**vars(self), "simulation": snapshot, "_state": None}

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Start a simulation of its own, and take it to where the original was."""
        vars(self).update(values)
        snapshot: Snapshot | None = values["simulation"]
        self.simulation = self._start()
        if self._closed:
            self.simulation.close()
        elif snapshot is not None:
            self._show_goal()
            self._state = self.simulation.restore(snapshot)

    def _show_goal(self) -> None:
        self.simulation.show_goal(self.task.markers(self._goal))

    def _command(self, action: Vector, current: FloatArray) -> Vector:
        """The next command for P; where many robots are simulated, as it is computed for many.

        Args:
            action: In [-1, 1].
            current: (3,) m, world.
        """
        x, y, z = current.tolist()
        point = self.machine.mount.swap((x, y, z))
        if self._engine in SIMULATIONS:
            ((x, y, z),) = self.control.command(np.array([action]), np.array([point])).tolist()
            return x, y, z
        return self.control.next(action, point)

    def _draw_noise(self) -> Vector:
        """Errors of one reading of the encoders, rad."""
        if self.randomisation.encoder_noise == 0:
            return (0.0, 0.0, 0.0)
        a, b, c = self.np_random.normal(0.0, self.randomisation.encoder_noise, 3).tolist()
        return a, b, c

    def _report(self, state: State) -> tuple[Observation, float, dict[str, Any]]:
        """What Gymnasium wants: Python's own numbers."""
        observation, reward, info = report(self.task, state, self._goal)
        info["reward_terms"] = {name: float(v) for name, v in info["reward_terms"].items()}
        for name, value in info.items():
            if type(value) not in _PLAIN and isinstance(value, (np.generic, np.ndarray)):
                info[name] = value.item()
        return observation, float(reward), info


def observation_space(task: Task) -> spaces.Dict:
    """The space of a task's observations."""
    return spaces.Dict(
        {
            "observation": _box(OBSERVATION_BOUND, task.observation_size),
            "achieved_goal": _box(GOAL_BOUND, task.goal_size),
            "desired_goal": _box(GOAL_BOUND, task.goal_size),
        }
    )


def action_space(task: Task) -> spaces.Box:
    """The space of a task's actions."""
    return _box(1.0, task.action_size)


def _box(bound: float, length: int) -> spaces.Box:
    return spaces.Box(-bound, bound, (length,), np.float32)


def _pixels(name: str, value: Any) -> int:
    if is_whole(value, 16) and value <= 4096:
        return int(value)
    raise ConfigurationError(name, value, "a whole number of pixels from 16 to 4096")


def require_same(kind: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Refuse a snapshot of one kind of environment in one of another.

    Raises:
        InputError: If they differ, with the names of what does.
    """
    other = [name for name in own if kind.get(name) != own[name]]
    if other:
        raise InputError("snapshot", f"another {', '.join(other)}", "of the same task and options")


def _digest(values: tuple[Any, ...]) -> str:
    """A hash of plain data; of its repr, which unlike a pickle tells values, not identities."""
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        return hashlib.sha256(repr(values).encode()).hexdigest()
