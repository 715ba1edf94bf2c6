"""The Gymnasium environment."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym import kinematics
from tpm_gym.envs import checks, reports
from tpm_gym.envs.reports import Observation
from tpm_gym.errors import ConfigurationError, EpisodeError, ModeChangeError
from tpm_gym.mechanism.tree import DEFAULT_MOUNT
from tpm_gym.simulation.bullet.client import has_display
from tpm_gym.simulation.physics import CONTROL_PERIOD, Physics
from tpm_gym.simulation.randomisation import Randomisation
from tpm_gym.simulation.simulation import Simulation, Snapshot
from tpm_gym.simulation.state import State
from tpm_gym.tasks import task as tasks
from tpm_gym.tasks.control import make as make_control

__all__ = ["EnvSnapshot", "TPMEnv"]

Action = NDArray[Any]


@dataclass(frozen=True)
class EnvSnapshot:
    """Everything that the next steps of an unwrapped environment depend on."""

    simulation: Snapshot
    rng: dict[str, Any]
    goal: NDArray[np.float64]
    pending: tuple[NDArray[np.float64], ...]
    kind: tuple[str, Randomisation, Physics | None]


class TPMEnv(gym.Env[Observation, Action]):
    """A 3-translational parallel mechanism over a table.

    ## Ids

    ``TPM{Reach,PickAndPlace}{,Joints}{,Dense}-v0``: Cartesian or joint increments, sparse or dense
    reward. Control at 25 Hz, episodes of 50 steps, truncation only.

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
    | object_position | 3 | centre of the puck, from a camera |
    | object_offset | 3 | top of the puck minus lip of the cup |
    | object_velocity | 3 | velocity of the puck, from a camera |
    | object_tilt | 2 | x and y of the puck's axis |
    | holding | 1 | +1 if the cup holds the puck (vacuum gauge), else -1 |

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
    alone; ``train/her.py`` or ``copy_info_dict=True`` keep the other terms.

    ## Start

    The arm at rest at home, the puck (square, 36 mm wide, 30 mm high, 50 g) flat on the table, the
    goal at least 30 mm away from where the puck (or P) starts. Goals and objects are sampled where
    1/cond(J) >= 0.08.
    ``reset(options={"object": (x, y, z), "goal": (x, y, z)})`` chooses them instead; a puck that
    starts above the table falls.

    ## Info

    ``is_success`` (bool), ``closure_error`` (m), ``conditioning`` (1/cond(J) by the encoders),
    ``singularity_penalty`` (before weighting), ``assembly_mode_changed`` and
    ``working_mode_changed`` (bool), ``reward_terms`` (name -> value; they sum to the reward).
    Where the platform passes y = 0, a parallel one, the assembly mode changes and the encoders no
    longer tell where it is; past y = l7, a serial one, the working mode changes. No action of the
    nominal robot leads there; if it happens, ``info`` says so, with a penalty of 1 and truncation.

    Args:
        task: ``"reach"`` or ``"pick_and_place"``.
        control: ``"cartesian"`` or ``"joints"``.
        reward: ``"sparse"`` or ``"dense"``.
        penalty_weight: Weight of the singularity penalty; 0 switches it off.
        randomisation: What differs from the nominal machine, drawn anew for each episode: a
            :class:`~tpm_gym.simulation.randomisation.Randomisation` or a mapping of its attributes. Where
            disturbed encoders report angles that cannot be assembled, position and velocity keep
            their last values.
        physics: Numerical settings of the engine.
        render_mode: None, ``"rgb_array"`` or ``"human"``.
        renderer: ``"tiny"`` (any machine) or ``"egl"`` (GPU).
        width: Of rendered pictures, pixels.
        height: Of rendered pictures, pixels.

    Raises:
        ConfigurationError: If an option is out of range.

    ## Version history

    * v0: first release.
    """

    # Gymnasium declares this as an instance's, so it cannot be a ClassVar.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
        "render_fps": round(1 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        task: str = "reach",
        control: str = "cartesian",
        reward: str = "sparse",
        *,
        penalty_weight: float = 1.0,
        randomisation: Randomisation | Mapping[str, Any] | None = None,
        physics: Physics | None = None,
        render_mode: str | None = None,
        renderer: str = "tiny",
        width: int = 640,
        height: int = 480,
    ) -> None:
        """Check the options and start the simulation."""
        # Without a display PyBullet's window would end the process; offer what can be shown.
        modes = [mode for mode in self.metadata["render_modes"] if mode != "human" or has_display()]
        self.metadata = {**self.metadata, "render_modes": modes}
        if render_mode is not None and render_mode not in modes:
            valid = f"None, {', '.join(map(repr, modes))} ('human' needs a display)"
            raise ConfigurationError("render_mode", render_mode, valid)
        self.render_mode = render_mode
        self.penalty_weight = checks.weight(penalty_weight)
        self.task = tasks.make(task, reward)
        checks.physics(physics)
        self.control = make_control(control)
        self.randomisation = Randomisation.of(randomisation)
        self._size = checks.picture_size(width, height)
        self.observation_space = reports.observation_space(self.task)
        self.action_space = reports.box(1.0, self.task.action_size)
        self._home = kinematics.inverse(self.task.home)
        self._state: State | None = None
        self._goal = np.full(3, np.nan)
        self._pending: tuple[NDArray[np.float64], ...] = ()  # actions that come late
        self._closed = False
        self._shown = 0.0  # when the last frame was due, s of the performance counter
        self._physics, self._renderer = physics, renderer
        self._kind = (task, self.randomisation, physics)
        self.simulation = self._start()

    # -- the Gymnasium interface ----------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seeds the environment's rng; equal seeds give equal episodes.
            options: ``object`` and ``goal``, each (3,) m in the world frame, instead of sampled
                ones.

        Raises:
            ResetOptionError: If an option is unknown or not three finite numbers.
            UnreachableError: If the object or the goal is out of reach.
            EpisodeError: If the environment is closed.
        """
        self._require_open()
        super().reset(seed=seed)
        options = checks.reset_options(options)
        task, rng, start, goal = self.task, self.np_random, *map(options.get, ("object", "goal"))
        start = task.sample_object(rng) if start is None else task.check_object(start)
        goal = task.sample_goal(rng, start) if goal is None else task.check_goal(goal)
        plant = self.randomisation.draw(rng, len(self.simulation.mechanism.links) - 1)
        self._goal = goal
        self._pending = (np.zeros(task.action_size),) * self.randomisation.latency
        self._state = None
        self._state = self.simulation.reset(self._home, start, goal, plant, self._draw_noise())
        observation, info = self._report(self._state)
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
        """
        values = checks.action(action, self.task.action_size)
        state = self._require_state()
        queue = (*self._pending, values)
        values, self._pending = queue[0], queue[1:]
        command = self.control.command(values[:3], DEFAULT_MOUNT.to_paper(state.command))
        vacuum = len(values) > 3 and bool(values[3] > 0)
        self._state = None  # until the step has gone well
        try:
            self._state = self.simulation.move(command, vacuum, self._draw_noise())
        except ModeChangeError:
            self._state = state  # nothing has moved
            raise
        observation, info = self._report(self._state)
        reward = reports.reward(info, self.penalty_weight)
        if self.render_mode == "human":
            self.render()
        return observation, reward, False, self._state.mode_change is not None, info

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
            achieved_goal: (..., 3) m.
            desired_goal: (..., 3) m.
            info: The step's info, or one for each transition of the batch.

        Returns:
            A float, or (...,) of them.
        """
        goal_term = self.task.goal_term(achieved_goal, desired_goal)
        if isinstance(info, Mapping):
            other: Any = reports.goal_free_reward(info, self.penalty_weight)
        else:
            rest = [reports.goal_free_reward(entry, self.penalty_weight) for entry in info]
            other = np.array(rest).reshape(goal_term.shape)
        total = goal_term + other
        return float(total) if np.ndim(total) == 0 else total

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
        """Disconnect the simulation; harmless the second time."""
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
        return self._require_state()

    @property
    def goal(self) -> NDArray[np.float64]:
        """The episode's goal, (3,) m, world."""
        return np.array(self._goal)

    def save_state(self) -> EnvSnapshot:
        """Take down physics, rng, goal, commands and grasp; TimeLimit's count is not part of it.

        What follows, here or after :meth:`restore_state`, is equal to the last bit.

        Raises:
            EpisodeError: If there is no episode.
        """
        self._require_state()
        return EnvSnapshot(
            self.simulation.save(),
            dict(self.np_random.bit_generator.state),
            self._goal.copy(),
            self._pending,
            self._kind,
        )

    def restore_state(self, snapshot: EnvSnapshot) -> Observation:
        """Go back to a moment that :meth:`save_state` took down.

        Returns:
            The observation at that moment.

        Raises:
            EpisodeError: If the environment is closed.
            InputError: If the moment is none, or that of another kind of environment.
        """
        self._require_open()
        checks.snapshot(snapshot, EnvSnapshot, self._kind)
        self.np_random.bit_generator.state = snapshot.rng
        self._goal, self._pending = snapshot.goal.copy(), snapshot.pending
        self.simulation.show_goal(self._goal)
        self._state = self.simulation.restore(snapshot.simulation)
        return reports.observation(self.task, self._state, self._goal)

    # -- inside ---------------------------------------------------------------------------------

    def _require_open(self) -> None:
        if self._closed:
            raise EpisodeError("the environment is closed; make a new one")

    def _require_state(self) -> State:
        self._require_open()
        if self._state is None:
            raise EpisodeError("no episode is running; call reset() first")
        return self._state

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
            self.simulation.show_goal(self._goal)
            self._state = self.simulation.restore(snapshot)

    def _draw_noise(self) -> tuple[float, float, float]:
        """Errors of one reading of the encoders, rad."""
        if self.randomisation.encoder_noise == 0:
            return (0.0, 0.0, 0.0)
        a, b, c = self.np_random.normal(0.0, self.randomisation.encoder_noise, 3).tolist()
        return a, b, c

    def _report(self, state: State) -> tuple[Observation, dict[str, Any]]:
        observation = reports.observation(self.task, state, self._goal)
        return observation, reports.info(self.task, state, observation, self.penalty_weight)

    def _start(self) -> Simulation:
        return Simulation(
            self.task.scene,
            physics=self._physics,
            gui=self.render_mode == "human",
            renderer=self._renderer,
        )
