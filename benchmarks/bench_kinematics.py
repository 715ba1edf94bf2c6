"""How fast the kinematics are, as ratios to a floor and to a general solver in the same run.

    make bench-kinematics

The floor of the batched functions is numpy's sine and cosine of as many angles as the inputs hold:
no method that evaluates the mechanism's trigonometry in numpy can be faster. The peer of the single
call is scipy.optimize.root on the three closure equations, started 20 mm beside the solution; that
of the conditioning, from angles, is numpy's SVD alone, of Jacobians that are given.
"""

from __future__ import annotations

import os
import platform
import statistics
import time
import tracemalloc
from collections.abc import Callable

import numpy as np
from scipy.optimize import root

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import (
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    equations,
    forward,
    forward_all,
    inverse,
    inverse_all,
    jacobian,
)
from tpm_gym.kinematics.geometry import PAPER

ROWS, REPEATS, CALLS = 1_000_000, 7, 300
TARGETS = {"forward_all": 4.0, "inverse_all": 10.0}


def seconds(function: Callable[[], object]) -> float:
    """Wall-clock seconds of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def peak_megabytes(function: Callable[[], object]) -> float:
    """Most memory that numpy and Python held during one call, beyond what they held before."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def closure(position: FloatArray, theta: FloatArray) -> FloatArray:
    """|B_iC_i|^2 - l4^2 (m^2) for point P on the branch cos(beta) > 0."""
    g = PAPER
    x, y, z = position
    x_c = x - g.l2 - np.sqrt(max(0.0, g.l7**2 - y**2))
    z_c = z - 2 * g.l6
    c, s = g.l3 * np.cos(theta), g.l3 * np.sin(theta)
    return np.array(
        [
            x_c**2 + (g.l1 + c[0]) ** 2 + (z_c - s[0]) ** 2,
            (x_c - 2 * g.l5 + g.l1 - c[1]) ** 2 + (z_c - s[1]) ** 2,
            (x + g.l2 - g.l1 - c[2]) ** 2 + y**2 + (z - g.l6 - s[2]) ** 2,
        ]
    ) - (g.l4**2)


def report(name: str, ratios: list[float], detail: str) -> None:
    """One line: median ratio and its spread."""
    low, high = min(ratios), max(ratios)
    print(f"{name:<12} {statistics.median(ratios):7.2f}  [{low:.2f}, {high:.2f}]  {detail}")


def batched() -> None:
    """forward_all and inverse_all against the floor, alternating."""
    rng = np.random.default_rng(0)
    theta = rng.uniform(-np.pi, np.pi, (ROWS, 3))
    position = rng.uniform((-0.6, -0.05, 0.2), (0.6, 0.05, 1.1), (ROWS, 3))
    ratios: dict[str, list[float]] = {name: [] for name in TARGETS}
    times: dict[str, list[float]] = {name: [] for name in (*TARGETS, "floor")}
    for _ in range(REPEATS):
        floor = seconds(lambda: (np.sin(theta), np.cos(theta)))
        times["floor"].append(floor)
        for name, function in (
            ("forward_all", lambda: forward_all(theta)),
            ("inverse_all", lambda: inverse_all(position)),
        ):
            taken = seconds(function)
            times[name].append(taken)
            ratios[name].append(taken / floor)
    print(
        f"sine and cosine of {ROWS:,} x 3 angles: {1e3 * statistics.median(times['floor']):.0f} ms"
    )
    peaks = {
        "forward_all": peak_megabytes(lambda: forward_all(theta)),
        "inverse_all": peak_megabytes(lambda: inverse_all(position)),
    }
    for name, target in TARGETS.items():
        detail = (
            f"times the floor (target: at most {target:.0f}); "
            f"{1e3 * statistics.median(times[name]):.0f} ms, peak {peaks[name]:.0f} MB"
        )
        report(name, ratios[name], detail)


def conditioning() -> None:
    """Of a batch of joint angles, against numpy's SVD of their Jacobians, alternating."""
    rng = np.random.default_rng(2)
    theta = inverse(rng.uniform((-0.2, 0.015, 0.7), (0.1, 0.042, 0.9), (ROWS // 10, 3)))
    matrices, ratios, times = jacobian.velocity(theta), [], []
    for _ in range(REPEATS):
        peer = seconds(lambda: np.linalg.svd(matrices, compute_uv=False))
        times.append(seconds(lambda: jacobian.conditioning(theta)))
        ratios.append(peer / times[-1])
    detail = "times faster than numpy's SVD (target: at least 5)"
    report(
        "conditioning",
        ratios,
        f"{detail}; {1e9 * statistics.median(times) / len(theta):.0f} ns a row",
    )


def one_call() -> None:
    """What one configuration costs at every time step, and through the public functions."""
    point = (-0.04, 0.028, 0.80)
    theta = equations.posture(point, ELBOWS_OUT, PAPER)
    array, angles = np.array(point), np.array(theta)
    calls: dict[str, Callable[[], object]] = {
        "posture": lambda: equations.posture(point, ELBOWS_OUT, PAPER),
        "assemble": lambda: equations.assemble(theta, DEFAULT_ASSEMBLY, PAPER),
        "evaluate": lambda: equations.evaluate(theta, DEFAULT_ASSEMBLY, PAPER),
        "inverse": lambda: inverse(array),
        "forward": lambda: forward(angles),
        "jacobian.evaluate": lambda: jacobian.evaluate(angles),
    }
    for name, call in calls.items():
        each = [
            1e6 * seconds(lambda call=call: [call() for _ in range(2000)]) / 2000 for _ in range(15)
        ]
        print(
            f"{name:<18} {statistics.median(each):6.2f}  [{min(each):.2f}, {max(each):.2f}]  us a call"
        )


def single() -> None:
    """One forward call against scipy.optimize.root, alternating."""
    rng = np.random.default_rng(1)
    points = rng.uniform((-0.2, 0.015, 0.7), (0.1, 0.042, 0.9), (CALLS, 3))
    ratios, ours, peers, errors = [], [], [], []
    for point in points:
        theta = inverse(point)
        start = point + rng.uniform(-1, 1, 3) * (0.02, 0.002, 0.02)
        taken = seconds(lambda theta=theta: forward(theta))
        begun = time.perf_counter()
        found = root(closure, start, args=(theta,), tol=1e-12)
        peers.append(time.perf_counter() - begun)
        ours.append(taken)
        ratios.append(peers[-1] / taken)
        errors.append(float(np.linalg.norm(found.x - point)))
    quartiles = statistics.quantiles(ratios, n=4)
    print(
        f"{'forward':<12} {quartiles[1]:7.2f}  [{quartiles[0]:.2f}, {quartiles[2]:.2f}]  "
        f"times faster than scipy.optimize.root (target: at least 10; quartiles); "
        f"{1e6 * statistics.median(ours):.0f} us against {1e6 * statistics.median(peers):.0f} us; "
        f"scipy found the point in {sum(e < 1e-8 for e in errors)} of {CALLS}"
    )


def main() -> None:
    """Print the table."""
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
          f"numpy {np.__version__}; median and range of {REPEATS} runs")  # fmt: skip
    batched()
    conditioning()
    single()
    one_call()


if __name__ == "__main__":
    main()
