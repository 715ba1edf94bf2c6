"""Machines whose equations are computed by compiled loops over many robots.

The loops (:mod:`tpm_gym.mechanism.loops`) are imported at the first computation, since they import
Numba.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, numbers
from tpm_gym.errors import ConfigurationError, InputError
from tpm_gym.mechanism.inertia import Bodies
from tpm_gym.mechanism.machine import SAME_PLACE, Machine, Motion, Reading

ASSEMBLY_LIMIT = 0.010
"""Largest distance between P and the result of the forward kinematics for the joint positions, m.

At a larger distance, the robot has left its assembly mode."""


@dataclass(frozen=True, kw_only=True)
class CompiledMachine(Machine):
    """Machine whose results are computed by a module of compiled loops.

    Attributes:
        geometry: Link lengths.
    """

    geometry: Any

    _module: ClassVar[str]
    """Name of the module whose constant ``LOOPS`` contains the compiled loops over robots."""
    _inertia_of: ClassVar[Any]
    """Function (:class:`Bodies`, geometry) -> constants of the dynamics."""

    @property
    def _loops(self) -> Any:
        return _loops_of(self._module)

    @cached_property
    @abstractmethod
    def _constants(self) -> FloatArray:
        """Constants that are equal for all robots: signs of the modes, and gravity."""

    def inverse(self, position: ArrayLike, built: FloatArray | None = None) -> FloatArray:
        """See :class:`Machine`."""
        points = _rows(position)
        theta = np.empty(points.shape)
        of = self._own if built is None else self._others(built, points)
        self._loops.inverse((points.reshape(-1, 3),), 0.0, *of, (theta.reshape(-1, 3),))
        return theta

    def forward(self, theta: ArrayLike, built: FloatArray | None = None) -> FloatArray:
        """See :class:`Machine`."""
        angles = _rows(theta)
        position = np.empty(angles.shape)
        of = self._own if built is None else self._others(built, angles)
        self._loops.forward((angles.reshape(-1, 3),), 0.0, *of, (position.reshape(-1, 3),))
        return position

    def evaluate(self, theta: ArrayLike, built: FloatArray | None = None) -> Reading:
        """See :class:`Machine`."""
        angles = _rows(theta)
        flat, empty = angles.reshape(-1, 3), np.empty
        of = self._own if built is None else self._others(built, angles)
        count = len(flat)
        position, jacobian = empty((count, 3)), empty((count, 3, 3))
        found = Reading(position, jacobian, empty(count), empty(count, np.bool_))
        self._loops.evaluate((flat,), 0.0, *of, tuple(found))
        return found if angles.ndim == 2 else Reading(*_shaped(found, angles))

    def conditioning_at(self, position: ArrayLike) -> FloatArray:
        """See :class:`Machine`."""
        points = _rows(position)
        found = np.empty(points.shape[:-1])
        self._loops.conditioning_at(
            (points.reshape(-1, 3),), SAME_PLACE, *self._own, (found.reshape(-1),)
        )
        return found

    def same_side(self, position: ArrayLike) -> BoolArray:
        """See :class:`Machine`."""
        points = _rows(position)
        found = np.empty(points.shape[:-1], np.bool_)
        self._loops.same_side((points.reshape(-1, 3),), 0.0, *self._own, (found.reshape(-1),))
        return found

    def mode_left(
        self, theta: ArrayLike, position: ArrayLike, built: FloatArray | None = None
    ) -> NDArray[np.int8]:
        """See :class:`Machine`."""
        angles, points = _rows(theta), _rows(position)
        if points.shape != angles.shape:
            raise InputError("position", points.shape, f"of shape {angles.shape}, like theta")
        left = np.empty(angles.shape[:-1], np.int8)
        of = self._own if built is None else self._others(built, angles)
        flat = angles.reshape(-1, 3), points.reshape(-1, 3)
        self._loops.mode_left(flat, ASSEMBLY_LIMIT, *of, (left.reshape(-1),))
        return left

    def torque(
        self,
        theta: ArrayLike,
        theta_dot: ArrayLike,
        theta_ddot: ArrayLike,
        force: ArrayLike | None = None,
        built: FloatArray | None = None,
    ) -> FloatArray:
        """See :class:`Machine`."""
        angles = _rows(theta)
        inputs = [angles, _alike(theta_dot, angles), _alike(theta_ddot, angles)]
        inputs.append(np.zeros(angles.shape) if force is None else _alike(force, angles))
        torques = np.empty(angles.shape)
        of = self._own if built is None else self._others(built, angles)
        flat = tuple(values.reshape(-1, 3) for values in inputs)
        self._loops.torque(flat, 0.0, *of, (torques.reshape(-1, 3),))
        return torques

    def motion(
        self, theta: ArrayLike, theta_dot: ArrayLike, built: FloatArray | None = None
    ) -> Motion:
        """See :class:`Machine`."""
        angles = _rows(theta)
        flat, rates, empty = angles.reshape(-1, 3), _alike(theta_dot, angles), np.empty
        of = self._own if built is None else self._others(built, angles)
        count = len(flat)
        place = empty((count, 3)), empty((count, 3, 3)), empty(count, np.bool_)
        found = Motion(*place, empty((count, 3, 3)), empty((count, 3)))
        self._loops.motion((flat, rates.reshape(-1, 3)), 0.0, *of, tuple(found))
        return found if angles.ndim == 2 else Motion(*_shaped(found, angles))

    @property
    def lengths(self) -> tuple[float, ...]:
        """Lengths of the geometry, m."""
        return tuple(self.geometry.lengths)

    def with_lengths(self, lengths: tuple[float, ...]) -> CompiledMachine:
        """Return the machine with these lengths, m."""
        if len(lengths) != len(self.lengths):
            valid = f"{len(self.lengths)} lengths, like those of {self.name}"
            raise ConfigurationError("lengths", lengths, valid)
        return replace(self, geometry=type(self.geometry)(*lengths))

    def built(
        self, lengths: tuple[float, ...] = (), link_masses: tuple[float, ...] = ()
    ) -> FloatArray:
        """Return the lengths (m) and the constants of the dynamics as one array of k numbers, (k,).

        The arguments are explained in :class:`Machine`.
        """
        machine = self.with_lengths(lengths) if lengths else self
        inertia = self._inertia_of(Bodies(machine.mechanism, link_masses), machine.geometry)
        return np.concatenate([machine.lengths, *map(np.ravel, inertia)])

    @cached_property
    def _own(self) -> tuple[FloatArray, FloatArray]:
        """Result of :meth:`built` for the nominal machine, as (1, k), and :attr:`_constants`."""
        return self.built()[None], self._constants

    def _others(self, built: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``built`` (b, k) and the constants that all machines share.

        Raises:
            InputError: If a row of ``built`` does not have the k numbers of :meth:`built`, or if b
                does not divide the number of rows of ``inputs`` (..., 3).
        """
        rows, count = inputs.size // 3, len(built)
        if not count or rows % count:
            valid = f"parameters of b machines, with b a divisor of {rows} rows"
            raise InputError("built", built.shape, valid)
        nominal, constants = self._own
        return _rows(built, nominal.shape[1], "built"), constants


