"""The vacuum in the cup, the same law for all engines, a time step at a time.

Air flows in and out as through a nozzle: the pressure approaches that of the ejector, or the
ambient's, as an exponential. The seal bears a load as long as atmosphere and lip's friction do.
What an engine has to say: the force between cup and object, and what the lip touches
(:func:`tpm_gym.mechanism.cup.sealed`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from tpm_gym.mechanism.cup import CUP, VacuumCup

__all__ = ["CLEARANCE", "EMPTY", "Hold", "Load", "hold_after", "holds", "pressure_after"]

CLEARANCE = 2e-5
"""Between the lip and the face that it has sealed on, m: else contact and seal would fight."""


class Hold(NamedTuple):
    """What the cup holds.

    Attributes:
        which: Index of the object; -1 for none.
        vacuum: How far the pressure in the cup is below the ambient's, Pa.
    """

    which: int = -1
    vacuum: float = 0.0


EMPTY = Hold()


class Load(NamedTuple):
    """The force between the cup and what it holds.

    Attributes:
        tension: Along the cup's axis, N; negative where they are pressed together.
        shear: Length of the part across it, N.
    """

    tension: float = 0.0
    shear: float = 0.0


def pressure_after(vacuum: float, time_step: float, pumped: bool, cup: VacuumCup = CUP) -> float:
    """The vacuum (Pa) a time step (s) later; ``pumped`` where it is on and the lip is sealed."""
    final, time = (cup.vacuum, cup.evacuation_time) if pumped else (0.0, cup.venting_time)
    return final + (vacuum - final) * math.exp(-time_step / time)


def holds(vacuum: Any, load: tuple[Any, Any], cup: VacuumCup = CUP) -> Any:
    """Whether a seal bears a load (tension and shear, N) at that vacuum (Pa); arrays too.

    Pull and shear count together, by the length of the force. What presses the lip on the object
    is no pull, and lets the lip's friction bear some of the shear.
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
    """What the cup holds after a time step.

    Args:
        hold: What it held in that time step.
        time_step: s.
        on: Whether the vacuum is on.
        load: What the seal bore in that time step; of no meaning where nothing was held.
        touched: Index of an object that the lip could seal on now; -1 for none. Looked at where
            nothing was held. A cup that has lost an object seals anew when it is vented.
        cup: The cup.
    """
    if hold.which >= 0:
        vacuum = pressure_after(hold.vacuum, time_step, on, cup)
        if holds(vacuum, load, cup) and (on or vacuum > cup.least_vacuum):
            return Hold(hold.which, vacuum)
    elif on and touched >= 0 and hold.vacuum <= cup.least_vacuum:
        return Hold(touched, pressure_after(hold.vacuum, time_step, True, cup))
    return Hold(-1, pressure_after(hold.vacuum, time_step, False, cup))
