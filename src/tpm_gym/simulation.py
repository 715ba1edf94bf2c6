"""The mechanism in PyBullet: the only module that imports the engine.

The spanning tree is loaded from generated URDF; the loops are closed by point-to-point
constraints. A reset sets every joint, passive ones too, to the closed-form angles, so an episode
starts with the loops closed to better than a micrometre.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pybullet
from numpy.typing import ArrayLike, NDArray

from tpm_gym import jacobian, kinematics
from tpm_gym.cup import Cup, Pose
from tpm_gym.errors import (
    AssemblyModeError,
    ClosureError,
    ConfigurationError,
    SingularityError,
    UnreachableError,
)
from tpm_gym.geometry import PAPER, Geometry
from tpm_gym.mechanism import DEFAULT_MOUNT, Mount, build, joint_angles
from tpm_gym.physics import (
    ASSEMBLY_LIMIT,
    CLOSURE_LIMIT,
    GRAVITY,
    REGULARISATION,
    Physics,
    spline_weights,
)
from tpm_gym.robot import Robot
from tpm_gym.scenery import AT_REST, UPRIGHT, Scenery
from tpm_gym.state import Scene, State

__all__ = ["Simulation", "Snapshot", "has_display"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Snapshot:
    """Physics, commands and grasp of a :class:`Simulation` at one moment."""

    joints: tuple[tuple[float, float], ...]
    commands: FloatArray
    object_pose: Pose | None
    object_velocity: Pose | None
    grip: Pose | None


class _Client:
    """A private physics client: pybullet's functions with its number filled in.

    pybullet_utils' BulletClient looks every function up anew at every call, which costs as much as
    the cheaper calls themselves, and prints a line on connecting.
    """

    def __init__(self, mode: int) -> None:
        """Connect."""
        self._number = pybullet.connect(mode)
        if self._number < 0:
            raise ConfigurationError(
                "render_mode", "human", "None or 'rgb_array': no window opened"
            )

    def __getattr__(self, name: str) -> Any:
        """The engine's function of that name, bound to this client, or its constant."""
        value = getattr(pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self._number)
        setattr(self, name, value)
        return value

    def close(self) -> None:
        """Disconnect; harmless the second time."""
        if self._number >= 0:
            pybullet.disconnect(self._number)
            self._number = -1


