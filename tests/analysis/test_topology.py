"""Eqs. (1) to (5) give the paper's numbers, and screw theory and the rank of the loops agree."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
from examples import examples
from hypothesis import example
from screws import common, projector, twists
from walk import gaps

from tpm_gym.analysis.poc import POCSet, Subspace
from tpm_gym.analysis.singularity import dimensionless
from tpm_gym.analysis.topology import Structure, analyse, describe, mobility
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import InputError, SingularityError, UnreachableError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    AssemblyMode,
    forward_all,
    inverse,
    inverse_all,
    jacobian,
)
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.closures import closure_jacobian
from tpm_gym.mechanism.tpm.bodies import ACTUATED_JOINTS, build, joint_angles

X, Y, Z = np.eye(3)


def same(a: Subspace, b: Subspace) -> bool:
    return bool(np.allclose(a.projector, b.projector, rtol=0, atol=1e-9))


def configurations(
    seed: int, count: int, g: Geometry = PAPER, clear: float = 1e-2
) -> list[tuple[FloatArray, AssemblyMode]]:
    """Return random angles with an assembly mode, ``clear`` (scaled) away from singularities."""
    rng = np.random.default_rng(seed)
    found = []
    for branch in ASSEMBLY_MODES:
        angles = rng.permutation(oracle.angles_on(branch, rng, count, g))
        factors = jacobian.factors(angles, branch, g)
        level = factors.elevation[:, None] / g.l4
        size = np.abs(np.concatenate([dimensionless(factors, g), level], axis=1))
        found += [(t, branch) for t in angles[(size > clear).all(axis=1)][: count // 4]]
    return found


# The mechanism


def assert_paper_topology(structure: Structure) -> None:
    first, second, third = (chain.poc(structure.link_3p) for chain in structure.chains)
    assert (str(first), str(second), str(third)) == ("t^3 r^2", "t^2 r^1", "t^3 r^2")
    found = analyse(structure)
    in_plane, everything = Subspace.span([X, Z]), Subspace.span(np.eye(3))
    assert str(found.sub_mechanism) == "t^2 r^0"
    assert same(found.sub_mechanism.translations, in_plane)
    for hsoc, axis in ((found.hsoc_1, Z), (found.hsoc_2, Y)):
        assert same(hsoc.translations, everything)
        assert same(hsoc.rotations, Subspace.span([axis]))
    assert str(found.platform) == "t^3 r^0"
    assert [loop.equations for loop in found.loops] == [6, 5]
    assert [loop.freedoms for loop in found.loops] == [8, 6]
    assert [loop.actuated for loop in found.loops] == [2, 1]
    assert [loop.constraint for loop in found.loops] == [0, 0]
    assert (found.dof(1), found.dof()) == (2, 3)
    assert found.coupling == (0, 0)


@examples(15, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_topology_is_the_paper_s_at_random_configurations(g, seed):
    """Nor do topology and mobility depend on lengths."""
    sample = configurations(seed, 60 if g == PAPER else 8, g)
    assert len(sample) > 40 or g != PAPER
    for theta, branch in sample:
        assert_paper_topology(describe(theta, branch, g))
        found = mobility(theta, branch, g)
        assert (found.dof, found.idle, str(found.platform)) == (3, 1, "t^3 r^0")


def test_structure_has_the_paper_s_joints():
    structure = describe(inverse([-0.04, 0.028, 0.8]))
    names = [[unit.name for unit in chain.units] for chain in structure.branches]
    assert names[0] == ["R11", "Pa(4S)"]
    assert names[1] == ["R21", "R22", "R23"]
    assert sorted(names[2]) == ["Pa(4R)", "R31", "R32", "R33"]
    assert [unit.name for unit in structure.wrist.units] == ["R12", "R13"]
    axes = {"R11": X, "R12": Z, "R13": Z} | {f"R{b}{i}": Y for b in (2, 3) for i in (1, 2, 3)}
    units = [unit for chain in structure.chains for unit in chain.units]
    assert {unit.name for unit in units if unit.actuated} == {"R11", "R21", "R31"}
    for unit in units:
        if unit.name in axes:
            assert same(Subspace.span(unit.rotations), Subspace.span([axes[unit.name]]))


def test_number_of_loops_is_m_minus_n_plus_1():
    structure = describe(inverse([-0.04, 0.028, 0.8]))
    m = sum(chain.freedoms for chain in structure.chains)  # joints of one freedom each
    n = 2 + sum(chain.freedoms - 1 for chain in structure.chains)  # base, link 3', links between
    assert (m, n, m - n + 1) == (14, 13, 2)
    assert len(analyse(structure).loops) == m - n + 1
    # Every pair and every rod: R11, 4 S, R21..23, R12, R13, R31..33, R_e..R_h; 2 rods in each Pa
    assert len(build().closures) == 17 - 14 + 1


def test_every_decomposition_has_the_same_freedoms_and_the_paper_s_couples_least():
    for theta, branch in configurations(2, 12):
        found = analyse(describe(theta, branch))
        assert len(found.decompositions) == 6
        totals = []
        for loops in found.decompositions:
            assert sum(loop.freedoms - loop.equations for loop in loops) == 3
            assert sum(loop.constraint for loop in loops) == 0
            totals.append(sum(abs(loop.constraint) for loop in loops) / 2)
        assert sorted(totals) == [0, 0, 2, 2, 3, 3]
        assert totals[0] == 0


# Screw theory: twists (velocity of the base point, angular velocity), no columns taken apart


def as_projector(poc: POCSet) -> FloatArray:
    result = np.zeros((6, 6))
    result[:3, :3], result[3:, 3:] = poc.translations.projector, poc.rotations.projector
    return result


def test_screw_theory_finds_the_same_sets():
    for theta, branch in configurations(3, 40, clear=0.03):
        structure = describe(theta, branch)
        found = analyse(structure)
        spaces = [projector(twists(chain, structure.link_3p)) for chain in structure.chains]
        for chain, space in zip(structure.chains, spaces, strict=True):
            np.testing.assert_allclose(space, as_projector(chain.poc(structure.link_3p)), atol=1e-9)
        sub = common(*spaces[:2])
        np.testing.assert_allclose(sub, as_projector(found.sub_mechanism), atol=1e-8)
        # xi is the dimension of the sum of the twist spaces
        sums = [
            np.trace(projector(np.concatenate(pair))) for pair in (spaces[:2], (sub, spaces[2]))
        ]
        assert np.round(sums).tolist() == [loop.equations for loop in found.loops]
        wrist = twists(structure.wrist, structure.platform)
        hsoc_1 = projector(np.concatenate([sub, wrist]))
        hsoc_2 = projector(twists(structure.branches[2], structure.platform))
        np.testing.assert_allclose(hsoc_1, as_projector(found.hsoc_1), atol=1e-8)
        np.testing.assert_allclose(hsoc_2, as_projector(found.hsoc_2), atol=1e-8)
        np.testing.assert_allclose(common(hsoc_1, hsoc_2), as_projector(found.platform), atol=1e-8)


# Mobility from the loops that the simulator closes


def joints_of_the_mechanism() -> list[str]:
    """Return all joints without the cup's slide, which is part of the tool."""
    joints = [link.joint.name for link in build().links if link.joint]
    return [name for name in joints if name != "cup_slide"]


