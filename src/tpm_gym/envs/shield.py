"""Shield: the nearest command that keeps the machine away from singularities.

Let c be the last command, b the middle between c and the command before c, and d the next command.
In a control period, point P follows the Bezier curve with the control points b, c and (c + d) / 2.
If the command then stays at d, P moves on to d in a straight line. The command d is safe if the
conditioning 1/cond(J) does not fall below the limit ``Shield.least`` on this curve and this line.
So it is always safe to hold the last command c: P then moves on the line from b to c, and the check
of c included this line.

Sequential quadratic programming finds the nearest safe command, as docs/shield.md explains. If all
searches fail, the command is moved towards the last command.

If a task bounds the accelerations of commands, a robot cannot hold the last command at once. For
such tasks, :class:`BrakingShield` allows only commands after which the robot can brake in time.

Importing this module imports Numba.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray, is_number
from tpm_gym.compiling import kept
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.engine import loops
from tpm_gym.tasks.control import Control, Follower

MARGIN = 0.15
"""Extra conditioning that shields keep with servo drives or randomised plants, as a fraction of the
machine's ``safe_conditioning``."""
TOLERANCE = 2e-5
"""Amount by which the conditioning at commands should exceed ``Shield.least``.

A path passes the check if its smallest conditioning exceeds ``Shield.least`` by half of this amount
or more. This half is a reserve for errors of the check, which computes the conditioning at seven
points of the path and interpolates between them.
"""
_FAR = 1.05
"""If the conditioning at three successive commands is at least this multiple of ``Shield.least``,
the path between them is safe, and is not checked."""
_STEPS = 6  # largest number of steps of sequential quadratic programming
_CLOSE = 0.005  # step, in units of the action, that ends the search: the next is 100 times smaller
_ROUNDS = 3  # largest number of times that the aim is raised, if a path is less safe than its ends
_HALVINGS = 20
_PARTINGS = 8  # halvings between the braking and the wanted command
_LONGEST = 200  # largest number of control steps until a robot that brakes is at rest
_SWEEPS = 200  # largest number of sweeps over the constraints of a quadratic program
_NUDGE = 1e-4  # displacement for derivatives of the conditioning, as a fraction of the step limit


@cache
def _nodes() -> FloatArray:
    """Return weights (7, 3) of b, c and d for seven points: five on the curve, two on the line."""
    s = np.arange(5)[:, None] / 4  # the curve (1-s)^2 b + 2 s (1-s) c + s^2 (c + d) / 2
    curve = np.hstack([(1 - s) ** 2, 2 * s * (1 - s) + s**2 / 2, s**2 / 2])
    return np.vstack([curve, [[0.0, 0.25, 0.75], [0.0, 0.0, 1.0]]])


class Problem(NamedTuple):
    """Data of a search for the nearest safe commands of r robots.

    Attributes:
        wanted: (r, 3) wanted commands, in units of the action.
        last: (r, 3) last commands, in units of the action.
        low: (r, 3) m, lower corner of the commands that the control can give.
        high: (r, 3) m, upper corner.
        aim: (r,) conditioning that the commands have to reach.
    """

    wanted: FloatArray
    last: FloatArray
    low: FloatArray
    high: FloatArray
    aim: FloatArray


