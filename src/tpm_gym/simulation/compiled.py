"""Compiled loops over robots, used with all engines. Importing this module imports Numba."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.compiling import compilable, compiled, kept
from tpm_gym.simulation.drives import References
from tpm_gym.simulation.engine import transform
from tpm_gym.simulation.vectors import (
    cross,
    dot,
    inverted,
    length,
    onto,
    page_row,
    plus,
    put_page_row,
    row_of,
    spread,
    three,
)


@kept
def all_within(points: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Return whether all n points (n, 3) lie in the box from ``low`` (3,) to ``high`` (3,).

    A point with NaN lies outside.
    """
    for row in range(len(points)):
        for axis in range(3):
            if not low[axis] <= points[row, axis] <= high[axis]:
                return False
    return True


@kept
def shifted(
    points: FloatArray, parts: FloatArray, step: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return points + parts * step, projected into the box from ``low`` to ``high``.

    Args:
        points: (n, 3), n points.
        parts: (n, 3), for each point the factors of ``step`` along the three axes.
        step: (3,), displacement along each axis for a factor of 1.
        low: (3,), lower corner of the box.
        high: (3,), upper corner of the box.
    """
    moved = np.empty_like(points)
    for row in range(len(points)):
        for axis in range(3):
            there = points[row, axis] + parts[row, axis] * step[axis]
            moved[row, axis] = min(max(there, low[axis]), high[axis])
    return moved


@kept
def bounded(
    observed: FloatArray, bound: float, achieved: FloatArray, goal_bound: float, goals: FloatArray
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], bool]:
    """Clip ``observed`` to +-``bound`` and ``achieved`` to +-``goal_bound``.

    Returns:
        Three arrays in float32: clipped ``observed``, clipped ``achieved``, and ``goals``. A bool:
        whether ``observed`` and ``achieved`` have no NaN.
    """
    first = np.empty(observed.shape, np.float32)
    second, third = np.empty(achieved.shape, np.float32), np.empty(goals.shape, np.float32)
    sound = True
    for row in range(len(observed)):
        for k in range(observed.shape[1]):
            first[row, k] = min(max(observed[row, k], -bound), bound)
            sound &= observed[row, k] == observed[row, k]
        for k in range(achieved.shape[1]):
            second[row, k] = min(max(achieved[row, k], -goal_bound), goal_bound)
            sound &= achieved[row, k] == achieved[row, k]
            third[row, k] = goals[row, k]
    return first, second, third, sound


@kept
def in_world(
    position: FloatArray,
    jacobian: FloatArray,
    theta_dot: FloatArray,
    commands: FloatArray,
    quaternion: FloatArray,
    left: NDArray[np.int8],
    mode_left: NDArray[np.int8],
    gap: FloatArray,
    limit: float,
    turn: FloatArray,
    origin: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray, BoolArray, bool]:
    """Convert P, its velocity and its command to the world frame, and check modes and loops.

    Also compute the z axes of the objects.

    Args:
        position: (n, 3) m, point P, machine's frame.
        jacobian: (n, 3, 3) m/rad.
        theta_dot: (n, 3) rad/s.
        commands: (n, 3, 3) m, machine's frame; commands[:, 1] is converted.
        quaternion: (n, k, 4), orientations of the objects, world.
        left: (n,) mode that each robot has left, as the engine reports it: 0 none, 1 assembly, 2
            working.
        mode_left: (n,) first mode that each robot has left in its episode, coded as in ``left``;
            changed: an entry that is 0 is replaced with the robot's entry in ``left``.
        gap: (n,) m, largest gap of each robot. If it is above ``limit`` or NaN, a loop is open.
        limit: Largest allowed gap, m.
        turn: (3,) signs (1 or -1). The components of a vector in the machine's frame times these
            signs are its components in the world frame.
        origin: (3,) m, origin of the machine's frame in the world frame.

    Returns:
        Four arrays in the world frame: P (n, 3) m, velocity of P (n, 3) m/s, command (n, 3) m, and
        z axes (n, k, 3) of the objects. Two arrays (n,): whether the assembly mode was left, and
        whether the working mode was left. A bool: whether all loops are closed.
    """
    place, speed = np.empty_like(position), np.empty_like(position)
    wanted, axes = np.empty_like(position), np.empty((*quaternion.shape[:2], 3))
    assembly, working = np.empty(len(position), np.bool_), np.empty(len(position), np.bool_)
    closed = True
    for row in range(len(position)):
        closed &= gap[row] <= limit
        if mode_left[row] == 0:
            mode_left[row] = left[row]
        assembly[row], working[row] = mode_left[row] == 1, mode_left[row] == 2
        for i in range(3):
            place[row, i] = turn[i] * position[row, i] + origin[i]
            wanted[row, i] = turn[i] * commands[row, 1, i] + origin[i]
            rate = 0.0
            for k in range(3):
                rate += jacobian[row, i, k] * theta_dot[row, k]
            speed[row, i] = turn[i] * rate
        for item in range(quaternion.shape[1]):
            x, y, z, w = quaternion[row, item]
            axes[row, item, 0] = 2 * (x * z + w * y)
            axes[row, item, 1] = 2 * (y * z - w * x)
            axes[row, item, 2] = 1 - 2 * (x * x + y * y)
    return place, speed, wanted, axes, assembly, working, closed


@kept
def measured(
    position: FloatArray,
    velocity: FloatArray,
    command: FloatArray,
    places: FloatArray,
    axes: FloatArray,
    velocities: FloatArray,
    held: IntArray,
    vacuum: FloatArray,
    lip: FloatArray,
    halves: FloatArray,
    most: float,
) -> FloatArray:
    """Return measurements of n robots and their k objects by encoders, camera and vacuum gauge.

    Positions, velocities and axes are in the world frame.

    Args:
        position: (n, 3) m, point P.
        velocity: (n, 3) m/s, velocity of P.
        command: (n, 3) m, commanded P.
        places: (n, k, 3) m, centres of the objects.
        axes: (n, k, 3), z axes of the objects.
        velocities: (n, k, 3) m/s, velocities of the objects' centres.
        held: (n,) index of the object in the cup; -1 for none.
        vacuum: (n,) Pa.
        lip: (3,) m, vector from the lip of the cup to P.
        halves: (k,) m, half heights of the objects.
        most: Largest vacuum, Pa.

    Returns:
        (n, 9 + 12 k): position of P, velocity of P, command minus position; then for each object:
        its centre, the vector from the lip to the middle of the object's top, the object's
        velocity, the x and y components of the object's z axis, and vacuum / most if the object is
        held, else 0.
    """
    values = np.empty((len(position), 9 + 12 * len(halves)))
    for row in range(len(position)):
        for i in range(3):
            values[row, i] = position[row, i]
            values[row, 3 + i] = velocity[row, i]
            values[row, 6 + i] = command[row, i] - position[row, i]
        for item in range(len(halves)):
            own = values[row, 9 + 12 * item :]
            for i in range(3):
                place, axis = places[row, item, i], axes[row, item, i]
                own[i] = place
                own[3 + i] = place + axis * halves[item] - (position[row, i] - lip[i])
                own[6 + i] = velocities[row, item, i]
            own[9], own[10] = axes[row, item, 0], axes[row, item, 1]
            own[11] = vacuum[row] / most if held[row] == item else 0.0
    return values


@kept
def normalise(values: FloatArray, centre: FloatArray, scale: FloatArray) -> None:
    """Replace values (n, k) by (values - centre) / scale, for centre and scale (k,)."""
    for row in range(len(values)):
        for k in range(len(centre)):
            values[row, k] = (values[row, k] - centre[k]) / scale[k]


@kept
def distances(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return the Euclidean distances (n,) between rows of two arrays (n, k)."""
    found = np.empty(len(points))
    for row in range(len(points)):
        squared = 0.0
        for k in range(points.shape[1]):
            squared += (points[row, k] - others[row, k]) ** 2
        found[row] = np.sqrt(squared)
    return found


@kept
def any_outside(places: FloatArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return for each row whether one of its places is outside the box for this place, (n,).

    A place with NaN is outside.

    Args:
        places: (n, k, 3), k places in each row. Box i is for place i of every row.
        low: (k, 3), lowest coordinates in the boxes.
        high: (k, 3), highest coordinates in the boxes.
    """
    found = np.zeros(len(places), np.bool_)
    for row in range(len(places)):
        for item in range(places.shape[1]):
            for axis in range(3):
                if not low[item, axis] <= places[row, item, axis] <= high[item, axis]:
                    found[row] = True
    return found


@kept
def singularity_penalty(
    conditioning: FloatArray, safe: float, assembly: BoolArray, working: BoolArray
) -> FloatArray:
    """Compute the penalty (n,) of :meth:`tpm_gym.tasks.Task.penalty`.

    Args:
        conditioning: (n,) conditioning of each robot.
        safe: Smallest conditioning without penalty.
        assembly: (n,) whether a parallel singularity was passed.
        working: (n,) whether a serial singularity was passed.
    """
    penalty = np.empty(len(conditioning))
    for row in range(len(conditioning)):
        ratio = conditioning[row] / safe
        squared = ratio * ratio
        passed = assembly[row] or working[row]
        penalty[row] = 1.0 if passed else max(1.0 - squared * squared, 0.0)
    return penalty


@kept
def truth(
    frames: FloatArray, sides: IntArray, pivots: FloatArray, platform: int, point: FloatArray
) -> tuple[float, Vector, float]:
    """Compute the largest loop gap (m), point P (m, world) and the platform's tilt (rad).

    Args:
        frames: Seven numbers for each link, one link after another, world frame: origin (m), and
            orientation (x, y, z, w).
        sides: (c, 2) indices of the two links of each closure.
        pivots: (c, 2, 3) m, points of each closure, in the frames of its links.
        platform: Index of the platform's link.
        point: (3,) m, point P in the platform's frame.
    """
    squared = 0.0
    for row in range(len(sides)):
        x, y, z = _placed(frames[7 * sides[row, 0] :], pivots[row, 0])
        u, v, w = _placed(frames[7 * sides[row, 1] :], pivots[row, 1])
        gap = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
        if gap > squared or gap != gap:  # after a NaN, the result stays NaN
            squared = gap
    own = frames[7 * platform :]
    sine = np.sqrt(own[4] * own[4] + own[5] * own[5] + own[6] * own[6])
    return np.sqrt(squared), _placed(own, point), 2 * np.arcsin(min(1.0, sine))


@kept
def friction_force(
    point: Vector,
    normal: Vector,
    place: Vector,
    motion: tuple[Vector, Vector, Vector],
    before: Vector,
    most: float,
    mass: float,
    moments: Vector,
    step: float,
) -> tuple[Vector, Vector]:
    """Compute Coulomb's friction on a block in the next time step, from its present slip.

    The friction is the sum of two parts. The ending part would end the slip in one time step, and
    is zero without slip. The steady part holds a block that sticks. In each time step, half of the
    ending part is added to the steady part.

    Args:
        point: Point of contact, m.
        normal: Unit vector towards the block.
        place: Centre of the block, m.
        motion: Velocity (m/s) and angular velocity (rad/s) of the block, and velocity (m/s) of the
            other body.
        before: Steady part of the friction in the last time step, N.
        most: Largest friction, N; a negative value is taken as 0.
        mass: Mass of the block, kg.
        moments: Principal moments of inertia of the block, which is assumed upright, kg m^2.
        step: Time step, s.

    Returns:
        The friction on the block, and the steady part of this friction, N.
    """
    arm = plus(point, place, -1.0)
    slip = plus(plus(motion[0], cross(motion[1], arm)), motion[2], -1.0)
    slip = plus(slip, normal, -dot(slip, normal))
    speed = max(length(slip), 1e-12)
    x, y, z = cross(arm, plus((0.0, 0.0, 0.0), slip, 1 / speed))
    mobility = 1 / mass + x * x / moments[0] + y * y / moments[1] + z * z / moments[2]
    ending = plus((0.0, 0.0, 0.0), slip, -1 / (mobility * step))
    steady = plus(plus(before, normal, -dot(before, normal)), ending, 0.5)
    steady = _at_most(steady, most)
    return _at_most(plus(steady, ending), most), steady


@compiled
def _at_most(vector: Vector, most: float) -> Vector:
    """Shorten a vector to the length ``most`` if it is longer; negative ``most`` counts as 0."""
    share = min(1.0, max(most, 0.0) / max(length(vector), 1e-12))
    return plus((0.0, 0.0, 0.0), vector, share)


@compiled
def _placed(frame: FloatArray, point: FloatArray) -> Vector:
    """Convert a point (m) from a frame (origin, orientation) to the world frame."""
    turn = frame[3], frame[4], frame[5], frame[6]
    return transform(three(frame), turn, three(point))


compilable(transform)


@kept
def spline_points(commands: FloatArray, weights: FloatArray) -> FloatArray:
    """Compute points (n, k, 3) on splines from commands (n, 3, 3) and weights (k, 3)."""
    points = np.empty((len(commands), len(weights), 3))
    for row in range(len(commands)):
        for axis in range(3):
            one, two, three = commands[row, 0, axis], commands[row, 1, axis], commands[row, 2, axis]
            for k in range(len(weights)):
                points[row, k, axis] = (
                    weights[k, 0] * one + weights[k, 1] * two + weights[k, 2] * three
                )
    return points


@kept
def drawn(shares: FloatArray, boxes: FloatArray, counts: IntArray) -> FloatArray:
    """Return d candidates for each of k points in each of r environments, (r, k, d, 3).

    Each point has one or more boxes. All candidates for a point lie in one of its boxes.

    Args:
        shares: (r, k, d, 4) random numbers in [0, 1), four for each candidate. The first three
            numbers determine the candidate's place in the box. For each point, the fourth number of
            the first candidate chooses the box of all candidates for this point; the other fourth
            numbers are not used.
        boxes: (sum of ``counts``, 2, 3) low and high corners of the boxes: the boxes of the first
            point, then the boxes of the second point, and so on.
        counts: (k,) number of boxes of each point.
    """
    points = np.empty((*shares.shape[:3], 3))
    for row in range(len(shares)):
        before = 0
        for index in range(len(counts)):
            box = before + int(shares[row, index, 0, 3] * counts[index])
            before += counts[index]
            for draw in range(shares.shape[2]):
                for i in range(3):
                    low, high = boxes[box, 0, i], boxes[box, 1, i]
                    points[row, index, draw, i] = low + (high - low) * shares[row, index, draw, i]
    return points


@kept
def accepted(
    drawn: FloatArray,
    conditioning: FloatArray,
    least: float,
    most: float,
    apart: float,
    rows: IntArray,
    points: FloatArray,
) -> BoolArray:
    """Choose, for each point, the first draw that is safe and far enough from the earlier points.

    Args:
        drawn: (r, k, d, 3) m, d draws for each of the last k points of a row.
        conditioning: (r, k, d) conditioning at the draws.
        least: Smallest conditioning of a chosen draw.
        most: Upper limit of the conditioning of a chosen draw; the limit itself is not allowed.
        apart: Smallest distance of a chosen draw from the earlier points of its row, m.
        rows: (r,) indices of the rows of ``points`` for which points are chosen.
        points: (n, j, 3) m, j points of each row; the chosen draws are written to the last k.

    Returns:
        Whether all k points of each row were found, (r,).
    """
    found = np.zeros(len(rows), np.bool_)
    first = points.shape[1] - drawn.shape[1]
    for i in range(len(rows)):
        mine, index, draw = points[rows[i]], 0, 0
        while index < drawn.shape[1] and draw < drawn.shape[2]:
            point = drawn[i, index, draw]
            fits = least <= conditioning[i, index, draw] < most
            for other in range(first + index):
                x, y, z = plus(three(point), row_of(mine, other), -1.0)
                fits &= x * x + y * y + z * z >= apart * apart
            draw += 1
            if fits:
                mine[first + index] = point
                index, draw = index + 1, 0
        found[i] = index == drawn.shape[1]
    return found


@kept
def arrived(
    theta: FloatArray, points: FloatArray, push: FloatArray, carried: FloatArray, step: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Find the state of the robots at the end of a path that they have followed exactly.

    Args:
        theta: (n, k, 3) rad, joint positions at the ends of the last k time steps.
        points: (n, j, 3) m, P at the ends of the last j time steps.
        push: (n, i, 3) N, force of the objects on P in the last i time steps.
        carried: (n,) kg, masses of the held objects.
        step: Time step, s.

    Returns:
        P one time step before the end, and at the end (n, 3) m; joint positions (n, 3) rad and
        velocities (n, 3) rad/s; force on P without the inertial force of held objects (n, 3) N.
    """
    shape, last, now = (len(theta), 3), theta.shape[1] - 1, points.shape[1] - 1
    before, position, force = np.empty(shape), np.empty(shape), np.empty(shape)
    angles, rates = np.empty(shape), np.empty(shape)
    for row in range(len(theta)):
        for i in range(3):
            before[row, i], position[row, i] = points[row, now - 1, i], points[row, now, i]
            angles[row, i] = theta[row, last, i]
            rates[row, i] = (theta[row, last, i] - theta[row, last - 1, i]) / step
            force[row, i] = push[row, push.shape[1] - 1, i]
            if carried[row] != 0:
                change = position[row, i] - 2 * before[row, i] + points[row, now - 2, i]
                force[row, i] += carried[row] * change / step**2
    return before, position, angles, rates, force


@kept
def differences(theta: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return joint positions, velocities and accelerations for each of k time steps, (n, k, 3).

    For each time step, the position is the one at its beginning, and the velocity is the mean
    velocity in the preceding time step. The acceleration is the change from this mean velocity to
    the mean velocity in the time step itself, divided by ``step``.

    Args:
        theta: (n, k + 2, 3) rad, joint positions at the ends of two preceding time steps and of the
            k time steps.
        step: Time step, s.
    """
    shape = len(theta), theta.shape[1] - 2, 3
    middle, rates, changes = np.empty(shape), np.empty(shape), np.empty(shape)
    for row in range(shape[0]):
        for k in range(shape[1]):
            for i in range(3):
                middle[row, k, i] = theta[row, k + 1, i]
                rates[row, k, i] = (theta[row, k + 1, i] - theta[row, k, i]) / step
                after = (theta[row, k + 2, i] - theta[row, k + 1, i]) / step
                changes[row, k, i] = (after - rates[row, k, i]) / step
    return middle, rates, changes


@kept
def beyond(torques: FloatArray, effort: FloatArray) -> BoolArray:
    """Return for each robot whether any of its torques exceeds the motor's largest torque, (r,).

    Args:
        torques: (r, k, 3) N m, torques in k time steps.
        effort: (r, 3) N m, largest torques of the motors.
    """
    found = np.zeros(len(torques), np.bool_)
    for row in range(len(torques)):
        for k in range(torques.shape[1]):
            for i in range(3):
                found[row] |= abs(torques[row, k, i]) > effort[row, i]
    return found


@kept
def ends(theta: FloatArray, step: float) -> FloatArray:
    """Compute the motion in the first and in the last of the K time steps of a control period.

    Velocities and accelerations are computed from differences of the joint positions in this
    control period only, because the acceleration jumps between control periods.

    Args:
        theta: (n, K + 1, 3) rad, from the beginning to the end of the period.
        step: Time step, s.

    Returns:
        (3, 2, n, 3): joint positions at the beginning of the time step, joint velocities, and joint
        accelerations; each for the first and for the last time step.
    """
    last = theta.shape[1] - 1
    found = np.zeros((3, 2, len(theta), 3))
    for row in range(len(theta)):
        for i in range(3):
            for end, start, first in ((0, 0, 0), (1, last - 1, last - 2)):
                found[0, end, row, i] = theta[row, start, i]
                found[1, end, row, i] = (theta[row, start + 1, i] - theta[row, start, i]) / step
                if last > 1:
                    before = (theta[row, first + 1, i] - theta[row, first, i]) / step
                    after = (theta[row, first + 2, i] - theta[row, first + 1, i]) / step
                    found[2, end, row, i] = (after - before) / step
    return found


@kept
def along(
    theta: FloatArray, true: FloatArray, torques: FloatArray, step: float, references: References
) -> None:
    """Write the references of a control period of K time steps.

    Args:
        theta: (n, K + 1, 3) rad, encoder readings from the beginning to the end of the period.
        true: (n, K + 1, 3) rad, true joint positions at the same times.
        torques: (2, n, 3) N m, feed-forward torques in the first and the last time step.
        step: Time step, s.
        references: Output.
    """
    steps = len(references.theta)
    for k in range(steps):  # outermost loop, so that the arrays are written in their order
        share = k / max(steps - 1, 1)
        for row in range(len(theta)):
            for i in range(3):
                first, last = torques[0, row, i], torques[1, row, i]
                references.theta[k, row, i] = true[row, k + 1, i]
                references.theta_dot[k, row, i] = (theta[row, k + 1, i] - theta[row, k, i]) / step
                references.torque[k, row, i] = first + share * (last - first)


@kept
def braced_inverse(
    mass: FloatArray, stiffness: FloatArray, damping: float, step: float
) -> FloatArray:
    """Return the inverse (n, 6) of the matrix M + step * (step * K + damping * I) of each robot.

    M is the inertia ``mass`` (n, 3, 3) kg m^2, K is the diagonal matrix of ``stiffness`` (n, 3)
    N m/rad, and I is the unit matrix. The six columns are the entries 00, 01, 02, 11, 12 and 22 of
    the symmetric inverse.
    """
    inverse = np.empty((len(mass), 6))
    for row in range(len(mass)):
        x, y, z = plus((damping, damping, damping), row_of(stiffness, row), step)
        a, b, c = page_row(mass, row, 0)
        _, d, e = page_row(mass, row, 1)
        found = inverted((a + step * x, b, c, d + step * y, e, mass[row, 2, 2] + step * z))
        for k in range(6):
            inverse[row, k] = found[k]
    return inverse


@kept
def servo_torques(
    index: int,
    references: References,
    law: tuple[FloatArray, float, FloatArray, FloatArray, FloatArray, FloatArray],
    theta: FloatArray,
    theta_dot: FloatArray,
    step: float,
    memory: FloatArray,
) -> None:
    """Apply the law of :class:`tpm_gym.simulation.drives.ServoDrives` in one time step.

    Args:
        index: Index of the time step in the control period.
        references: References of the control period.
        law: Stiffness (n, 3) N m/rad, damping (N m s/rad), inertia (n, 3, 3) kg m^2 that the law
            assumes, :func:`braced_inverse` of the inertia, largest torques (n, 3) N m, and two
            speeds of each motor (3, 2) rad/s: the corner speed, above which the largest torque
            falls, and the no-load speed, at which it is zero.
        theta: (n, 3) rad, at the beginning of the time step.
        theta_dot: (n, 3) rad/s, at the beginning of the time step.
        step: Time step, s.
        memory: (2, n, 3) torques and joint velocities of the last time step; overwritten.
    """
    for row in range(len(theta)):
        servo_torque(row, index, references, law, theta, theta_dot, step, memory)


def servo_torque(
    row: int,
    index: int,
    references: References,
    law: tuple[FloatArray, float, FloatArray, FloatArray, FloatArray, FloatArray],
    theta: FloatArray,
    theta_dot: FloatArray,
    step: float,
    memory: FloatArray,
) -> Vector:
    """Apply the law of the servo drives to one row, and return the torques (N m).

    The arguments are explained in :func:`servo_torques`.
    """
    stiffness, damping, mass, inverse, effort, line = law
    rates, last = row_of(theta_dot, row), page_row(memory, 0, row)
    load = onto(last, mass, row, plus(rates, page_row(memory, 1, row), -1.0), -1.0 / step)
    behind = plus(plus(page_row(references[0], index, row), row_of(theta, row), -1.0), rates, -step)
    slower = plus(page_row(references[1], index, row), rates, -1.0)
    forward = plus(plus(page_row(references[2], index, row), slower, damping), load, -1.0)
    x, y, z = row_of(stiffness, row)
    wanted = plus(forward, (x * behind[0], y * behind[1], z * behind[2]))
    braced = (
        inverse[row, 0], inverse[row, 1], inverse[row, 2],
        inverse[row, 3], inverse[row, 4], inverse[row, 5],
    )  # fmt: skip
    change = spread(braced, wanted)
    x, y, z = onto(load, mass, row, change)
    torque = (
        limited(x, rates[0], effort[row, 0], line[0, 0], line[0, 1]),
        limited(y, rates[1], effort[row, 1], line[1, 0], line[1, 1]),
        limited(z, rates[2], effort[row, 2], line[2, 0], line[2, 1]),
    )
    put_page_row(memory, 0, row, torque)
    put_page_row(memory, 1, row, rates)
    return torque


compilable(servo_torque)


@compiled
def limited(torque: float, rate: float, effort: float, corner: float, speed: float) -> float:
    """Clip a torque (N m) to the largest torque at the joint velocity ``rate`` (rad/s).

    Up to the speed ``corner`` the limit is ``effort``. For a driving motor, the limit then falls
    linearly to zero at the no-load ``speed``. For a braking motor, the limit stays ``effort``.
    """
    driving = effort
    if abs(rate) > corner:  # seldom, so that most rows need no division
        driving = effort * max(0.0, (speed - abs(rate)) / (speed - corner))
    high = driving if rate > 0 else effort
    low = -effort if rate > 0 else -driving
    return min(high, max(low, torque))