def test_closure_jacobian_is_the_derivative_of_the_gaps():
    step = 1e-5
    for theta, branch in configurations(4, 8):
        angles = joint_angles(theta, branch)
        found = closure_jacobian(build(), angles)
        names = joints_of_the_mechanism()
        assert found.shape == (12, len(names))
        assert len(names) == len(angles) - 1
        for column, name in enumerate(names):
            up, down = angles | {name: angles[name] + step}, angles | {name: angles[name] - step}
            slope = (gaps(build(), up) - gaps(build(), down)).ravel() / (2 * step)
            np.testing.assert_allclose(found[:, column], slope, atol=1e-9, err_msg=name)


def test_mobility_by_rank_agrees_with_the_poc_count():
    sample = configurations(5, 120)
    assert len(sample) > 80
    for theta, branch in sample:
        found = mobility(theta, branch)
        assert (found.dof, found.idle) == (3, 1)
        assert (found.rank, found.redundant) == (11, 1)
        assert found.smallest > 1e-5
        assert str(found.platform) == "t^3 r^0"
        assert found.dof == analyse(describe(theta, branch)).dof()


def test_the_idle_freedom_is_end_link_10_about_its_own_axis():
    for theta, branch in configurations(6, 8):
        angles = joint_angles(theta, branch)
        rolled = angles | {"R33": angles["R33"] + 1.0}
        np.testing.assert_allclose(gaps(build(), rolled), gaps(build(), angles), atol=1e-12)
        still = np.linalg.norm(closure_jacobian(build(), angles), axis=0) < 1e-12
        names = joints_of_the_mechanism()
        assert [name for name, idle in zip(names, still, strict=True) if idle] == ["R33"]