class Shield:
    """Shield that replaces unsafe commands by the nearest safe ones, for n robots.

    Distances between commands are Euclidean, in units of the action: one unit is the largest
    increment of P along an axis (Cartesian control) or of a joint (joint control). The wanted
    command is the command that the control computes from the action. The returned command is at
    most 0.003 units farther from the wanted command than the nearest safe command is.

    Args:
        machine: Nominal machine.
        control: Control of the environment.
        least: Smallest conditioning on the path of the commands.
    """

    def __init__(self, machine: Machine, control: Control, least: float) -> None:
        """Store the arguments."""
        self._machine, self._control, self.least = machine, control, least
        self._step = np.array(machine.step_limit)
        self._low, self._high = np.array(machine.region.low), np.array(machine.region.high)
        # A cache: the last commands, and how many successive commands were far from the border. The
        # path of three such commands is safe, and is not checked.
        self._last: FloatArray = np.empty((0, 2, 3))
        self._far = np.empty(0, dtype=np.int64)

    def command(self, wanted: FloatArray, recent: FloatArray) -> FloatArray:
        """Return the safe commands (n, 3) m that are nearest to the wanted ones.

        Args:
            wanted: (n, 3) m, commands by the control, machine's frame.
            recent: (n, 2, 3) m, the last two commands.
        """
        if len(self._last) != len(recent):
            self._last, self._far = np.full_like(recent, np.nan), np.zeros(len(recent), np.int64)
        self._far[(self._last != recent).any(axis=(1, 2))] = 0
        far = self._machine.conditioning_at(wanted) >= _FAR * self.least
        rows = np.flatnonzero(~far | (self._far < 2))
        command = wanted
        if len(rows):
            command = wanted.copy()
            corners = np.stack([recent.mean(axis=1), recent[:, 1], wanted], axis=1)[rows]
            unsafe = self._lack(corners) > 0
            if unsafe.any():
                rows = rows[unsafe]
                command[rows], far[rows] = self._nearest(corners[unsafe]), False
        self._far = np.where(far, self._far + 1, 0)
        self._last = np.stack([recent[:, 1], command], axis=1)
        return command

    def _lack(self, corners: FloatArray) -> FloatArray:
        """Return the conditioning (r,) that paths lack; their corners b, c, d are (r, 3, 3) m."""
        return self.least + TOLERANCE / 2 - _lowest_on_path(self._machine, corners)

    def _nearest(self, corners: FloatArray) -> FloatArray:
        """Return the safe commands (r, 3) m nearest to the wanted commands.

        Args:
            corners: (r, 3, 3) m, the points b, c and d of each path, as at the top of this file. d
                is the wanted command.
        """
        last, found = corners[:, 1], corners.copy()
        of = Problem(
            self._control.scaled(corners[:, 2]),
            self._control.scaled(last),
            np.maximum(self._low, last - self._step),
            np.minimum(self._high, last + self._step),
            np.full(len(corners), self.least + TOLERANCE),
        )
        rows = np.arange(len(corners))
        for _ in range(_ROUNDS):
            found[rows, 2] = self._solution(found[rows, 2], Problem(*(part[rows] for part in of)))
            lack = self._lack(found[rows])
            of.aim[rows] += 2 * np.maximum(lack, 0.0)
            rows = rows[lack > 0]
            if not len(rows):
                break
        else:
            found[rows, 2] = self._shortened(found[rows])
        nearest: FloatArray = found[:, 2]
        return nearest

    def _solution(self, points: FloatArray, of: Problem) -> FloatArray:
        """Return the commands (r, 3) m that solve problems, by sequential quadratic programming."""
        found: FloatArray = points.copy()
        rows = np.arange(len(points))
        beside = np.concatenate([np.zeros((1, 3)), np.diag(self._step * _NUDGE)])
        for _ in range(_STEPS):
            values = self._machine.conditioning_at(points[:, None] + beside)
            slope = (values[:, 1:] - values[:, :1]) / (self._step * _NUDGE)
            here, rate = self._control.scaled(points), self._control.rate(points)
            points, moved = solved(points, here, rate, slope, of.aim - values[:, 0], *of[:4])
            found[rows] = points
            going = moved > _CLOSE
            if not going.any():
                break
            rows, points, of = rows[going], points[going], Problem(*(part[going] for part in of))
        return found

    def _shortened(self, corners: FloatArray) -> FloatArray:
        """Return the safe commands (r, 3) m farthest from c on the straight line from c to d."""
        tried = corners.copy()
        last, whole = corners[:, 1], corners[:, 2] - corners[:, 1]
        low, high = np.zeros((len(corners), 1)), np.ones((len(corners), 1))
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            tried[:, 2] = last + middle * whole
            safe = self._lack(tried)[:, None] <= 0
            low, high = np.where(safe, middle, low), np.where(safe, high, middle)
        shortened: FloatArray = last + low * whole
        return shortened


