"""The equation of motion of a mechanism in closed form, for points and batches.

torque = M(theta) theta_ddot + C(theta, theta_dot) theta_dot + g(theta)
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector, explained, finite, finite_points, numbers, vector
from tpm_gym.errors import ConfigurationError, InputError, SingularityError, UnreachableError
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.namespaces import Namespace, Numbers, by_rows, namespace_of
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.inertia import Bodies
from tpm_gym.mechanism.mount import GRAVITY

_REST = (0.0, 0.0, 0.0)


class Energy(NamedTuple):
    """Kinetic and potential energy in joules, (...,) each.

    The potential energy has an arbitrary offset, which is the same for all states of a machine.
    """

    kinetic: FloatArray
    potential: FloatArray


class Formulas(NamedTuple):
    """Functions of one mechanism, each given as (arguments) -> result.

    Attributes:
        build: (geometry) -> mechanism.
        inertia_of: (bodies, geometry) -> constants of the dynamics. Their attribute ``platform`` is
            the mass at P, kg.
        torques: (configuration, rates, changes of the rates, gravity, constants) -> torques, N m.
        masses: (configuration, Jacobian, constants) -> upper triangle of M, by rows, kg m^2.
        velocity: (configuration) -> rows of the Jacobian, m/rad.
        potential: (configuration, gravity, constants) -> potential energy, J.
    """

    build: Callable[[Any], Mechanism]
    inertia_of: Callable[[Bodies, Any], Any]
    torques: Callable[[Any, Triple, Triple, Triple, Any], Triple]
    masses: Callable[[Any, tuple[Triple, Triple, Triple], Any], tuple[Numbers, ...]]
    velocity: Callable[[Any], tuple[Triple, Triple, Triple]]
    potential: Callable[[Any, Triple, Any], Numbers]


@dataclass(frozen=True, kw_only=True)
class EquationOfMotion(ABC):
    """The dynamics of one mechanism, for points and batches.

    Joint positions (rad), velocities (rad/s) and accelerations (rad/s^2) are arrays (..., 3) that
    broadcast with each other. If an argument is a torch tensor, the results are tensors in float64,
    which can be differentiated.

    All methods raise InputError for inputs that are no arrays (..., 3) of finite numbers,
    UnreachableError if the assembly mode does not exist at some theta, and SingularityError at a
    parallel singularity.

    Attributes:
        geometry: Lengths.
        link_masses: Factors of mass and inertia, one for each moving link, in the mechanism's
            order; empty if all are 1.
        payload: Mass that the cup carries, kg.
        free_fall: Acceleration of gravity in the machine's frame, m/s^2.

    Raises:
        ConfigurationError: If a mass or gravity is not possible. A wrong number of factors raises
            this error at the first use.
    """

    geometry: Any
    link_masses: tuple[float, ...] = ()
    payload: float = 0.0
    free_fall: Vector = (0.0, 0.0, GRAVITY)

    _formulas: ClassVar[Formulas]

    def __post_init__(self) -> None:
        """Reject masses that are not possible; arrays become tuples."""
        if finite("payload", self.payload, (), ConfigurationError) < 0:
            raise ConfigurationError("payload", self.payload, "at least 0 kg")
        factors = numbers("link_masses", self.link_masses, ConfigurationError)
        if factors.ndim != 1 or not ((factors > 0) & (factors < math.inf)).all():
            raise ConfigurationError("link_masses", self.link_masses, "positive factors")
        object.__setattr__(self, "link_masses", tuple(factors.tolist()))
        vector("free_fall", self.free_fall, ConfigurationError)

    @cached_property
    def inertia(self) -> Any:
        """Constants of the bodies, with the payload."""
        bodies = Bodies(self._formulas.build(self.geometry), self.link_masses)
        found = self._formulas.inertia_of(bodies, self.geometry)
        return found._replace(platform=found.platform + self.payload)

    def torque(self, theta: ArrayLike, theta_dot: ArrayLike, theta_ddot: ArrayLike) -> FloatArray:
        """Compute the motors' torques (..., 3) N m, M theta_ddot + C theta_dot + g."""
        states = {"theta": theta, "theta_dot": theta_dot, "theta_ddot": theta_ddot}

        def results(pose: Any, rates: Triple, changes: Triple) -> list[Numbers]:
            return [self._torques(pose, rates, changes, self.free_fall)]

        return self._rows(results, states)[0]

    def gravity(self, theta: ArrayLike) -> FloatArray:
        """Compute the torques (..., 3) N m that hold the machine at rest."""
        return self._rows(
            lambda pose: [self._torques(pose, _REST, _REST, self.free_fall)], {"theta": theta}
        )[0]

    def mass_matrix(self, theta: ArrayLike) -> FloatArray:
        """Compute the mass matrix M, (..., 3, 3) kg m^2, symmetric and positive."""
        return self._rows(lambda pose: [self._masses(pose)], {"theta": theta})[0]

    def coriolis(self, theta: ArrayLike, theta_dot: ArrayLike) -> FloatArray:
        """Compute C (..., 3, 3) kg m^2/s from Christoffel's symbols; so dM/dt - 2 C is skew."""

        def results(pose: Any, rates: Triple) -> list[Numbers]:
            def quadratic(sign: float, k: int) -> Triple:
                a, b, c = (u + sign * (i == k) for i, u in enumerate(rates))
                return self._torques(pose, (a, b, c), _REST, _REST)

            # For the part q(u) of the torques that is quadratic, q(u + e) - q(u - e) = 4 C(u) e
            pairs = [(quadratic(1.0, k), quadratic(-1.0, k)) for k in range(3)]
            return [
                tuple(tuple((up[row] - down[row]) / 4 for up, down in pairs) for row in range(3))
            ]

        return self._rows(results, {"theta": theta, "theta_dot": theta_dot})[0]

    def forward(self, theta: ArrayLike, theta_dot: ArrayLike, torque: ArrayLike) -> FloatArray:
        """Compute accelerations (..., 3) rad/s^2 under the motors' torques (..., 3) N m."""

        def results(pose: Any, rates: Triple, given: Triple) -> list[Numbers]:
            bias = self._torques(pose, rates, _REST, self.free_fall)
            rest = tuple(one - other for one, other in zip(given, bias, strict=True))
            return [self._masses(pose), rest]

        states = {"theta": theta, "theta_dot": theta_dot, "torque": torque}
        mass, rest = self._rows(results, states)
        found: FloatArray = namespace_of(mass).solve(mass, rest)
        return found

    def energy(self, theta: ArrayLike, theta_dot: ArrayLike) -> Energy:
        """Compute kinetic and potential energy, (...,) J."""

        def results(pose: Any, rates: Triple) -> list[Numbers]:
            pairs = zip(self._masses(pose), rates, strict=True)
            twice = sum(u * m * v for row, u in pairs for m, v in zip(row, rates, strict=True))
            return [twice / 2, self._formulas.potential(pose, self.free_fall, self.inertia)]

        return Energy(*self._rows(results, {"theta": theta, "theta_dot": theta_dot}))

    @abstractmethod
    def _pose(self, theta: Triple, ns: Namespace) -> tuple[Any, Numbers, Numbers]:
        """Return the configuration at theta, whether it exists, and whether J exists there."""

    @abstractmethod
    def _refusal(self, theta: Vector) -> UnreachableError | SingularityError:
        """Explain why there is no equation of motion at theta (3,) rad."""

    def _torques(self, pose: Any, rates: Triple, changes: Triple, gravity: Triple) -> Triple:
        return self._formulas.torques(pose, rates, changes, gravity, self.inertia)

    def _masses(self, pose: Any) -> tuple[Triple, Triple, Triple]:
        upper = self._formulas.masses(pose, self._formulas.velocity(pose), self.inertia)
        a, b, c, d, e, f = upper
        return (a, b, c), (b, d, e), (c, e, f)

    def _rows(
        self, text: Callable[..., Sequence[Numbers]], states: Mapping[str, ArrayLike]
    ) -> list[FloatArray]:
        """Return the results of the function ``text`` for all rows of ``states``.

        ``states`` contains arrays (..., 3) by name, first theta. The arguments of ``text`` are the
        configuration at theta, and then the rows of the other arrays, in the arrays' order.
        """

        def results(values: tuple[Numbers, ...], ns: Namespace) -> list[Numbers]:
            theta, *rest = (values[i : i + 3] for i in range(0, len(values), 3))
            pose, real, regular = self._pose(theta, ns)
            return [ns.where(real & regular, 0.0, 1.0), *text(pose, *rest)]

        table = _side_by_side(states)
        missing, *found = by_rows(results, table)
        if missing.any():
            raise explained(self._refusal, table[..., :3], missing != 0)
        return found


def _side_by_side(states: Mapping[str, ArrayLike]) -> FloatArray:
    """Broadcast n arrays (..., 3) with each other, and join them to one (..., 3 n)."""
    arrays = [finite_points(name, state) for name, state in states.items()]
    try:
        table: FloatArray = namespace_of(*arrays).join(arrays)
    except (ValueError, RuntimeError) as error:  # numpy's and torch's
        shapes = [tuple(array.shape) for array in arrays]
        valid = "of shapes (..., 3) that go together"
        raise InputError(", ".join(states), shapes, valid) from error
    return table
