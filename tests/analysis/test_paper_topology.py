"""For each misprint of the topology section: the printed form is impossible, and ours holds.

Named after the equations; docs/paper.md lists them in words.
"""

import numpy as np
import oracle
import pytest

from tpm_gym.analysis.poc import POCSet, Subspace
from tpm_gym.analysis.topology import analyse, describe
from tpm_gym.kinematics import AssemblyMode, forward_all, inverse, inverse_all
from tpm_gym.kinematics.geometry import PAPER

X, Y, Z = np.eye(3)


@pytest.fixture(scope="module")
def structures():
    """The mechanism at random postures."""
    solutions = inverse_all(oracle.reachable_points(np.random.default_rng(0), 300, PAPER))
    found = []
    for theta in solutions.theta[solutions.valid][::100]:
        valid = forward_all(theta).valid
        for planar in (-1, 1):
            branch = AssemblyMode(planar, sin_beta=1)
            if valid[branch.index]:
                found.append(describe(theta, branch))
    assert len(found) > 20
    return found


def test_eq_3b_printed_has_a_sum_on_the_left(structures):
    """dim{...} of one j is one xi_Lj; the sum over j is 11, which no dim{...} can be."""
    xi = [loop.equations for loop in analyse(structures[0]).loops]
    assert xi == [6, 5]
    assert sum(xi) == 11 > 6


def test_dof_formula_of_loop_2_printed_sums_to_1(structures):
    loops = analyse(structures[0]).loops
    freedoms, xi = [loop.freedoms for loop in loops], [loop.equations for loop in loops]
    assert sum(freedoms) - sum(xi[:1]) == 8  # as printed, j = 1 to 1
    assert sum(freedoms) - sum(xi) == 3 == analyse(structures[0]).dof()


def test_eq_4_printed_m_i_t2_r2_contradicts_itself_and_is_t3_r2(structures):
    """With t^2 for branch I, Eq. (4) needs t^2 in common with branch II, xi_L1 needs t^3 in all."""
    rng = np.random.default_rng(2)
    branch_2 = Subspace.span([X, Z])
    for plane in [branch_2, *(Subspace.span(rng.normal(size=(2, 3))) for _ in range(50))]:
        printed = ((branch_2 & plane).dim, (branch_2 | plane).dim)
        assert printed in ((2, 2), (1, 3))
        assert printed != (2, 3)
    for structure in structures:
        m_1, m_2 = (chain.poc(structure.link_3p) for chain in structure.chains[:2])
        assert str(m_1) == "t^3 r^2"
        assert structure.chains[0].freedoms == m_1.dim == 5  # the 5 of (5 + 3) in Delta_1
        assert ((m_1 & m_2).dim, (m_1 | m_2).dim) == (2, 6)


def test_m_hsoc_1_printed_r1_perpendicular_to_bd_is_parallel_to_bd(structures):
    """Link 3' turns about every axis in the parallelogram's plane, and not about its normal.

    The normal is perpendicular to rod bd, so r(perpendicular to bd) may be just what the rods
    forbid. Read as the axis in the plane, it is ab again where the parallelogram is a rectangle.
    """
    rectangle = describe(inverse([PAPER.l2 + 0.8 * PAPER.l7, 0.6 * PAPER.l7, 0.75]))  # x_C1 = 0
    for structure in [*structures, rectangle]:
        unit = structure.branches[0].units[1]
        short, rod = unit.rotations
        rotations = unit.poc(unit.point).rotations
        ours = Subspace.span([short, rod])
        np.testing.assert_allclose(ours.projector, rotations.projector, atol=1e-9)
        assert (rotations & Subspace.span([np.cross(short, rod)])).dim == 0
    in_plane = np.cross(np.cross(short, rod), rod)
    assert Subspace.span([short, in_plane]).dim == 1 < rotations.dim == 2


def test_m_hsoc_2_printed_t1_parallel_to_r32_holds_at_y_0_only(structures):
    """The 4R parallelogram translates along the tangent in its plane, across its rods."""
    for structure in structures:
        unit = next(u for u in structure.branches[2].units if u.name == "Pa(4R)")
        (direction,) = unit.poc(unit.point).translations.basis
        assert abs(direction @ Y) < 1 - 1e-12
        sine = np.sqrt(1 - (direction @ Y) ** 2)
        assert sine == pytest.approx(
            abs(unit.point[1]) / PAPER.l4, rel=1e-6
        )  # rods tilt by asin(y/l4)


def test_xi_l2_printed_has_r12_r13_where_eq_3b_has_the_sub_mechanism(structures):
    """It prints t^2(perpendicular to R12) r^1(|| R13); M_Pa(1-2) is t^2 r^0, the plane y = 0."""
    for structure in structures:
        found = analyse(structure)
        printed = POCSet(Subspace.span([X, Y]), Subspace.span([Z]))
        assert str(found.sub_mechanism) == "t^2 r^0"
        assert np.abs(found.sub_mechanism.translations.basis @ Y).max() < 1e-9
        assert printed.dim == 3 > structure.wrist.freedoms == 2
        third = structure.branches[2].poc(structure.link_3p)
        assert (printed | third).dim == 5  # the number survives
        assert found.loops[1].equations == 5


def test_text_hsoc_2_printed_rpa_lacks_its_two_revolutes(structures):
    """R Pa(4R) alone has two freedoms; three translations and a rotation need R32 and R33 too."""
    for structure in structures:
        third = structure.branches[2]
        named = [unit for unit in third.units if unit.name in ("R31", "Pa(4R)")]
        assert sum(unit.freedoms for unit in named) == 2
        assert third.freedoms == third.poc(structure.platform).dim == 4