class BrakingShield:
    """Shield of Cycle: replaces commands after which robots could not brake in time.

    After a command, the robot can brake as hard as the ``follower`` allows. The command is safe if,
    on the path to it and while the robot then brakes, the conditioning stays at ``least`` or above
    and no torque exceeds the motor's peak torque. So it is always safe to brake: the check of the
    last command included the braking after it. An unsafe command is moved in a straight line
    towards the command with which the robot brakes.

    Args:
        machine: Nominal machine.
        follower: Limiter of commands, so that the motors can follow them.
        least: Smallest conditioning on the path of the commands.
    """

    def __init__(self, machine: Machine, follower: Follower, least: float) -> None:
        """Store the arguments."""
        self._machine, self._follower, self.least = machine, follower, least

    def command(self, wanted: FloatArray, recent: FloatArray) -> FloatArray:
        """Return safe commands (n, 3) m between the braking commands and the wanted ones.

        If even braking leads to a conditioning below ``least``, the returned command is no worse
        than braking: the conditioning on its path is never below the smallest conditioning on the
        path of braking.

        Args:
            wanted: (n, 3) m, commands before the shield, machine's frame.
            recent: (n, 2, 3) m, the last two commands.
        """
        reached = self._lowest(wanted, recent)
        rows = np.flatnonzero(~(reached >= self.least + TOLERANCE / 2))
        if not len(rows):
            return wanted
        recent, reached = recent[rows], reached[rows]
        brake = self._follower.limit(recent[:, 1], recent[:, 1], recent[:, 0])
        least = np.minimum(self.least + TOLERANCE / 2, self._lowest(brake, recent))
        whole = wanted[rows] - brake
        low = (reached >= least)[:, None] * 1.0
        high = np.ones_like(low)
        for _ in range(_PARTINGS):
            middle = (low + high) / 2
            safe = (self._lowest(brake + middle * whole, recent) >= least)[:, None]
            low, high = np.where(safe, middle, low), np.where(safe, high, middle)
        command: FloatArray = wanted.copy()
        command[rows] = np.where(low < 1.0, brake + low * whole, wanted[rows])
        return command

    def _lowest(self, command: FloatArray, recent: FloatArray) -> FloatArray:
        """Return the smallest conditioning (r,) if robots get a command and then brake to rest."""
        found: FloatArray = np.full(len(command), np.inf)
        rows, (before, current), then = np.arange(len(command)), recent.swapaxes(0, 1), command
        for _ in range(_LONGEST):
            corners = np.stack([(before + current) / 2, current, then], axis=1)
            least = _lowest_on_path(self._machine, corners)
            least[~self._follower.feasible(before, current, then)] = -np.inf
            found[rows] = np.minimum(found[rows], least)
            going = (then != current).any(axis=1) & (found[rows] > 0)
            if not going.any():
                return found
            rows, before, current = rows[going], current[going], then[going]
            then = self._follower.limit(current, current, before)
        found[rows] = -np.inf
        return found


def make_shield(
    shield: Any, machine: Machine, control: Control, follower: Follower | None, exact: bool
) -> Shield | BrakingShield:
    """Build the shield for the option ``shield`` of an environment.

    Args:
        shield: The conditioning to keep, or True for the machine's ``safe_conditioning``.
        machine: Nominal machine.
        follower: Limiter of the control's commands; None if their accelerations are not bounded.
        exact: Whether the robot follows its commands exactly. If it does not, the conditioning to
            keep with ``shield=True`` is (1 + :data:`MARGIN`) times ``safe_conditioning``.

    Raises:
        ConfigurationError: If the option is neither True nor a number in (0, 1], if the
            conditioning at home is below the conditioning to keep, or if the machine may pass a
            parallel singularity.
    """
    if machine.mirror_axis is not None:
        valid = f"False: {machine.name!r} has to pass a singularity here"
        raise ConfigurationError("shield", shield, valid)
    least = shield
    if shield is True:
        least = machine.safe_conditioning * (1 if exact else 1 + MARGIN)
    if not is_number(least) or not 0 < least <= 1:
        valid = "False, True, or a conditioning in (0, 1] to keep"
        raise ConfigurationError("shield", shield, valid)
    home = float(machine.conditioning_at(machine.home))
    if home < least + TOLERANCE:
        valid = f"at most {home - TOLERANCE:.3g}, the conditioning of {machine.name!r} at home"
        raise ConfigurationError("shield", least, valid)
    if follower is None:
        return Shield(machine, control, float(least))
    return BrakingShield(machine, follower, float(least))


