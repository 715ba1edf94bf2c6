"""Measure the convergence of sequential impulses on the closures, and the error of each solver.

    python benchmarks/gauss_seidel.py

Sequential impulses are the Gauss-Seidel method on W lambda = b. W = G M^-1 G^T couples all rows:
three motors, the spring of the cup, and three rows for each ball. Bullet sweeps the rows forwards
and backwards in turns. The error shrinks by the largest eigenvalue of this double sweep, except for
the eigenvalue 1 of the one redundant combination of closures, which has no effect. G and M come
from the engine; the order of the rows is ours.

One step from rest then shows whether a solver solves W lambda = b. The rates of motors and closures
should be zero; the script prints the largest rate that the engine leaves.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from fidelity_lab import Config, Rig

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism import PAPER_TPM

HEIGHTS = (0.002, 0.005, 0.012, 0.020, 0.030, 0.046)
"""y of point P, m; the task region starts at 12 mm."""


def constraint_rows(rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Return G (rows, joints) and the mass matrix M (joints, joints) at the pose of the rig.

    Rows are the motors, the slide of the cup, and x, y, z of each closure. The rig must be one
    multibody.
    """
    client, robot, mechanism = rig.client, rig.robot, rig.variant.mechanism
    body = robot.bodies[0]
    count = client.getNumJoints(body)
    angles = [client.getJointState(body, i)[0] for i in range(count)]
    rest = [0.0] * count
    rows = [np.eye(count)[robot.joints[name][1]] for name in (*mechanism.actuated, "cup_slide")]

    def jacobian_of(link: str, point: Any) -> FloatArray:
        local = np.asarray(point) - mechanism.link(link).centre_of_mass
        address = robot.links[link][1]
        return np.array(
            client.calculateJacobian(body, address, local.tolist(), angles, rest, rest)[0]
        )

    for c in mechanism.closures:
        rows.extend(jacobian_of(c.link_a, c.point_a) - jacobian_of(c.link_b, c.point_b))
    return np.array(rows), np.array(client.calculateMassMatrix(body, angles))


def iterations_per_decade(coupling: FloatArray) -> float:
    """Compute the iterations in which symmetric Gauss-Seidel on W gains a decimal digit."""
    scale = np.sqrt(np.diag(coupling))
    unit = coupling / np.outer(scale, scale)
    identity = np.eye(len(unit))
    forwards = identity - np.linalg.solve(np.tril(unit), unit)
    backwards = identity - np.linalg.solve(np.triu(unit), unit)
    factors = np.sort(np.abs(np.linalg.eigvals(backwards @ forwards)))[::-1]
    slowest = factors[factors < 1 - 1e-9][0]
    return float(2 / -np.log10(slowest))


def convergence() -> None:
    """Print the iterations per decimal digit over the task region, by y."""
    rig = Rig(Config("", "", variant="one body"))
    low, high = PAPER_TPM.region.low, PAPER_TPM.region.high
    print("iterations of sequential impulses a decimal digit, over x and z of the task region")
    for y in HEIGHTS:
        counts = []
        for x, z in product(np.linspace(low[0], high[0], 7), np.linspace(low[2], high[2], 5)):
            rig.place(PAPER_TPM.inverse((x, y, z)))
            rows, mass = constraint_rows(rig)
            counts.append(iterations_per_decade(rows @ np.linalg.solve(mass, rows.T)))
        print(f"  y = {1e3 * y:4.0f} mm: median {np.median(counts):4.0f}, most {max(counts):4.0f}")
    rig.close()


def left_over(config: Config, point: Vector) -> float:
    """Measure the largest rate of motors and closures after one step, rad/s or m/s.

    The mechanism starts at rest at ``point``, and its motors have to hold it, so that all rates
    should be zero.
    """
    theta = PAPER_TPM.inverse(point)
    whole = Rig(Config("", "", variant="one body"))
    whole.place(theta)
    rows, _ = constraint_rows(whole)
    names = {index: name for name, (_, index) in whole.robot.joints.items()}
    whole.close()
    rig = Rig(config)
    rig.place(theta)
    rig.drive(list(theta))
    rig.step()
    rates = np.array(
        [rig.client.getJointState(*rig.robot.joints[names[i]])[1] for i in range(len(names))]
    )
    rig.close()
    return float(np.abs(rows @ rates).max())


def one_step() -> None:
    """Print the largest rate after one step, by solver, in one multibody and in three."""
    point = PAPER_TPM.home
    print("largest rate left of motors and closures after one step from rest (rad/s, m/s)")
    for variant in ("one body", "three legs"):
        for solver, iterations in (("direct", 50), ("lcp pgs", 3000), ("iterative", 3000)):
            config = Config("", "", variant, solver, iterations=iterations, residual=0.0)
            name = f"{variant}, {solver}" + ("" if solver == "direct" else f", {iterations} it.")
            print(f"  {name:<28} {left_over(config, point):.1e}")


if __name__ == "__main__":
    convergence()
    one_step()
