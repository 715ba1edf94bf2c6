"""Modes, postures and layers of a Delta."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis.aspects import Cells
from tpm_gym.analysis.delta import aspects, reachable_set
from tpm_gym.arrays import FloatArray, vector
from tpm_gym.kinematics.namespaces import NUMPY
from tpm_gym.mechanism import Delta
from tpm_gym.mechanism.delta import bodies, equations, kinematics
from tpm_gym.mechanism.delta.geometry import ASSEMBLY_MODES, ELBOWS_OUT, WORKING_MODES
from tpm_gym.viewer.kinds.kind import Found, Kind, Posture, elbows
from tpm_gym.viewer.meshes import slice_mesh

_SHAPE: Final = (96, 96, 96)


class DeltaKind(Kind):
    """Kind of a Delta.

    A working mode is a tuple of three signs, one for each leg: 1 if the elbow is out, else -1.
    An assembly mode is 1 if P is below the elbows, and -1 if P is above them.
    """

    lists: Mapping[str, str] = {
        "Operation": "The platform only translates",
        "Elbows 1 / 2 / 3": "Working mode: how the three arms are bent",
        "Assembly": "Assembly mode: P is below (> 0) or above (< 0) the elbows",
    }
    working: Mapping[tuple[str, ...], Any] = {
        (words,): signs for words, signs in elbows(ELBOWS_OUT).items()
    }
    assembly: Mapping[str, Mapping[str, float]] = {
        "translating": {f"det A {'>' if side > 0 else '<'} 0": side for side in ASSEMBLY_MODES}
    }
    machine: Delta

    def at_point(
        self, position: ArrayLike, operation: str, working: Any, tilt: float = 0.0
    ) -> Posture:
        """See :class:`Kind`."""
        place, geometry = vector("position", position), self.machine.geometry
        theta = kinematics.inverse_all(place, geometry)[WORKING_MODES.index(working)]
        if np.isnan(theta).any():
            raise self.machine.unreachable(place)
        both = kinematics.forward_all(theta, geometry)
        side = int(np.linalg.norm(both - place, axis=-1).argmin())
        return self.at_joints(theta, ASSEMBLY_MODES[side])

    def at_joints(self, theta: ArrayLike, assembly: Any) -> Posture:
        """See :class:`Kind`."""
        angles, g = vector("theta", theta), self.machine.geometry
        with np.errstate(all="ignore"):
            at, real = equations.pose_at(tuple(map(np.float64, angles)), assembly, g, NUMPY)
        if not real:
            raise kinematics.no_assembly(angles, assembly, g)
        one, two, three = (1.0 if leg > 0 else -1.0 for leg in at.serial)
        working, place = (one, two, three), np.array(at.position)
        joints = bodies.joint_positions(at, angles, g.l4)
        quality = float(np.nan_to_num(kinematics.conditioning_at(place, working, g)))
        return Posture(self.machine, np.array(angles), place, working, assembly, joints, quality)

    def layers(self, posture: Posture) -> Mapping[str, Found]:
        """See :class:`Kind`."""
        working, assembly = posture.working, posture.assembly
        g, y = self.machine.geometry, posture.position[1]

        def found_aspects() -> list[Cells]:
            return [a.cells for a in aspects(working, g, _SHAPE) if a.assembly == assembly]

        def quality(points: FloatArray) -> FloatArray:
            ours = kinematics.factors_at(points, working, g).parallel * assembly > 0
            return np.where(ours, kinematics.conditioning_at(points, working, g), 0.0)

        middle, reach = (0.0, y, 0.0), g.l3 + g.l4 + abs(g.l1 - g.l2)
        return {
            "aspects": ((working, assembly), found_aspects),
            "workspace": (working, lambda: reachable_set(working, g, _SHAPE)),
            "conditioning": (
                (working, assembly, round(y, 4)),
                lambda: slice_mesh(middle, reach, quality),
            ),
        }
