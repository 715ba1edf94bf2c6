"""The mechanism in PyBullet: the only module that imports the engine.

The spanning tree is loaded from generated URDF; the loops are closed by point-to-point
constraints. A reset sets every joint, passive ones too, to the closed-form angles, so an episode
starts with the loops closed to better than a micrometre.
"""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
from numpy.typing import ArrayLike, NDArray

from tpm_gym import jacobian, kinematics, urdf
from tpm_gym.errors import (
    AssemblyModeError,
    ClosureError,
    ConfigurationError,
    SingularityError,
    UnreachableError,
)
from tpm_gym.geometry import PAPER, Geometry
from tpm_gym.mechanism import (
    ACTUATED_JOINTS,
    CUP_RADIUS,
    DEFAULT_MOUNT,
    MOTOR_EFFORT,
    Mechanism,
    Mount,
    build,
    joint_angles,
)
from tpm_gym.state import Scene, State

__all__ = ["Physics", "Simulation", "Snapshot", "has_display"]

FloatArray = NDArray[np.float64]

GRAVITY = 9.81  # m/s^2
MOTOR_GAIN = 1.0
"""Share of the position error that a motor takes out in one time step, effort permitting."""
PULL_OFF_FORCE = 12.0
"""Largest force that the cup holds, N: 60 kPa of vacuum on the area of the lip."""
SEAL_GAP = 0.002
"""Largest gap between lip and object that the vacuum closes, m."""
SEAL_TILT = np.deg2rad(10.0)
"""Largest angle between the cup's axis and the object's that the lip follows, rad."""
CLOSURE_LIMIT = 0.005
"""A loop that is open by more than this is lost, m."""
ASSEMBLY_LIMIT = 0.010
"""Platform against forward kinematics: farther apart, the mechanism is assembled otherwise, m."""

_NO_OBJECT = np.full(3, np.nan)


