"""Motion from torques, time step by time step: rates first, then angles, as engines have it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.mechanism.machine import Motion
from tpm_gym.simulation.analytic.columns import Batch
from tpm_gym.simulation.analytic.drives import Drive
from tpm_gym.simulation.drives import Reference

__all__ = ["Course", "march"]

_CREEP = 2e-5  # m/s; with which friction gives way instead of not at all
_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Course(NamedTuple):
    """Where r machines are, at the end of a time step.

    Attributes:
        theta: (3, r) rad.
        rates: (3, r) rad/s.
        torque: What the motors applied, (3, r) N m.
        position: Of P, (3, r) m.
        before: The same a time step ago.
        force: Of objects on P in the time step, (3, r) N, less what changes of the rates take to
            accelerate what is carried.
        carried: Mass that moves with P, (r,) kg.
        left: (2, r) whether they left their assembly mode, their working mode.
    """

    theta: FloatArray
    rates: FloatArray
    torque: FloatArray
    position: FloatArray
    before: FloatArray
    force: FloatArray
    carried: FloatArray
    left: BoolArray

    def take(self, rows: IntArray) -> Course:
        """Some of the machines."""
        parts: list[Any] = [np.ascontiguousarray(part[..., rows]) for part in self]
        return Course(*parts)

    def lead(self, theta: FloatArray, time_step: float) -> FloatArray:
        """The angles (3, K + 2, r) rad of the last two time steps, and those to come (3, K, r)."""
        earlier = self.theta - time_step * self.rates
        return np.concatenate([earlier[:, None], self.theta[:, None], theta], axis=1)


Touch = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Force on P (3, r) N and mass that moves with it (r,) kg, for P (3, 3, r) m a time step ago, now,
and at the end of the time step."""


def march(
    batch: Batch,
    drive: Drive,
    references: Sequence[Reference],
    start: Course,
    time_step: float,
    touch: Touch,
) -> tuple[Course, list[FloatArray]]:
    """Run time steps, one for each reference.

    What objects do in a time step follows from how P moves in it. So machines feel the force of the
    time step before; but what they carry is part of their own inertia, and friction is taken at
    the end of the time step, or both could build up.

    A machine that leaves its modes stays where it was before.

    Returns:
        Where the machines are then, and what the motors applied in each time step, (3, r) N m.
    """
    now, torques = start, []
    at = batch.motion(now.theta, now.rates)
    for reference in references:
        with np.errstate(all="ignore"):
            mass, load = _felt(at, now, time_step)
            rates, torque = drive.step(reference, now.theta, now.rates, mass, load)
            theta = now.theta + time_step * rates
            expected = now.position + time_step * _along(at.jacobian, rates)
            gain = _along(at.jacobian, rates - now.rates) / time_step
        at = batch.motion(theta, rates)
        drifting = 2 * now.position - now.before
        side = batch.assembled_at(expected) & batch.assembled_at(drifting)
        left = _left(at, side, now.left)
        new: tuple[FloatArray, ...] = theta, rates, torque, at.position, gain
        gone = left.any(axis=0)
        if gone.any():
            old = now.theta, now.rates, now.torque, now.position, np.zeros_like(gain)
            new = tuple(np.where(gone, *pair) for pair in zip(old, new, strict=True))
        theta, rates, torque, position, gain = new
        push, carried = touch(np.stack([now.before, now.position, position]))
        force = push + carried * gain
        now = Course(theta, rates, torque, position, now.position, force, carried, left)
        torques.append(torque)
    return now, torques


def _felt(at: Motion, now: Course, time_step: float) -> tuple[FloatArray, FloatArray]:
    """Inertia (6, r) and load (3, r) that the motors feel."""
    if not now.force.any() and not now.carried.any():
        return at.mass, at.bias
    resistance, (x, y, z) = _friction(now.force, (now.position - now.before) / time_step)
    j, level = at.jacobian, now.carried + time_step * resistance
    added = [
        level * (j[0, i] * j[0, k] + j[1, i] * j[1, k]) + now.carried * (j[2, i] * j[2, k])
        for i, k in _TRIANGLE
    ]
    return at.mass + np.stack(added), at.bias - (j[0] * x + j[1] * y + j[2] * z)


def _friction(force: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The level part of a force that opposes the motion, as one proportional to its velocity.

    So it can be taken at the end of the time step. From its beginning, friction would overshoot
    what it stops, and push it to and fro.

    Args:
        force: (3, r) N, in the last time step.
        velocity: (3, r) m/s, in the last time step.

    Returns:
        How much it grows with the velocity, (r,) N s/m; and the force (3, r) N at this velocity.
    """
    (x, y, z), (u, v, _) = force, velocity
    speed = np.sqrt(u * u + v * v)
    least = np.maximum(speed, _CREEP)
    opposing = np.maximum(-(x * u + y * v), 0.0)
    share = np.where(opposing > 0, speed / least, 1.0)
    return opposing / (np.maximum(speed, 1e-12) * least), np.stack([share * x, share * y, z])


def _along(jacobian: FloatArray, rates: FloatArray) -> FloatArray:
    a, b, c = rates
    moved: FloatArray = jacobian[:, 0] * a + jacobian[:, 1] * b + jacobian[:, 2] * c
    return moved


def _left(at: Motion, side: BoolArray, before: BoolArray) -> BoolArray:
    """Which modes have been left (2, r).

    Beyond a parallel singularity angles turn back, so that those of the mirrored assembly are there
    too. What tells is ``side`` (r,): whether P was about to stay on the side that it was on, by the
    motors' rates and by its own.
    """
    finite = np.isfinite(at.position).all(axis=0) & np.isfinite(at.mass).all(axis=0)
    assembly = ~finite | ~side
    found: BoolArray = np.where(before.any(axis=0), before, [assembly, ~assembly & ~at.working])
    return found
