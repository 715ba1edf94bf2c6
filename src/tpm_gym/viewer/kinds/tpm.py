"""Modes, postures and layers of the paper's mechanism."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym import kinematics
from tpm_gym.analysis.aspects import Cells, aspects, reachable_set
from tpm_gym.analysis.singularity import FACTORS, nearest_singularity
from tpm_gym.arrays import FloatArray, vector
from tpm_gym.errors import InputError
from tpm_gym.kinematics import jacobian, rotated
from tpm_gym.kinematics.workspace import assembly_of
from tpm_gym.mechanism.tpm import TPM, bodies
from tpm_gym.simulation.state import State
from tpm_gym.viewer.kinds.kind import Found, Kind, Margin, Posture, elbows
from tpm_gym.viewer.meshes import SURFACES, slice_mesh, surface

_LINK_7: Final = {"towards +x": 1, "towards -x": -1}
_FINE: Final = (96, 24, 128)


def _label(mode: kinematics.AssemblyMode | kinematics.RotatedMode) -> str:
    parts = [f"planar {'+' if mode.planar > 0 else '-'}"]
    if isinstance(mode, kinematics.RotatedMode):
        parts.append("larger tilt" if mode.further > 0 else "smaller tilt")
    parts.append(f"y {'>' if mode.sin_beta > 0 else '<'} 0")
    return ", ".join(parts)


class TPMKind(Kind):
    """Kind of a TPM.

    Its working modes are WorkingModes. Its assembly modes are AssemblyModes in translating
    operation, and RotatedModes in rotated operation.
    """

    lists: Mapping[str, str] = {
        "Operation": "Link 3' only translates, or is turned about y",
        "Elbows 1 / 2 / 3": "Working mode: how the three arms are bent",
        "Link 7": "Working mode: sign of cos(beta)",
        "Assembly": (
            "Assembly mode: signs of the planar factor and of sin(beta), which is that of y"
        ),
    }
    assembly: Mapping[str, Mapping[str, Any]] = {
        "translating": {_label(mode): mode for mode in kinematics.ASSEMBLY_MODES},
        "rotated": {_label(mode): mode for mode in kinematics.ROTATED_MODES},
    }
    lows = (-180.0, 0.0, -180.0)
    machine: TPM

    def __init__(self, machine: TPM) -> None:
        """Store the machine, and label its working modes.

        An elbow that is bent as in the machine's own working mode has the label "out". Other
        elbows have the label "in".
        """
        super().__init__(machine)
        self.working = {
            (words, side): kinematics.WorkingMode(cos_beta, *signs)
            for words, signs in elbows(machine.working_mode.signs[1:]).items()
            for side, cos_beta in _LINK_7.items()
        }

    # -- postures -----------------------------------------------------------------------------

    def at_point(
        self, position: ArrayLike, operation: str, working: Any, tilt: float = 0.0
    ) -> Posture:
        """See :class:`Kind`."""
        place, lengths = np.array(vector("position", position)), self.machine.geometry
        if operation == "translating":
            theta = kinematics.inverse(place, working, lengths)
            assembly = kinematics.ASSEMBLY_MODES[int(assembly_of(place, working, lengths))]
            return self._straight(theta, place, working, assembly)
        found = kinematics.inverse_rotated(place, lengths)
        serial = rotated.factors(found).serial
        ours = found.valid & ((serial > 0) == (np.array(working.signs) > 0)).all(axis=-1)
        if not ours.any():
            valid = "where link 3' can be turned in this working mode; "
            others = int(found.valid.sum())
            valid += (
                f"other working modes have {others} such postures here" if others else "none has"
            )
            raise InputError("position", tuple(place.round(4).tolist()), valid)
        one = _slot(found, int(np.where(ours, abs(found.tilt - tilt), np.inf).argmin()))
        every = kinematics.forward_rotated(one.theta, lengths)
        apart = abs(every.tilt - one.tilt) + abs(every.beta - one.beta)
        index = int(np.where(every.valid, apart, np.inf).argmin())
        return self._turned(one, working, kinematics.ROTATED_MODES[index])

    def at_joints(self, theta: ArrayLike, assembly: Any) -> Posture:
        """See :class:`Kind`."""
        angles, lengths = np.array(vector("theta", theta)), self.machine.geometry
        if isinstance(assembly, kinematics.RotatedMode):
            found = kinematics.forward_rotated(angles, lengths)
            if not found.valid[assembly.index]:
                valid = f"where this rotated assembly exists; {int(found.valid.sum())} others do"
                raise InputError("theta", tuple(angles.round(4).tolist()), valid)
            one = _slot(found, assembly.index)
            return self._turned(one, _working(rotated.factors(one).serial), assembly)
        place = kinematics.forward(angles, assembly, lengths)
        working = _working(jacobian.factors(angles, assembly, lengths).serial)
        return self._straight(angles, place, working, assembly)

    def of_state(self, state: State) -> Posture:
        """See :class:`Kind`."""
        # Joint positions are equal on both sides of y = 0, the assembly modes are not.
        y = self.machine.mount.to_paper(state.fk_position)[1]
        mode = replace(self.machine.assembly_mode, sin_beta=-1 if y < 0 else 1)
        return self.at_joints(state.theta, mode)

    def _straight(
        self,
        theta: FloatArray,
        place: FloatArray,
        working: kinematics.WorkingMode,
        assembly: kinematics.AssemblyMode,
    ) -> Posture:
        """Return a posture of the translating operation mode: link 3' is parallel to x."""
        joints = bodies.joint_angles(theta, assembly, self.machine.geometry)
        quality = float(jacobian.conditioning(theta, assembly, self.machine.geometry))
        return Posture(self.machine, theta, place, working, assembly, joints, quality)

    def _turned(
        self,
        one: kinematics.RotatedPostures,
        working: kinematics.WorkingMode,
        mode: kinematics.RotatedMode,
    ) -> Posture:
        """Return a posture of the rotated operation mode: link 3' is turned about y."""
        joints = {name: float(angle) for name, angle in bodies.rotated_joint_arrays(one).items()}
        sizes = np.linalg.svd(np.nan_to_num(rotated.velocity(one)[:3]), compute_uv=False)
        quality = float(sizes[2] / sizes[0]) if sizes[0] > 0 else 0.0
        place, tilt = one.position, float(one.tilt)
        return Posture(
            self.machine, one.theta, place, working, mode, joints, quality, "rotated", tilt
        )

    # -- layers -------------------------------------------------------------------------------

    def layers(self, posture: Posture) -> Mapping[str, Found]:
        """See :class:`Kind`; only the translating operation mode has layers."""
        if posture.operation == "rotated":
            return {}
        working, assembly = posture.working, posture.assembly
        g, y, side = self.machine.geometry, posture.position[1], assembly.sin_beta

        def surfaces(factors: tuple[str, ...]) -> Found:
            return working, lambda: {name: surface(name, working, g) for name in factors}

        def found_aspects() -> list[Cells]:
            """Find the aspects on P's side of y = 0; the other side has their mirror images."""
            return [a.cells for a in aspects(working, g) if a.assembly.sin_beta == side]

        def quality(points: FloatArray) -> FloatArray:
            return jacobian.conditioning_at(points, working, assembly, g)

        middle, reach = (g.l2, y, 0.0), g.l3 + g.l4
        return {
            **{name: surfaces(factors) for name, factors in SURFACES.items()},
            "aspects": ((working, side), found_aspects),
            "workspace": (working, lambda: reachable_set(working, g, _FINE)),
            "conditioning": (
                (working, assembly, round(y, 4)),
                lambda: slice_mesh(middle, reach, quality),
            ),
            "margin": (tuple(posture.position), lambda: self.margin(posture)),
        }

    def margin(self, posture: Posture) -> Margin | None:
        """Find the nearest singular position of P.

        The search takes 5 to 10 ms, longer than solving a posture.
        """
        modes = posture.working, posture.assembly
        found = nearest_singularity(posture.position, *modes, self.machine.geometry)
        if not found.valid:
            return None
        return Margin(float(found.distance), found.point, FACTORS[int(found.factor)])


def _slot(found: kinematics.RotatedPostures, slot: int) -> kinematics.RotatedPostures:
    """Return the posture at index ``slot``."""
    theta, link3, tilt, beta = found.theta[slot], found.link3[slot], found.tilt[slot], found.beta
    return kinematics.RotatedPostures(theta, link3, tilt, beta[slot], found.geometry)


def _working(serial: FloatArray) -> kinematics.WorkingMode:
    """Return the working mode whose four signs are those of the values ``serial`` (4,).

    ``serial`` has the factors that are zero at serial singularities.
    """
    return kinematics.WORKING_MODES[int(((serial > 0) * [8, 4, 2, 1]).sum())]