@dataclass(frozen=True)
class Physics:
    """Numerical settings of the engine.

    Attributes:
        time_step: s.
        iterations: Iterations of the sequential-impulse solver a step.
        erp: Share of a constraint's error that is taken out in one step, in (0, 1].
        control_period: s between two commands; a whole number of time steps.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    time_step: float = 1 / 500
    iterations: int = 50
    erp: float = 0.8
    control_period: float = 1 / 25

    def __post_init__(self) -> None:
        """Reject settings that cannot work."""
        if not 0 < self.time_step <= self.control_period:
            valid = f"0 < time_step <= control_period = {self.control_period}"
            raise ConfigurationError("time_step", self.time_step, valid)
        ratio = self.control_period / self.time_step
        if abs(ratio - round(ratio)) > 1e-6:
            valid = f"a whole fraction of control_period = {self.control_period}"
            raise ConfigurationError("time_step", self.time_step, valid)
        if self.iterations < 1:
            raise ConfigurationError("iterations", self.iterations, "1 or more")
        if not 0 < self.erp <= 1:
            raise ConfigurationError("erp", self.erp, "0 < erp <= 1")

    @property
    def substeps(self) -> int:
        """Time steps in a control period."""
        return round(self.control_period / self.time_step)


@dataclass(frozen=True)
class Snapshot:
    """Physics, commands and grasp of a :class:`Simulation` at one moment."""

    joints: tuple[tuple[float, float], ...]
    commands: FloatArray
    object_pose: tuple[tuple[float, ...], tuple[float, ...]] | None
    object_velocity: tuple[tuple[float, ...], tuple[float, ...]] | None
    grasp: tuple[tuple[float, ...], tuple[float, ...]] | None


class _Client:
    """A private physics client: pybullet's functions with its number filled in.

    pybullet_utils' BulletClient looks every function up anew at every call, which costs as much as
    the cheaper calls themselves, and prints a line on connecting.
    """

    def __init__(self, mode: int) -> None:
        """Connect."""
        self._number = pybullet.connect(mode)

    def __getattr__(self, name: str) -> Any:
        """The engine's function of that name, bound to this client and remembered."""
        function = partial(getattr(pybullet, name), physicsClientId=self._number)
        setattr(self, name, function)
        return function

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
        self.physics = physics or Physics()
        self.mechanism: Mechanism = build(geometry)
        self._bias = _bias(encoder_bias)
        self._client = _Client(pybullet.GUI if gui else pybullet.DIRECT)
        try:
            self._renderer = _load_renderer(self._client, renderer)
            self._configure()
            self._load_robot()
            self._load_scene()
        except BaseException:
            self.close()
            raise
        self._commands = np.zeros((2, 3))
        self._grasp: tuple[int, Any] | None = None
        self._spline = _spline_weights(self.physics.substeps)

    # -- building ---------------------------------------------------------------------------

    def _configure(self) -> None:
        client = self._client
        client.setGravity(0.0, 0.0, -GRAVITY)
        client.setTimeStep(self.physics.time_step)
        client.setPhysicsEngineParameter(
            numSolverIterations=self.physics.iterations,
            erp=self.physics.erp,
            deterministicOverlappingPairs=1,
        )
        for flag in (pybullet.COV_ENABLE_GUI, pybullet.COV_ENABLE_SHADOWS):
            client.configureDebugVisualizer(flag, 0)

    def _load_robot(self) -> None:
        client = self._client
        with tempfile.TemporaryDirectory() as folder:
            path, _ = urdf.write(Path(folder), self.mechanism)
            self._robot = client.loadURDF(
                str(path),
                basePosition=self.mount.to_world((0.0, 0.0, 0.0)).tolist(),
                baseOrientation=self.mount.quaternion,
                useFixedBase=True,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
            )
        self._joints: dict[str, int] = {}
        self._links: dict[str, int] = {}
        for index in range(client.getNumJoints(self._robot)):
            info = client.getJointInfo(self._robot, index)
            self._joints[info[1].decode()] = index
            self._links[info[12].decode()] = index
            # PyBullet adds damping to everything and a motor to every joint; we want neither.
            client.changeDynamics(
                self._robot, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0
            )
            client.setJointMotorControl2(
                self._robot, index, pybullet.VELOCITY_CONTROL, force=0.0
            )
        self._motors = [self._joints[name] for name in ACTUATED_JOINTS]
        self._close_loops()

    def _close_loops(self) -> None:
        """Close the loops; the engine wants pivots relative to the centres of mass."""
        names: list[str] = []
        ends = []
        for closure in self.mechanism.closures:
            pivots = []
            for name, point in (
                (closure.link_a, closure.point_a),
                (closure.link_b, closure.point_b),
            ):
                pivots.append(np.asarray(point) - self.mechanism.link(name).centre_of_mass)
                if name not in names:
                    names.append(name)
                ends.append((names.index(name), point))
            constraint = self._client.createConstraint(
                self._robot,
                self._links[closure.link_a],
                self._robot,
                self._links[closure.link_b],
                pybullet.JOINT_POINT2POINT,
                (0.0, 0.0, 0.0),
                pivots[0].tolist(),
                pivots[1].tolist(),
            )
            self._client.changeConstraint(constraint, maxForce=1e6)
        names.append(self.mechanism.platform)
        self._watched = [self._links[name] for name in names]
        self._end_link = np.array([index for index, _ in ends] + [len(names) - 1])
        self._end_point = np.array([point for _, point in ends] + [self.mechanism.point_p])

    def _load_scene(self) -> None:
        client = self._client
        self._table = _add_box(client, (0.45, 0.30, 0.02), (0.0, 0.0, -0.02), (0.86, 0.84, 0.80, 1))
        self._floor = _add_box(client, (2.0, 2.0, 0.02), (0.0, 0.0, -0.52), (0.70, 0.72, 0.75, 1))
        self._marker = client.createMultiBody(
            baseVisualShapeIndex=client.createVisualShape(
                pybullet.GEOM_SPHERE, radius=self.scene.marker_radius, rgbaColor=(0.1, 0.8, 0.2, 0.6)
            )
        )
        self._object: int | None = None
        puck = self.scene.puck
        if puck is not None:
            size = {"radius": puck.radius}
            colour = (0.15, 0.55, 0.85, 1.0)
            self._object = client.createMultiBody(
                baseMass=puck.mass,
                baseCollisionShapeIndex=client.createCollisionShape(
                    pybullet.GEOM_CYLINDER, height=puck.height, **size
                ),
                baseVisualShapeIndex=client.createVisualShape(
                    pybullet.GEOM_CYLINDER, length=puck.height, rgbaColor=colour, **size
                ),
                basePosition=(0.0, 0.0, puck.height / 2),
            )
            client.changeDynamics(
                self._object,
                -1,
                lateralFriction=puck.friction,
                spinningFriction=0.002,
                rollingFriction=0.0005,
                linearDamping=0.0,
                angularDamping=0.0,
            )
            # The engine multiplies the friction of both bodies.
            client.changeDynamics(self._table, -1, lateralFriction=1.0)

    # -- running ----------------------------------------------------------------------------

    def reset(
        self, theta: ArrayLike, object_position: ArrayLike | None = None, goal: ArrayLike | None = None
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
        for name, angle in angles.items():
            self._client.resetJointState(self._robot, self._joints[name], angle, 0.0)
        self._commands = np.tile(kinematics.forward(theta, geometry=self.geometry), (2, 1))
        if self._object is not None and object_position is not None:
            self._place_object(np.asarray(object_position, dtype=np.float64).tolist())
        if goal is not None:
            self.show_goal(goal)
        return self.read()

    def _place_object(self, position: list[float]) -> None:
        """Put the object down with no memory of old contacts (the engine warm-starts them)."""
        upright = (0.0, 0.0, 0.0, 1.0)
        for place in ((0.0, 0.0, 5.0), position):
            self._client.resetBasePositionAndOrientation(self._object, place, upright)
            self._client.resetBaseVelocity(self._object, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            self._client.performCollisionDetection()

    def show_goal(self, goal: ArrayLike) -> None:
        """Move the goal marker to ``goal`` (3,) m, world."""
        position = np.asarray(goal, dtype=np.float64).tolist()
        self._client.resetBasePositionAndOrientation(self._marker, position, (0.0, 0.0, 0.0, 1.0))

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
        client, robot, motors = self._client, self._robot, self._motors
        forces, gains = [MOTOR_EFFORT] * 3, [MOTOR_GAIN] * 3
        for angles in references.tolist():
            client.setJointMotorControlArray(
                robot,
                motors,
                pybullet.POSITION_CONTROL,
                targetPositions=angles,
                forces=forces,
                positionGains=gains,
            )
            client.stepSimulation()
        if vacuum:
            self._hold_or_seal()
        state = self.read()
        self._check(state)
        return state

    def read(self) -> State:
        """Read the encoders and the truth."""
        motors = self._client.getJointStates(self._robot, self._motors)
        theta = np.array([motor[0] for motor in motors]) + self._bias
        theta_dot = np.array([motor[1] for motor in motors])
        gap, platform, tilt = self._measure()
        try:
            at = jacobian.evaluate(theta, geometry=self.geometry)
        except (UnreachableError, SingularityError) as error:
            # Encoders that no assembly explains: the mechanism has left the one we know.
            raise AssemblyModeError(float("inf"), ASSEMBLY_LIMIT) from error
        position, quaternion, velocity, spin = self._object_state()
        return State(
            theta=theta,
            theta_dot=theta_dot,
            fk_position=self.mount.to_world(at.position),
            fk_velocity=self.mount.rotate(at.velocity @ theta_dot),
            conditioning=float(at.conditioning),
            platform_position=platform,
            platform_tilt=tilt,
            closure_error=gap,
            command=self.mount.to_world(self._commands[1]),
            holding=self._grasp is not None,
            object_position=position,
            object_quaternion=quaternion,
            object_velocity=velocity,
            object_angular_velocity=spin,
        )

    def _measure(self) -> tuple[float, FloatArray, float]:
        """Largest loop gap (m), true platform position (m, world), platform tilt (rad)."""
        states = self._client.getLinkStates(
            self._robot, self._watched, computeForwardKinematics=True
        )
        origins = np.array([state[4] for state in states])
        rotations = _rotations(np.array([state[5] for state in states]))
        points = origins[self._end_link] + np.einsum(
            "nij,nj->ni", rotations[self._end_link], self._end_point
        )
        gaps = points[0:-1:2] - points[1:-1:2]
        # The platform's frame should stand as the base's does: a half turn about x.
        trace = float(rotations[-1, 0, 0] - rotations[-1, 1, 1] - rotations[-1, 2, 2])
        tilt = float(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)))
        return float(np.sqrt((gaps**2).sum(axis=1).max())), points[-1], tilt

    def _object_state(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        if self._object is None:
            return _NO_OBJECT, np.full(4, np.nan), _NO_OBJECT, _NO_OBJECT
        position, quaternion = self._client.getBasePositionAndOrientation(self._object)
        velocity, spin = self._client.getBaseVelocity(self._object)
        return np.array(position), np.array(quaternion), np.array(velocity), np.array(spin)

    def _check(self, state: State) -> None:
        # "not <=" so that a NaN fails too
        if not state.closure_error <= CLOSURE_LIMIT:
            raise ClosureError(float(state.closure_error), CLOSURE_LIMIT)
        true_fk = state.fk_position
        if self._bias.any():
            true_theta = state.theta - self._bias
            true_fk = self.mount.to_world(kinematics.forward(true_theta, geometry=self.geometry))
        apart = float(np.linalg.norm(state.platform_position - true_fk))
        if not apart <= ASSEMBLY_LIMIT:
            raise AssemblyModeError(apart, ASSEMBLY_LIMIT)

    # -- vacuum cup -------------------------------------------------------------------------

    @property
    def holding(self) -> bool:
        """Whether the cup holds the object."""
        return self._grasp is not None

    def _cup_pose(self) -> tuple[FloatArray, FloatArray]:
        """Centre of the lip (m) and outward axis of the cup, world."""
        state = self._client.getLinkState(
            self._robot, self._links[self.mechanism.platform], computeForwardKinematics=True
        )
        rotation = _rotations(np.array([state[5]]))[0]
        return np.array(state[4]) + rotation @ np.array(self.mechanism.cup), rotation[:, 2]

    def _hold_or_seal(self) -> None:
        """With the vacuum on: drop an object that was pulled off, take one that is touched."""
        if self._object is None or self.scene.puck is None:
            return
        lip, axis = self._cup_pose()
        position, quaternion = self._client.getBasePositionAndOrientation(self._object)
        rotation = _rotations(np.array([quaternion]))[0]
        local = rotation.T @ (lip - np.array(position))  # lip in the object's frame
        gap = float(local[2]) - self.scene.puck.height / 2
        offset = float(np.hypot(local[0], local[1]))
        aligned = float(-rotation[:, 2] @ axis) >= np.cos(SEAL_TILT)
        covered = offset <= self.scene.puck.radius - CUP_RADIUS
        sealed = abs(gap) <= SEAL_GAP and covered and aligned
        if self._grasp is not None and not sealed:
            self._let_go()
        elif self._grasp is None and sealed:
            self._take()

    def _take(self, relative: Any = None) -> None:
        """Fix the object to the platform at its present (or the given) relative pose."""
        platform = self._links[self.mechanism.platform]
        if relative is None:
            state = self._client.getLinkState(
                self._robot, platform, computeForwardKinematics=True
            )
            inverse = self._client.invertTransform(state[0], state[1])
            pose = self._client.getBasePositionAndOrientation(self._object)
            relative = self._client.multiplyTransforms(*inverse, *pose)
        constraint = self._client.createConstraint(
            self._robot,
            platform,
            self._object,
            -1,
            pybullet.JOINT_FIXED,
            (0.0, 0.0, 0.0),
            relative[0],
            (0.0, 0.0, 0.0),
            relative[1],
        )
        # Beyond this force the constraint yields, the lip lifts off, and the next check lets go.
        self._client.changeConstraint(constraint, maxForce=PULL_OFF_FORCE)
        self._collide_with_cup(False)
        self._grasp = (constraint, relative)

    def _let_go(self) -> None:
        if self._grasp is not None:
            self._client.removeConstraint(self._grasp[0])
            self._collide_with_cup(True)
            self._grasp = None

    def _collide_with_cup(self, enable: bool) -> None:
        # Contact and vacuum would fight over the same surface.
        self._client.setCollisionFilterPair(
            self._robot, self._object, self._links[self.mechanism.platform], -1, int(enable)
        )

    # -- state, pictures, end -----------------------------------------------------------------

    def save(self) -> Snapshot:
        """Take down everything that the physics depend on."""
        joints = self._client.getJointStates(self._robot, range(len(self._joints)))
        with_object = self._object is not None
        return Snapshot(
            joints=tuple((joint[0], joint[1]) for joint in joints),
            commands=self._commands.copy(),
            object_pose=self._client.getBasePositionAndOrientation(self._object)
            if with_object
            else None,
            object_velocity=self._client.getBaseVelocity(self._object) if with_object else None,
            grasp=self._grasp[1] if self._grasp is not None else None,
        )

    def restore(self, snapshot: Snapshot) -> State:
        """Go back to a moment that :meth:`save` took down, of this or an equal simulation."""
        self._let_go()
        for index, (angle, rate) in enumerate(snapshot.joints):
            self._client.resetJointState(self._robot, index, angle, rate)
        self._commands = snapshot.commands.copy()
        if snapshot.object_pose is not None and snapshot.object_velocity is not None:
            self._place_object(list(snapshot.object_pose[0]))
            self._client.resetBasePositionAndOrientation(self._object, *snapshot.object_pose)
            self._client.resetBaseVelocity(self._object, *snapshot.object_velocity)
        if snapshot.grasp is not None:
            self._take(snapshot.grasp)
        return self.read()

    def render(self, width: int, height: int) -> NDArray[np.uint8]:
        """Draw the scene as (height, width, 3) RGB."""
        view = self._client.computeViewMatrixFromYawPitchRoll(
            cameraTargetPosition=(-0.02, 0.0, 0.42),
            distance=1.75,
            yaw=32.0,
            pitch=-14.0,
            roll=0.0,
            upAxisIndex=2,
        )
        projection = self._client.computeProjectionMatrixFOV(
            fov=42.0, aspect=width / height, nearVal=0.1, farVal=6.0
        )
        image = self._client.getCameraImage(
            width,
            height,
            viewMatrix=view,
            projectionMatrix=projection,
            lightDirection=(1.0, -1.2, 2.5),
            shadow=1,
            renderer=self._renderer,
        )
        pixels = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)
        return pixels[..., :3].copy()

    def close(self) -> None:
        """Disconnect the client; harmless if it is disconnected already."""
        self._client.close()


