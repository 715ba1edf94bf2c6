"""Measure the speed of the kinematics as ratios to a floor and to general solvers.

    make bench-kinematics

The floor of the batched functions is numpy's sine and cosine of all input angles: no evaluation of
the mechanism's trigonometry in numpy can be faster. The single call is compared with
scipy.optimize.root on the three closure equations, started 20 mm from the solution. The
conditioning is compared with numpy's SVD of the Jacobians.
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
from tpm_gym.kinematics import forward, forward_all, inverse, inverse_all, jacobian
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.mechanism import PAPER_TPM

ROWS, REPEATS, CALLS = 1_000_000, 7, 300
TARGETS = {"forward_all": 4.0, "inverse_all": 10.0}


def seconds(function: Callable[[], object]) -> float:
    """Measure the wall-clock seconds of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def peak_megabytes(function: Callable[[], object]) -> float:
    """Measure the peak of the additional memory of numpy and Python during one call, MB."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def closure(position: FloatArray, theta: FloatArray) -> FloatArray:
    """Compute |B_iC_i|^2 - l4^2 (m^2) for point P on the branch cos(beta) > 0."""
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
    """Print the median ratio and its range."""
    low, high = min(ratios), max(ratios)
    print(f"{name:<12} {statistics.median(ratios):7.2f}  [{low:.2f}, {high:.2f}]  {detail}")


def batched() -> None:
    """Compare forward_all and inverse_all with the floor, in turns."""
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
    """Compare the conditioning of a batch with numpy's SVD of the Jacobians, in turns."""
    points = np.random.default_rng(2).uniform((-0.2, 0.015, 0.7), (0.1, 0.042, 0.9), (50_000, 3))
    theta, ratios, times = inverse(points), [], []
    for _ in range(REPEATS):
        peer = seconds(lambda: np.linalg.svd(jacobian.velocity(theta), compute_uv=False))
        times.append(seconds(lambda: jacobian.conditioning(theta)))
        ratios.append(peer / times[-1])
    each = 1e9 * statistics.median(times) / len(theta)
    detail = f"times faster than with numpy's SVD (target: at least 5); {each:.0f} ns a row"
    report("conditioning", ratios, detail)


def one_call() -> None:
    """Measure one configuration, by the machine and by the public functions."""
    point = (-0.04, 0.028, 0.80)
    theta = PAPER_TPM.inverse(point)
    array, angles = np.array(point), np.array(theta)
    calls: dict[str, Callable[[], object]] = {
        "machine.inverse": lambda: PAPER_TPM.inverse(point),
        "machine.evaluate": lambda: PAPER_TPM.evaluate(theta),
        "inverse": lambda: inverse(array),
        "forward": lambda: forward(angles),
        "jacobian.evaluate": lambda: jacobian.evaluate(angles),
    }
    for name, call in calls.items():
        each = [500 * seconds(lambda call=call: [call() for _ in range(2000)]) for _ in range(15)]
        spread = f"[{min(each):.2f}, {max(each):.2f}]"
        print(f"{name:<18} {statistics.median(each):6.2f}  {spread}  us a call")


def single() -> None:
    """Compare one forward call with scipy.optimize.root, in turns."""
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
