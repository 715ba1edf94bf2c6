"""Vacuum law of the cup for one time step, used by all engines.

The pressure in the cup approaches the ejector's pressure (vacuum on) or the ambient pressure
(vacuum off) exponentially. The object is lost when the load exceeds the force that vacuum and lip
friction can transmit. The engine computes the load. It also calls
:func:`tpm_gym.mechanism.cup.sealed` to find the object that the lip touches.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from tpm_gym.mechanism.cup import CUP

CLEARANCE = 2e-5
"""Gap between lip and held object, m.

PyBullet and MuJoCo fix the held object to the cup by a weld. Without a gap, the contact between lip
and object would push against the weld.
"""


class Hold(NamedTuple):
    """Held object and vacuum.

    Attributes:
        which: Index of the held object; -1 for none.
        vacuum: Pressure in the cup below the ambient pressure, Pa.
    """

    which: int = -1
    vacuum: float = 0.0


EMPTY = Hold()


class Load(NamedTuple):
    """Force between the cup and the held object.

    Attributes:
        tension: Force along the cup's axis, N; negative if cup and object are pressed together.
        shear: Norm of the force perpendicular to the cup's axis, N.
    """

    tension: float = 0.0
    shear: float = 0.0


def pressure_after(vacuum: float, time_step: float, pumped: bool) -> float:
    """Compute the vacuum (Pa) after a time step (s); ``pumped``: vacuum is on and lip is sealed."""
    final, time = (CUP.vacuum, CUP.evacuation_time) if pumped else (0.0, CUP.venting_time)
    return final + (vacuum - final) * math.exp(-time_step / time)


def holds(vacuum: Any, load: tuple[Any, Any]) -> Any:
    """Return whether a vacuum (Pa) can carry a load (tension and shear, N); floats or arrays.

    sqrt(tension^2 + shear^2) must not exceed the vacuum times the cup's area. If cup and object
    are pressed together, the tension counts as zero, and lip friction carries a part of the shear.
    """
    tension, shear = load
    pull = (tension > 0) * tension
    slip = shear + CUP.seal_friction * (tension - pull)
    slip = (slip > 0) * slip
    most = CUP.area * vacuum
    return pull * pull + slip * slip <= most * most


def hold_after(hold: Hold, time_step: float, on: bool, load: Load, touched: int) -> Hold:
    """Compute held object and vacuum after a time step.

    A cup that has lost an object can hold an object again only after the vacuum has fallen to
    ``CUP.least_vacuum``.

    Args:
        hold: Held object and vacuum in the time step.
        time_step: Time step, s.
        on: Whether the vacuum is on.
        load: Load of the seal in the time step; ignored if no object was held.
        touched: Index of an object on which the lip can seal now; -1 for none. Ignored if an
            object was held.
    """
    if hold.which >= 0:
        vacuum = pressure_after(hold.vacuum, time_step, on)
        if holds(vacuum, load) and (on or vacuum > CUP.least_vacuum):
            return Hold(hold.which, vacuum)
    elif on and touched >= 0 and hold.vacuum <= CUP.least_vacuum:
        return Hold(touched, pressure_after(hold.vacuum, time_step, True))
    return Hold(-1, pressure_after(hold.vacuum, time_step, False))