class Simulation:
    """One robot over one table in one private physics client.

    Args:
        scene: What stands on the table besides the robot.
        geometry: Link lengths.
        mount: Where the base hangs.
        physics: Numerical settings.
        encoder_bias: (3,) rad, added to what the three encoders report.
        gui: Whether to open PyBullet's window.
        renderer: ``"tiny"`` draws on the CPU anywhere; ``"egl"`` on a GPU, where the driver has it.

    Raises:
        ConfigurationError: If an option is out of range, or EGL was asked for and is not there.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        geometry: Geometry = PAPER,
        mount: Mount = DEFAULT_MOUNT,
        physics: Physics | None = None,
        encoder_bias: ArrayLike = (0.0, 0.0, 0.0),
        gui: bool = False,
        renderer: str = "tiny",
    ) -> None:
        """Connect, load and close the loops."""
        self.scene, self.geometry, self.mount = scene, geometry, mount
        self.physics = Physics() if physics is None else physics
        self.mechanism = build(geometry)
        self._bias = _bias(encoder_bias)
        self._client = _Client(pybullet.GUI if gui else pybullet.DIRECT)
        try:
            self._renderer = _load_renderer(self._client, renderer)
            self._configure()
            self._robot = Robot(self._client, self.mechanism, mount)
            self._scenery = Scenery(self._client, scene)
            if gui:
                self._scenery.aim_window()
            if gui or renderer == "egl":
                self._robot.paint()
            self._cup: Cup | None = None
            if scene.puck is not None and self._scenery.puck is not None:
                self._cup = Cup(self._client, self._robot, self._scenery.puck, scene.puck)
        except BaseException:
            self.close()
            raise
        self._commands = np.zeros((2, 3))  # the last two, paper frame, m
        self._evaluation: jacobian.Evaluation | None = None  # the last one by the encoders
        self._spline = spline_weights(self.physics.substeps)

    # -- building ---------------------------------------------------------------------------

    def _configure(self) -> None:
        client = self._client
        client.setGravity(0.0, 0.0, -GRAVITY)
        client.setTimeStep(self.physics.time_step)
        client.setPhysicsEngineParameter(
            numSolverIterations=self.physics.iterations,
            erp=self.physics.erp,
            deterministicOverlappingPairs=1,
            globalCFM=REGULARISATION,
        )
        if self.physics.solver == "direct":
            with _silence():
                client.setPhysicsEngineParameter(
                    constraintSolverType=pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
                )
        client.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0)  # no side panels

    # -- running ----------------------------------------------------------------------------

    def reset(
        self,
        theta: ArrayLike,
        object_position: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> State:
        """Put everything at rest: the arms at ``theta``, the loops closed, the object upright.

        Args:
            theta: (3,) rad.
            object_position: (3,) m, world; centre of the object. Ignored without an object.
            goal: (3,) m, world; where the goal marker stands.

        Raises:
            InputError: If theta has the wrong shape or is not finite.
            UnreachableError: If the mechanism cannot be assembled at theta.
        """
        angles = joint_angles(theta, geometry=self.geometry)
        self._let_go()
        self._evaluation = None
        self._robot.place(angles)
        self._commands = np.tile(kinematics.forward(theta, geometry=self.geometry), (2, 1))
        if object_position is not None:
            position = np.asarray(object_position, dtype=np.float64).tolist()
            self._scenery.place_puck((position, UPRIGHT), AT_REST)
        if goal is not None:
            self.show_goal(goal)
        return self.read()

    def show_goal(self, goal: ArrayLike) -> None:
        """Move the goal marker to ``goal`` (3,) m, world."""
        self._scenery.move_marker(np.asarray(goal, dtype=np.float64).tolist())

    def move(self, command: ArrayLike, vacuum: bool = False) -> State:
        """Command point P to ``command`` and run one control period.

        The motors follow a quadratic B-spline through the commands: it lags the commands by half a
        period, stays in their convex hull, and keeps the accelerations finite. It is a curve of
        point P, not of the joints: near a singularity, a straight line between two postures would
        wander by centimetres.

        Args:
            command: (3,) m, paper frame; inside the region (the caller projects).
            vacuum: Whether the cup sucks.

        Raises:
            UnreachableError: If the command is out of reach; nothing has moved then.
            ClosureError: If a loop opened.
            AssemblyModeError: If the mechanism went through a parallel singularity.
        """
        controls = np.vstack([self._commands, np.asarray(command, dtype=np.float64)])
        references = kinematics.inverse(self._spline @ controls, geometry=self.geometry)
        self._commands = controls[1:]
        if not vacuum:
            self._let_go()
        for theta in references.tolist():
            self._robot.drive(theta)
            self._client.stepSimulation()
        if vacuum and self._cup is not None:
            self._cup.suck()
        state = self.read()
        self._check(state)
        return state

    def read(self) -> State:
        """Read the encoders, what follows from them, and the truth.

        Raises:
            AssemblyModeError: If no assembly in the default mode explains the encoders.
        """
        angles, rates = self._robot.encoders()
        theta, theta_dot = np.array(angles) + self._bias, np.array(rates)
        gap, platform, tilt = self._robot.truth()
        at = self._evaluate(theta)
        position, quaternion, velocity, spin = self._scenery.puck_state()
        return State(
            theta=theta,
            theta_dot=theta_dot,
            fk_position=self.mount.to_world(at.position),
            fk_velocity=self.mount.rotate(at.velocity @ theta_dot),
            conditioning=float(at.conditioning),
            platform_position=np.array(platform),
            platform_tilt=tilt,
            closure_error=gap,
            command=self.mount.to_world(self._commands[1]),
            holding=self._cup is not None and self._cup.grip is not None,
            object_position=position,
            object_quaternion=quaternion,
            object_velocity=velocity,
            object_angular_velocity=spin,
        )

    def _evaluate(self, theta: FloatArray) -> jacobian.Evaluation:
        """Position and Jacobian by the encoders; the last ones where the encoders make no sense.

        That is what a controller can do whose biased encoders report angles at which no assembly
        exists, as happens near the edges of the workspace.
        """
        try:
            self._evaluation = jacobian.evaluate(theta, geometry=self.geometry)
        except (UnreachableError, SingularityError) as error:
            if not self._bias.any():
                raise AssemblyModeError(float("inf"), ASSEMBLY_LIMIT) from error
            if self._evaluation is None:
                valid = "a bias with which the mechanism can be assembled at the start"
                raise ConfigurationError("encoder_bias", self._bias.tolist(), valid) from error
        return self._evaluation

    def _check(self, state: State) -> None:
        # "not <=" so that a NaN fails too
        if not state.closure_error <= CLOSURE_LIMIT:
            raise ClosureError(float(state.closure_error), CLOSURE_LIMIT)
        expected = state.fk_position
        if self._bias.any():
            try:
                true_point = kinematics.forward(state.theta - self._bias, geometry=self.geometry)
            except UnreachableError as error:
                raise AssemblyModeError(float("inf"), ASSEMBLY_LIMIT) from error
            expected = self.mount.to_world(true_point)
        apart = float(np.linalg.norm(state.platform_position - expected))
        if not apart <= ASSEMBLY_LIMIT:
            raise AssemblyModeError(apart, ASSEMBLY_LIMIT)

    def _let_go(self) -> None:
        if self._cup is not None:
            self._cup.let_go()

    # -- state, pictures, end -----------------------------------------------------------------

    def save(self) -> Snapshot:
        """Take down everything that the physics depend on, and go on from exactly that.

        The engine keeps memories that cannot be read out, such as the impulses of old contacts. So
        that what follows here and what follows a :meth:`restore` are equal to the last bit, they
        are dropped here too.
        """
        pose, velocity = self._scenery.puck_pose()
        snapshot = Snapshot(
            joints=self._robot.joint_states(),
            commands=self._commands.copy(),
            object_pose=pose,
            object_velocity=velocity,
            grip=self._cup.grip if self._cup is not None else None,
        )
        self.restore(snapshot)
        return snapshot

    def restore(self, snapshot: Snapshot) -> State:
        """Go back to a moment that :meth:`save` took down, of this or an equal simulation."""
        self._let_go()
        self._robot.set_joint_states(snapshot.joints)
        self._commands = snapshot.commands.copy()
        if snapshot.object_pose is not None and snapshot.object_velocity is not None:
            self._scenery.place_puck(snapshot.object_pose, snapshot.object_velocity)
        if snapshot.grip is not None and self._cup is not None:
            self._cup.take(snapshot.grip)
        return self.read()

    def render(self, width: int, height: int) -> NDArray[np.uint8]:
        """Draw the scene as (height, width, 3) RGB."""
        return self._scenery.picture(width, height, self._renderer)

    def close(self) -> None:
        """Disconnect the client; harmless the second time."""
        self._client.close()


@contextmanager
def _silence() -> Iterator[None]:
    """Keep what the engine says (from C, on changing its solver) out of the user's output."""
    if os.name != "posix":
        yield
        return
    flush = ctypes.CDLL(None).fflush
    sys.stdout.flush()
    flush(None)
    ours, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
        flush(None)
    finally:
        os.dup2(ours, 1)
        os.close(ours)
        os.close(nowhere)


def has_display() -> bool:
    """Whether PyBullet can open a window here (on Linux it needs an X server)."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def _bias(value: ArrayLike) -> FloatArray:
    try:
        bias = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigurationError("encoder_bias", value, "three finite angles in rad") from error
    if bias.shape != (3,) or not np.isfinite(bias).all():
        raise ConfigurationError("encoder_bias", value, "three finite angles in rad")
    return bias


def _load_renderer(client: _Client, renderer: str) -> int:
    """The engine's number of the renderer; loads the EGL plugin if that was asked for."""
    if renderer == "tiny":
        return int(pybullet.ER_TINY_RENDERER)
    if renderer != "egl":
        raise ConfigurationError("renderer", renderer, "'tiny' or 'egl'")
    spec = importlib.util.find_spec("eglRenderer")
    if spec is None or client.loadPlugin(spec.origin, "_eglRendererPlugin") < 0:
        raise ConfigurationError("renderer", renderer, "'tiny': this machine has no EGL renderer")
    return int(pybullet.ER_BULLET_HARDWARE_OPENGL)
