"""Vacuum law of the cup for one time step, the same for all engines.

Air flows as through a nozzle: the pressure approaches that of the ejector, or the ambient pressure,
exponentially. The seal holds as long as pressure and friction of the lip bear the load. An engine
supplies the force between cup and object, and the object that the lip touches
(:func:`tpm_gym.mechanism.cup.sealed`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from tpm_gym.mechanism.cup import CUP, VacuumCup

__all__ = ["CLEARANCE", "EMPTY", "Hold", "Load", "hold_after", "holds", "pressure_after"]

CLEARANCE = 2e-5
"""Gap between lip and sealed face, m, so that contact and seal do not fight."""


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
        tension: Along the cup's axis, N; negative where they are pressed together.
        shear: Length of the part across it, N.
    """

    tension: float = 0.0
    shear: float = 0.0


def pressure_after(vacuum: float, time_step: float, pumped: bool, cup: VacuumCup = CUP) -> float:
    """Return the vacuum (Pa) a time step (s) later; ``pumped`` if it is on and the lip sealed."""
    final, time = (cup.vacuum, cup.evacuation_time) if pumped else (0.0, cup.venting_time)
    return final + (vacuum - final) * math.exp(-time_step / time)


def holds(vacuum: Any, load: tuple[Any, Any], cup: VacuumCup = CUP) -> Any:
    """Return whether a seal bears a load (tension and shear, N) at a vacuum (Pa); arrays too.

    Pull and shear combine as the norm of the force. Pressure on the object is no pull, and lets
    the lip's friction bear a part of the shear.
    """
    tension, shear = load
    pull = (tension > 0) * tension
    slip = shear + cup.seal_friction * (tension - pull)
    slip = (slip > 0) * slip
    most = cup.area * vacuum
    return pull * pull + slip * slip <= most * most


def hold_after(
    hold: Hold, time_step: float, on: bool, load: Load, touched: int, cup: VacuumCup = CUP
) -> Hold:
    """Return held object and vacuum after a time step.

    Args:
        hold: Held object and vacuum in the time step.
        time_step: s.
        on: Whether the vacuum is on.
        load: Load of the seal in the time step; ignored if nothing was held.
        touched: Index of an object on which the lip could seal now; -1 for none. Ignored if an
            object was held. A cup that has lost an object seals again after it is vented.
        cup: The cup.
    """
    if hold.which >= 0:
        vacuum = pressure_after(hold.vacuum, time_step, on, cup)
        if holds(vacuum, load, cup) and (on or vacuum > cup.least_vacuum):
            return Hold(hold.which, vacuum)
    elif on and touched >= 0 and hold.vacuum <= cup.least_vacuum:
        return Hold(touched, pressure_after(hold.vacuum, time_step, True, cup))
    return Hold(-1, pressure_after(hold.vacuum, time_step, False, cup))