def on_constraint_singularity(
    theta_1: float, side: int, offset: float = 0.0
) -> list[tuple[FloatArray, AssemblyMode]]:
    """Return configurations with z_C1 = z_B1 + offset."""
    point = oracle.level_rod_4(theta_1, np.arcsin(0.6), side, offset)
    solutions = inverse_all(point)
    found = []
    for theta in solutions.theta[solutions.valid]:
        forward = forward_all(theta)
        for branch in ASSEMBLY_MODES:
            near = np.abs(forward.position[branch.index] - point).max() < 1e-9
            if near and abs(theta[0] - theta_1) < 1e-9:
                found.append((theta, branch))
    return found


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("theta_1", [0.7, 0.9273, 1.2])
def test_both_counts_find_the_constraint_singularity(theta_1, side):
    sample = on_constraint_singularity(theta_1, side)
    assert sample
    for theta, branch in sample:
        found, topology = mobility(theta, branch), analyse(describe(theta, branch))
        assert (found.dof, found.idle, found.rank) == (4, 1, 10)
        assert str(topology.sub_mechanism) == "t^2 r^1"
        assert topology.dof() == 4
        with pytest.raises(InputError):
            _ = topology.coupling


@examples(6, oracle.geometries())
@example(PAPER)
def test_the_loops_of_all_passive_joints_have_no_other_singularity(g):
    """With the motors locked, the closures' volume is det A's factors, the constraint's, and zero
    else only where a rod lies along the first axis of the universal joint that it is given here."""
    mechanism, names = build(g), joints_of_the_mechanism()
    passive = [name not in (*ACTUATED_JOINTS, "R33") for name in names]
    shares = []
    for theta, branch in configurations(3, 40, g, clear=1e-3):
        columns = closure_jacobian(mechanism, joint_angles(theta, branch, g))[:, passive]
        volume = np.linalg.svd(columns, compute_uv=False).prod()
        factors, found = jacobian.factors(theta, branch, g), forward_all(theta, g)
        x_c, y = found.link3[branch.index, 0], found.position[branch.index, 1]
        universal = (1 - (x_c / g.l4) ** 2) * (1 - (y / g.l4) ** 2)
        shares.append(volume / abs(factors.parallel.prod() * factors.elevation * universal))
    assert len(shares) > 10
    # One row of the closures depends on the others; what it adds varies by a few per cent.
    np.testing.assert_allclose(shares, np.median(shares), rtol=0.1)


def test_the_task_region_keeps_clear_of_the_constraint_singularity():
    points = oracle.grid(PAPER_TPM.region.low, PAPER_TPM.region.high, (9, 9, 9))
    z_c = points[..., 2] - 2 * PAPER.l6
    assert (z_c - PAPER.l3 * np.sin(inverse(points)[..., 0])).min() > PAPER.l3


def test_doubtful_rank_raises():
    raised = 0
    for theta, branch in on_constraint_singularity(0.9273, 1, offset=1e-9):
        with pytest.raises(SingularityError):
            mobility(theta, branch)
        raised += 1
    assert raised
    for theta, branch in on_constraint_singularity(0.9273, 1, offset=1e-4):
        assert mobility(theta, branch).dof == 3


@pytest.mark.parametrize("y", [-PAPER.l7, PAPER.l7])
def test_at_the_edge_in_y_both_counts_lose_the_translation_but_no_freedom(y):
    theta, branch = inverse([-0.04, y, 0.8]), AssemblyMode(-1, int(np.sign(y)))
    found, topology = mobility(theta, branch), analyse(describe(theta, branch))
    assert found.dof == topology.dof() == 3
    for poc in (found.platform, topology.platform):
        assert same(poc.translations, Subspace.span([X, Z]))
        assert poc.rotations.dim == 0


def test_a_locked_joint_takes_a_freedom():
    structure = describe(inverse([-0.04, 0.028, 0.8]))
    first, second, third = structure.branches
    locked = replace(structure, branches=(first, replace(second, units=second.units[1:]), third))
    assert analyse(locked).dof() == 2


def test_unreachable_and_malformed_angles_raise():
    for function in (describe, mobility):
        with pytest.raises(UnreachableError):
            function([0.0, 0.0, np.pi])
        for wrong in ([0.0, np.nan, 0.0], [inverse([-0.04, 0.028, 0.8])], np.empty((0, 3))):
            with pytest.raises(InputError):
                function(wrong)