@cache
def _loops_of(module: str) -> Any:
    return import_module(module).LOOPS


def _rows(values: ArrayLike, length: int = 3, name: str = "vectors") -> FloatArray:
    """Convert vectors (..., length) to the type of array for which the loops are compiled."""
    plain = type(values) is np.ndarray and values.dtype.char == "d"  # the common case, fast
    array = np.ascontiguousarray(values if plain else numbers(name, values))
    if array.shape[-1] != length:
        raise InputError(f"shape of {name}", array.shape, f"(..., {length})")
    return array if array.flags.writeable else array.copy()


def _alike(values: ArrayLike, like: FloatArray) -> FloatArray:
    """Broadcast vectors to the shape of an array (..., 3)."""
    plain = type(values) is np.ndarray and values.dtype.char == "d"  # the common case, fast
    array: Any = values if plain else numbers("vectors", values)
    if array.shape != like.shape:  # broadcast_to() is slow, and its result has to be copied
        try:
            array = np.broadcast_to(array, like.shape)
        except ValueError as error:
            valid = f"{like.shape}, like theta, or one that broadcasts to it"
            raise InputError("shape of vectors", array.shape, valid) from error
    return _rows(array)


def _shaped(arrays: Iterable[Any], like: FloatArray) -> Iterator[Any]:
    """Replace the first axis of each array with the axes ``like.shape[:-1]``."""
    return (array.reshape(like.shape[:-1] + array.shape[1:]) for array in arrays)
