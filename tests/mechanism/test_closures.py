"""A mechanism that three motors do not move in translation alone is refused when it is built."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import pytest
from gantry import GANTRY

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import PAPER_TPM, TPM
from tpm_gym.mechanism.bodies import STEEL, Closure, Joint, Link, Mechanism, Solid
from tpm_gym.mechanism.closures import require_sound

SOUND = PAPER_TPM.mechanism
A, B, C = PAPER_TPM.require_inverse(PAPER_TPM.home).tolist()
HOME = PAPER_TPM.joint_positions((A, B, C))


def test_the_machines_are_sound() -> None:
    """The check raises otherwise, as the tests below show."""
    require_sound(SOUND, HOME)
    require_sound(GANTRY.mechanism, GANTRY.joint_positions(GANTRY.home))  # a tree of slides


def with_joint(link: str, **changes: object) -> Mechanism:
    links = [
        replace(one, joint=replace(one.joint, **changes)) if one.name == link and one.joint else one
        for one in SOUND.links
    ]
    return replace(SOUND, links=tuple(links))


def with_closure(**changes: object) -> Mechanism:
    first, *rest = SOUND.closures
    return replace(SOUND, closures=(replace(first, **changes), *rest))


def with_solid(**changes: object) -> Mechanism:
    base, *others = SOUND.links
    box = replace(Solid("box", (0.1, 0.1, 0.1), (0.0, 0.0, 0.0), STEEL), **changes)
    return replace(SOUND, links=(replace(base, solids=(*base.solids, box)), *others))


BROKEN: dict[str, tuple[Callable[[], Mechanism], str]] = {
    "an open loop": (lambda: with_closure(point_a=(0.0, 0.8001, 0.0)), "0.0001 m apart"),
    "a turned joint": (lambda: with_joint("rod_6", rpy=(0.0, 0.0, 0.1)), "apart"),
    "a loop too few": (lambda: replace(SOUND, closures=SOUND.closures[1:]), "4 of platform"),
    "a loop too many": (
        lambda: replace(
            SOUND,
            closures=(
                *SOUND.closures,
                Closure("weld", "platform", SOUND.point_p, "base", PAPER_TPM.home),
            ),
        ),
        "0 of platform",
    ),
    "motors in one chain": (lambda: replace(SOUND, actuated=("R11", "R21", "R22")), "2 of"),
    "no such motor": (lambda: replace(SOUND, actuated=("R11", "R21", "R13b")), "'R13b'"),
    "no such link": (lambda: with_closure(link_b="link_3"), "'link_3'"),
    "two links of a name": (
        lambda: replace(SOUND, links=(*SOUND.links, SOUND.links[-1])),
        "links with a name each",
    ),
    "a child before its parent": (
        lambda: replace(SOUND, links=(SOUND.links[0], *SOUND.links[:0:-1])),
        "a link before",
    ),
    "a link without mass": (
        lambda: replace(SOUND, links=(Link("base", ()), *SOUND.links[1:])),
        "links with a mass",
    ),
    "a long axis": (lambda: with_joint("rod_6", axis=(0.0, 2.0, 0.0)), "axis of length 1"),
    "a fixed joint": (lambda: with_joint("rod_6", kind="fixed"), "continuous, revolute"),
    "a sphere": (lambda: with_solid(kind="sphere"), "boxes and cylinders"),
    "a box without a length": (lambda: with_solid(size=(0.1, -0.1, -0.1)), "positive size"),
    "a bore through all": (lambda: with_solid(bore=(0.2, 0.2, 0.2)), "smaller bore"),
    "a solid along xy": (lambda: with_solid(axis="xy"), "along x, y or z"),
    "a second base": (
        lambda: replace(SOUND, links=(*SOUND.links, Link("other", ()))),
        "first alone has no joint",
    ),
}


@pytest.mark.parametrize("name", list(BROKEN))
def test_it_is_refused_by_name(name: str) -> None:
    build, message = BROKEN[name]
    with pytest.raises(ConfigurationError, match=message):
        require_sound(build(), HOME)


def test_a_platform_that_turns_is_refused() -> None:
    links = list(GANTRY.mechanism.links)
    joint = Joint("turn", "revolute", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    links[1] = replace(links[1], joint=joint)
    turning = replace(
        GANTRY.mechanism, links=tuple(links), actuated=("turn", *GANTRY.mechanism.actuated[1:])
    )
    with pytest.raises(ConfigurationError, match="does not turn"):
        require_sound(turning, {"turn": 0.0, **GANTRY.joint_positions(GANTRY.home)})


@dataclass(frozen=True, kw_only=True)
class Loose(TPM):
    """The TPM with a loop that does not close."""

    @cached_property
    def mechanism(self) -> Mechanism:
        """Rods 4 too long by a millimetre."""
        return with_closure(point_a=(0.0, self.geometry.l4 + 1e-3, 0.0))


def test_no_machine_is_made_of_it() -> None:
    with pytest.raises(ConfigurationError, match="'Sc'"):
        Loose(**{one.name: getattr(PAPER_TPM, one.name) for one in fields(TPM)})
