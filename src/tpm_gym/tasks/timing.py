"""Timing of a path: the shortest time in which the motors can repeat the path without overheating.

The RMS torque of a motor that repeats a motion must not exceed its continuous torque, because the
power that heats the winding grows with the square of the torque. Tools for time-optimal path
parameterisation limit only the torque at every point. So this module computes the timing, as a
convex problem.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine

_STEPS: Final = 50
_TOLERANCE: Final = 1e-9
"""Relative decrement of the objective at which the search ends."""


def timed(
    machine: Machine, path: FloatArray, continuous: ArrayLike, peak: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Compute the earliest times at which P can pass the points of a path, from rest to rest.

    With the path parameter s in [0, 1], b = (ds/dt)^2 and b' = db/ds, the torque is
    A b'/2 + B b + g, where A, B and the gravity torque g follow from the closed-form dynamics. The
    heat is the integral over time of the squared torques of all motors. Time and heat are convex in
    b, and so is their sum, which Newton's method minimises. If g were 0, the shape of the optimal b
    would not depend on the weights of time and heat in the sum. So the optimum is computed once,
    for g = 0. The times of this optimum are then multiplied by the smallest factor with which no
    motor exceeds a limit. The torques in this last step include g.

    Args:
        machine: Machine. The torques include its payload.
        path: (N + 1, 3) m, machine's frame, points at equal distances.
        continuous: (3,) N m, largest RMS torque of each motor over the motion.
        peak: (3,) N m, largest torque of each motor.

    Returns:
        Times (N + 1,) s of the points, and the torques (N, 3) N m between them.

    Raises:
        UnreachableError: If a point is out of reach.
        ConfigurationError: If a motor cannot hold the weight.
    """
    theta, count = machine.require_inverse(path), len(path) - 1
    middle, first = (theta[1:] + theta[:-1]) / 2, np.diff(theta, axis=0) * count
    second = np.gradient(first, 1 / count, axis=0)
    rest = machine.torque(middle, 0 * first, 0 * first)
    along = (machine.torque(middle, 0 * first, first) - rest) * count / 2
    across = (machine.torque(middle, first, second) - rest) / 2
    # Torque between points k and k + 1 without gravity: end[k] b[k + 1] + begin[k] b[k]
    begin, end = across - along, across + along
    squared = _fastest(begin, end)
    spans, torques = _spans(squared), _torques(squared, begin, end)
    slower = _scale(spans, torques, rest, np.array(continuous), np.array(peak))
    times = np.concatenate([[0.0], np.cumsum(spans)]) * slower
    return times, torques / slower**2 + rest


def _spans(squared: FloatArray) -> FloatArray:
    """Return the times (N,) s from point to point; ``squared`` (N + 1,) is (ds/dt)^2 at points."""
    speed = np.sqrt(squared)
    spans: FloatArray = 2 / (len(squared) - 1) / (speed[1:] + speed[:-1])
    return spans


def _torques(squared: FloatArray, begin: FloatArray, end: FloatArray) -> FloatArray:
    """Return the torques (N, 3) N m between the points of a path, without gravity.

    Between points k and k + 1, the torque is begin[k] squared[k] + end[k] squared[k + 1].

    Args:
        squared: (N + 1,) (ds/dt)^2 at the points; see :func:`timed`.
        begin: (N, 3) factors of ``squared`` at the first point of each span between points.
        end: (N, 3) factors of ``squared`` at the last point of each span.
    """
    return begin * squared[:-1, None] + end * squared[1:, None]


def _cost(squared: FloatArray, begin: FloatArray, end: FloatArray) -> float:
    """Return the time plus the heat, the integral of the squared torques over time.

    :func:`_torques` explains the arguments.
    """
    heat = (_torques(squared, begin, end) ** 2).sum(axis=1)
    return float(_spans(squared) @ (1 + heat))


def _fastest(begin: FloatArray, end: FloatArray) -> FloatArray:
    """Minimise time plus heat by Newton's method; return (ds/dt)^2 (N + 1,), zero at both ends.

    :func:`_torques` explains the arguments.
    """
    s = np.linspace(0.0, 1.0, len(begin) + 1)
    squared = s * (1 - s)
    heat = (_torques(squared, begin, end) ** 2).sum(axis=1)
    # At the best scale of the squared speeds, the heat is a third of the time.
    squared /= np.sqrt(3 * (_spans(squared) @ heat) / _spans(squared).sum())
    for _ in range(_STEPS):
        gradient, hessian = _derivatives(squared, begin, end)
        step = np.zeros_like(squared)
        step[1:-1] = np.linalg.solve(hessian, -gradient)
        decrement, cost = -gradient @ step[1:-1], _cost(squared, begin, end)
        if decrement < _TOLERANCE * cost:
            break
        share = 1.0
        while (squared + share * step)[1:-1].min() <= 0 or (
            _cost(squared + share * step, begin, end) > cost - 1e-4 * share * decrement
        ):
            share /= 2
        squared = squared + share * step
    return squared


def _derivatives(
    squared: FloatArray, begin: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gradient (N - 1,) and the Hessian (N - 1, N - 1) of :func:`_cost`.

    The variables are ``squared[1:-1]``. :func:`_torques` explains the arguments.
    """
    count, spans, torques = len(begin), _spans(squared), _torques(squared, begin, end)
    speed = np.sqrt(squared)
    weight = 1 + (torques**2).sum(axis=1)
    gradient, hessian = np.zeros(count + 1), np.zeros((count + 1, count + 1))
    rows = np.arange(count)
    sides = ((0, begin), (1, end))
    slopes, heats = [], []
    for side, factors in sides:
        # At rest the slope is infinite, but ``squared`` is fixed there.
        own = np.where(speed[rows + side] > 0, speed[rows + side], np.inf)
        slopes.append(-(spans**2) * count / 4 / own)
        heats.append(2 * (torques * factors).sum(axis=1))
        gradient[rows + side] += slopes[side] * weight + spans * heats[side]
        hessian[rows + side, rows + side] += spans**2 * count / 8 / own**3 * weight
    for side, factors in sides:
        for other, others in sides:
            curvature = 2 * slopes[side] * slopes[other] / spans
            hessian[rows + side, rows + other] += (
                curvature * weight
                + slopes[side] * heats[other]
                + heats[side] * slopes[other]
                + 2 * spans * (factors * others).sum(axis=1)
            )
    return gradient[1:-1], hessian[1:-1, 1:-1]


def _scale(
    spans: FloatArray,
    torques: FloatArray,
    rest: FloatArray,
    continuous: FloatArray,
    peak: FloatArray,
) -> float:
    """Find by bisection the smallest factor on all times with which no motor exceeds a limit.

    A factor f divides ``torques`` by f^2, and does not change ``rest``.

    Args:
        spans: (N,) s, times from point to point.
        torques: (N, 3) N m, torques between the points, without gravity.
        rest: (N, 3) N m, torques that hold the weight between the points.
        continuous: (3,) N m, largest RMS torque of each motor.
        peak: (3,) N m, largest torque of each motor.

    Raises:
        ConfigurationError: If a motor cannot hold the weight.
    """

    def fits(factor: float) -> bool:
        found = torques / factor**2 + rest
        mean = np.sqrt(spans @ found**2 / spans.sum())
        return bool((mean <= continuous).all() and (np.abs(found) <= peak).all())

    low, high = 0.0, 1.0
    while not fits(high):
        low, high = high, 2 * high
        if high > 1e6:
            valid = f"a payload that motors of {continuous.tolist()} N m can hold"
            raise ConfigurationError("payload", rest.tolist(), valid)
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