def has_display() -> bool:
    """Whether PyBullet can open a window here (on Linux it needs an X server)."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def _bias(value: ArrayLike) -> FloatArray:
    bias = np.asarray(value, dtype=np.float64)
    if bias.shape != (3,) or not np.isfinite(bias).all():
        raise ConfigurationError("encoder_bias", value, "three finite angles in rad")
    return bias


def _spline_weights(substeps: int) -> FloatArray:
    """(substeps, 3) weights of the last three commands along the quadratic B-spline."""
    s = np.arange(1, substeps + 1) / substeps
    return np.stack([(1 - s) ** 2, 1 + 2 * s - 2 * s**2, s**2], axis=1) / 2


def _rotations(quaternions: FloatArray) -> FloatArray:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4), (x, y, z, w)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _add_box(
    client: _Client,
    half: tuple[float, float, float],
    centre: tuple[float, float, float],
    colour: tuple[float, float, float, float],
) -> int:
    """A static box."""
    body: int = client.createMultiBody(
        baseCollisionShapeIndex=client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half),
        baseVisualShapeIndex=client.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=half, rgbaColor=colour
        ),
        basePosition=centre,
    )
    return body


def _load_renderer(client: _Client, renderer: str) -> int:
    """The engine's number of the renderer; loads the EGL plugin if that was asked for."""
    if renderer == "tiny":
        return int(pybullet.ER_TINY_RENDERER)
    if renderer != "egl":
        raise ConfigurationError("renderer", renderer, "'tiny' or 'egl'")
    import importlib.util

    spec = importlib.util.find_spec("eglRenderer")
    if spec is None or client.loadPlugin(spec.origin, "_eglRendererPlugin") < 0:
        raise ConfigurationError("renderer", renderer, "'tiny': this machine has no EGL renderer")
    return int(pybullet.ER_BULLET_HARDWARE_OPENGL)