def _lowest_on_path(machine: Machine, corners: FloatArray) -> FloatArray:
    """Return the smallest conditioning (r,) on paths; their corners b, c, d are (r, 3, 3) m."""
    points = loops().spline_points(corners, _nodes())
    found: FloatArray = lowest(machine.conditioning_at(points))
    return found


@kept
def lowest(values: FloatArray) -> FloatArray:
    """Return the smallest value on each of r paths, (r,), from the values (r, 7) at seven nodes.

    A path is a curve with the nodes 0 to 4, and then a straight line with the nodes 4 to 6. Between
    nodes, values are interpolated by parabolas through three successive nodes.
    """
    found = np.empty(len(values))
    for row in range(len(values)):
        least = min(values[row, 0], values[row, 6])
        for k in (1, 2, 3, 5):
            one, two, three = values[row, k - 1], values[row, k], values[row, k + 1]
            bend, rise = one - 2 * two + three, (three - one) / 2
            least = min(least, two)
            if bend > abs(rise):  # the lowest point lies between the three
                least = min(least, two - rise * rise / (2 * bend))
        least = min(least, values[row, 4])
        found[row] = least if least == least else -np.inf
    return found


@kept
def solved(
    point: FloatArray,
    here: FloatArray,
    rate: FloatArray,
    slope: FloatArray,
    lack: FloatArray,
    wanted: FloatArray,
    last: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Find the commands nearest to the wanted ones under constraints, by Hildreth's method.

    The constraints are: the linearised conditioning exceeds that at ``point`` by at least ``lack``,
    the command is between ``low`` and ``high``, and the action is possible.

    The search begins at the wanted command, and treats the constraints in turn. A constraint that
    is violated pushes the solution found so far until the constraint holds with equality. If a
    constraint holds with a reserve, the solution is moved back, but not farther than this
    constraint has pushed it in total.

    Args:
        point: (r, 3) m, points at which the conditioning is linearised.
        here: (r, 3), ``point`` in units of the action.
        rate: (r, 3, 3) m, motion of P for unit actions.
        slope: (r, 3) 1/m, gradient of the conditioning.
        lack: (r,) conditioning that is lacking at ``point``.
        wanted: (r, 3) wanted commands, in units of the action.
        last: (r, 3) last commands, in units of the action.
        low: (r, 3) m, lower corner of the commands that the control can give.
        high: (r, 3) m, upper corner.

    Returns:
        Points (r, 3) m, and how far (r,) they are from ``point`` in units of the action.
    """
    found, moved = np.empty_like(point), np.empty(len(point))
    normal, bound, push = np.zeros((13, 3)), np.zeros(13), np.zeros(13)
    for row in range(len(point)):
        for i in range(3):
            normal[12, i] = 0.0
            for k in range(3):
                normal[12, i] += slope[row, k] * rate[row, k, i]
                normal[i, k], normal[3 + i, k] = rate[row, i, k], -rate[row, i, k]
            normal[6 + i, i], normal[9 + i, i] = 1.0, -1.0
            limit = max(1.0, abs(wanted[row, i] - last[row, i]))
            done = here[row, i] - last[row, i]
            bound[i], bound[3 + i] = low[row, i] - point[row, i], point[row, i] - high[row, i]
            bound[6 + i], bound[9 + i] = -limit - done, done - limit
        bound[12] = lack[row]
        push[:] = 0.0
        move = wanted[row] - here[row]
        for _ in range(_SWEEPS):
            change = 0.0
            for k in range(13):
                a, b, c = normal[k]
                size = a * a + b * b + c * c
                if size > 0.0:
                    missing = bound[k] - (a * move[0] + b * move[1] + c * move[2])
                    more = max(missing / size, -push[k])
                    push[k] += more
                    move[0] += more * a
                    move[1] += more * b
                    move[2] += more * c
                    change = max(change, abs(more) * np.sqrt(size))
            if change < 1e-6:
                break
        moved[row] = np.sqrt(move[0] ** 2 + move[1] ** 2 + move[2] ** 2)
        for i in range(3):
            there = point[row, i]
            for k in range(3):
                there += rate[row, i, k] * move[k]
            there = there if there == there else point[row, i]  # NaN: no inverse, or no Jacobian
            found[row, i] = min(max(there, low[row, i]), high[row, i])
    return found, moved
