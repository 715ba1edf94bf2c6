"""Compare the TPM with a Delta: equal motors, stops and cross-sections, lengths as stated.

    make compare

With ``--write``, results go to docs/records/compare.json, and from there to the table of
docs/compare.md; the figure is docs/images/compare.png. Everything is computed by the same functions
of a machine, in its assembly and working mode, and only where every motor is between its stops.

The rows of learning are read from the trainings of ``python -m benchmarks.studies run --plan
machines --engine analytic`` in the folder of ``--runs``, and for the paper's machine from
docs/results. Without these trainings, the rows on record stay. ``--learning-only`` measures nothing
else.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from shared import ROOT, describe, make_parser, publish, read_record, table
from studies.page import settled

from tpm_gym.analysis import delta as delta_analysis
from tpm_gym.analysis import topology
from tpm_gym.analysis.aspects import Cells, aspects, largest_block
from tpm_gym.analysis.decoupling import motors as motors_of
from tpm_gym.analysis.limits import within_stops
from tpm_gym.analysis.poc import analyse
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import forward_all, inverse_all
from tpm_gym.kinematics.workspace import Region
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.run_folder import evaluations
from tpm_gym.mechanism import DELTA, PAPER_TPM, WIDE_TPM, Delta, Machine, Mount
from tpm_gym.mechanism.delta import kinematics as delta
from tpm_gym.mechanism.delta.geometry import DeltaGeometry
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.simulation.drives import Servo
from tpm_gym.tasks import Expert

DOCS = ROOT / "docs"
RECORD = DOCS / "records" / "compare.json"
RUNS = "TPMPickAndPlaceDense-v0-ppo-analytic"
GRID = 0.02  # m
CONDITIONING = 0.1
LENGTH_ERROR = 1e-4  # m
EPISODES = 20
RISE, WAY, ROUNDED = 0.025, 0.305, 0.024  # m, of the cycle 25-305-25; radius of its corners

SMALL = Delta(
    name="delta, arms of the TPM",
    geometry=DeltaGeometry(l1=0.300, l2=0.070, l3=0.350, l4=0.800, l5=0.050),
    mount=Mount(height=0.77),
    region=Region(low=(-0.18, -0.18, 0.50), high=(0.18, 0.18, 0.703)),
    goal_region=Region(low=(-0.15, -0.15, 0.54), high=(0.15, 0.15, 0.70)),
    home=(0.0, 0.0, 0.60),
)
"""A Delta with the paper's lengths of base, platform, arms and rods (l1 to l4)."""

MACHINES: dict[str, Machine] = {
    "TPM, paper": PAPER_TPM,
    "TPM, wide": WIDE_TPM,
    "Delta, arms of the TPM": SMALL,
    "Delta, IRB 360": DELTA,
}


class Workspace(NamedTuple):
    """Cells of a grid (nx, ny, nz): points (..., 3) m, whether in reach, and the conditioning."""

    points: FloatArray
    reached: BoolArray
    conditioning: FloatArray


def workspace(machine: Machine) -> Workspace:
    """Evaluate a grid below the base."""
    lengths = machine.geometry.lengths  # type: ignore[attr-defined]
    far = lengths[0] + lengths[2] + lengths[3]
    wide = 0.7 if isinstance(machine, Delta) or machine is WIDE_TPM else 0.06
    spacing = GRID if wide > 0.1 else GRID / 10
    y = np.arange(-wide, wide, spacing) if wide < 0.1 else np.arange(-far, far, GRID)
    x, z = np.arange(-far, far, GRID), np.arange(0.1, lengths[2] + lengths[3], GRID)
    points = np.stack(np.meshgrid(x + GRID / 2, y + spacing / 2, z, indexing="ij"), axis=-1)
    theta = machine.inverse(points)
    lower, upper = machine.stops
    within = ((theta >= lower) & (theta <= upper)).all(axis=-1)
    conditioning = np.where(within, machine.conditioning_at(points), 0.0)
    return Workspace(points, within & (conditioning > 0), conditioning)


def box(found: Workspace) -> tuple[float, FloatArray]:
    """Return the volume (dm^3) and the edges (mm) of the largest box that is well-conditioned."""
    low, high = largest_block(found.conditioning >= CONDITIONING) or ((0, 0, 0), (0, 0, 0))
    edges = found.points[high] - found.points[low]
    return float(1e3 * edges.prod()), 1e3 * edges


def cell(found: Workspace) -> float:
    """Return the volume of a cell, dm^3."""
    return float(1e3 * (found.points[1, 1, 1] - found.points[0, 0, 0]).prod())


def inside(machine: Machine, count: int = 4000) -> FloatArray:
    """Draw points (count, 3) of the task's region."""
    rng = np.random.default_rng(0)
    return rng.uniform(machine.region.low, machine.region.high, (count, 3))


def length_errors(machine: Machine) -> FloatArray:
    """Compute the error (n,) m of P for independent errors of all lengths, at fixed joints."""
    theta, squares = machine.inverse(inside(machine)), 0.0
    base = np.array(machine.lengths)
    for unit in np.eye(len(base)):
        step = 1e-7 * unit
        ends = [machine.built(tuple((base + s * step).tolist())) for s in (1, -1)]
        moved = np.subtract(*(machine.evaluate(theta, built[None]).position for built in ends))
        squares = squares + ((moved / 2e-7) ** 2).sum(axis=-1)
    errors: FloatArray = LENGTH_ERROR * np.sqrt(squares)
    return errors


def softest(machine: Machine) -> FloatArray:
    """Compute the smallest stiffness (n,) N/mm at P of drives with the servo's stiffness."""
    jacobian = machine.evaluate(machine.inverse(inside(machine))).jacobian
    largest = np.linalg.svd(jacobian, compute_uv=False)[:, 0]
    stiffness: FloatArray = 1e-3 * Servo().stiffness / largest**2
    return stiffness


def gate(share: FloatArray) -> FloatArray:
    """Return points (n, 2) m along a gate, 25 mm up, 305 mm across and 25 mm down, rounded."""
    turn = np.linspace(0, np.pi / 2, 30)
    left = ROUNDED * (1 - np.cos(turn)), RISE - ROUNDED + ROUNDED * np.sin(turn)
    half = np.stack([np.r_[0.0, left[0]], np.r_[0.0, left[1]]], axis=-1)
    points = np.concatenate([half, [WAY, 0.0] + half[::-1] * [-1.0, 1.0]])
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    at = share * along[-1]
    smooth = np.stack([np.interp(at, along, points[:, k]) for k in range(2)], axis=-1)
    window = np.hanning(61)[1:-1] / np.hanning(61).sum()  # rounds the kinks of the arc's chords
    padded = np.pad(smooth, ((29, 29), (0, 0)), mode="edge")
    return np.stack([np.convolve(padded[:, k], window, "valid") for k in range(2)], axis=-1)


def cycle_time(machine: Machine, axis: int) -> float:
    """Return the shortest time (s) there and back along an axis, within the motors' torque line."""
    region, count = machine.region, 2001
    middle = (np.array(region.low) + region.high) / 2
    if region.high[axis] - region.low[axis] < WAY:
        return float("nan")
    tau = np.linspace(0, 1, count)
    path = gate(10 * tau**3 - 15 * tau**4 + 6 * tau**5)
    points = np.tile(middle, (count, 1))
    points[:, axis] += path[:, 0] - WAY / 2
    points[:, 2] = region.high[2] - 0.02 - path[:, 1]
    theta, step = machine.reach(points), tau[1]
    rates = np.gradient(theta, step, axis=0)
    changes = np.gradient(rates, step, axis=0)
    motor = TORQUE_MOTOR

    def possible(time: float) -> bool:
        speed = np.abs(rates / time)
        torque = np.abs(machine.torque(theta, rates / time, changes / time**2))
        slope = motor.motor_constant**2 * (motor.no_load_speed - speed)
        return bool((torque <= np.minimum(motor.peak_torque, slope)).all())

    low, high = 0.02, 3.0
    for _ in range(30):
        half = (low + high) / 2
        low, high = (low, half) if possible(half) else (half, high)
    return 2 * high


def pick(machine: Machine) -> tuple[float, float, float]:
    """Return success, rms torque (N m) and mechanical work (J) of the expert's episodes."""
    env = gym.make("TPMPickAndPlace-v0", machine=machine, engine="analytic")
    torques, works, wins = [], [], 0
    for seed in range(EPISODES):
        observation, info = env.reset(seed=seed)
        expert, work = Expert(env), 0.0
        for _ in range(50):
            observation, *_, info = env.step(expert.act(observation))
            state = env.unwrapped.state  # type: ignore[attr-defined]
            torques.append(np.array(state.torque))
            work += 0.04 * float(np.abs(state.torque * state.theta_dot).sum())
        works.append(work)
        wins += info["is_success"]
    return wins / EPISODES, float(np.sqrt(np.square(torques).mean())), float(np.mean(works))


def microseconds(function: Callable[[Any], Any], rows: FloatArray) -> float:
    """Return the shortest time of a row, us."""
    function(rows)
    times = []
    for _ in range(20):
        start = perf_counter()
        function(rows)
        times.append(perf_counter() - start)
    return 1e6 * min(times) / len(rows)


def solutions(machine: Machine) -> str:
    """Count the real solutions of forward and inverse kinematics at home."""
    theta = machine.inverse(machine.home)
    if isinstance(machine, Delta):
        found = (
            delta.forward_all(theta, machine.geometry),
            delta.inverse_all(machine.home, machine.geometry),
        )
        counts = [int(np.isfinite(one).all(axis=-1).sum()) for one in found]
    else:
        g = machine.geometry  # type: ignore[attr-defined]
        counts = [
            int(forward_all(theta, g).valid.sum()),
            int(inverse_all(machine.home, g).valid.sum()),
        ]
    return f"{counts[0]} and {counts[1]}"


def coupling(machine: Machine) -> str:
    """Return the coupling degree of each loop, with parallelograms of revolutes for the Delta."""
    theta = machine.inverse(machine.home)
    if isinstance(machine, Delta):
        chains, point = delta_analysis.chains(theta, geometry=machine.geometry, balls=False)
        found = analyse(chains, point)
    else:
        geometry = machine.geometry  # type: ignore[attr-defined]
        found = topology.analyse(topology.describe(theta, geometry=geometry))
    return ", ".join(f"{kappa:g}" for kappa in found.coupling)


def largest_aspect(machine: Machine) -> str:
    """Return the largest aspect of the working mode within the stops, % of all of them."""
    sets: list[Cells]
    if isinstance(machine, Delta):
        of_delta = delta_analysis.aspects(geometry=machine.geometry, within_stops=True)
        sets = [one.cells for one in of_delta]
    else:
        mode, geometry = machine.working_mode, machine.geometry  # type: ignore[attr-defined]
        sets = [one.cells for one in aspects(mode, geometry, limits=(within_stops,))]
    volumes = [cells.volume for cells in sets]
    return f"{100 * volumes[0] / sum(volumes):.0f}"


def trainings(machine: Machine, runs: Path) -> Iterator[dict[str, Any]]:
    """Yield steps and CPU seconds to 95%, success and unsafe share of steps of each training."""
    if machine is PAPER_TPM:
        for path in sorted((DOCS / "results").glob(f"{RUNS}-s?.json")):
            record = json.loads(path.read_text(encoding="utf-8"))
            yield outcome(record["seed"], record["evaluations"], record["tests"]["pybullet"])
    for folder in sorted(runs.glob(f"{RUNS}-{machine.name}-s?")):
        test = folder / "tests" / "pybullet.json"
        if test.is_file():
            found = evaluations(folder)
            curves = {name: [one[name] for one in found] for name in ("steps", "cpu_seconds")}
            curves["success_at_end"] = [one["success_at_end"]["mean"] for one in found]
            tested = json.loads(test.read_text(encoding="utf-8"))
            yield outcome(int(folder.name[-1]), curves, tested)


def outcome(seed: int, curves: dict[str, Any], test: dict[str, Any]) -> dict[str, Any]:
    """Return what a training came to; None for what it never reached, or what is not on record."""
    index = settled(curves["success_at_end"])
    seconds = curves.get("cpu_seconds")
    return {
        "seed": seed,
        "steps": None if index is None else curves["steps"][index],
        "cpu_seconds": None if index is None or seconds is None else seconds[index],
        "episodes": test["episodes"],
        "success": test["success_at_end"]["mean"],
        "unsafe_share": test["unsafe_share"]["mean"],
    }


def learned(found: list[dict[str, Any]]) -> list[str]:
    """Return the cells of the rows of learning."""
    if not found:
        return ["-"] * len(LEARNING)

    def middle(name: str, form: str) -> str:
        known = [np.inf if one[name] is None else one[name] for one in found]
        value = float(np.median(known))
        return "never" if np.isinf(value) else form.format(value)

    timed = all(one["cpu_seconds"] is not None or one["steps"] is None for one in found)
    success = [100 * one["success"] for one in found]
    return [
        f"{len(found)}",
        middle("steps", "{:,.0f}"),
        middle("cpu_seconds", "{:.0f}") if timed else "-",
        f"{np.median(success):.1f} ({min(success):.1f} to {max(success):.1f})",
        f"{100 * np.mean([one['unsafe_share'] for one in found]):.1f}",
    ]


def moved(machine: Machine) -> float:
    """Return the mass of all moving links, kg."""
    return float(sum(link.mass for link in machine.mechanism.links[1:]))


def column(machine: Machine) -> list[str]:
    """Measure one machine."""
    found = workspace(machine)
    volume, edges = box(found)
    points = inside(machine)
    jacobian = machine.evaluate(machine.inverse(points)).jacobian
    counted = motors_of(jacobian).mean(axis=0)
    errors, soft = length_errors(machine), softest(machine)
    success, torque, work = pick(machine)
    lengths = machine.geometry.lengths  # type: ignore[attr-defined]
    inertia = machine.motion(machine.inverse(points), np.zeros_like(points)).mass
    times = [cycle_time(machine, axis) for axis in (0, 1)]
    theta = machine.inverse(points)
    return [
        f"{1e3 * lengths[0]:.0f}, {1e3 * lengths[2]:.0f}, {1e3 * lengths[3]:.0f}",
        f"{moved(machine):.1f}",
        f"{np.trace(inertia, axis1=1, axis2=2).mean() / 3:.2f}",
        f"{2 * (lengths[0] + lengths[2]):.2f}",
        f"{found.reached.sum() * cell(found):.0f}",
        f"{(found.conditioning >= CONDITIONING).sum() * cell(found):.0f}",
        f"{volume:.0f} ({' x '.join(f'{edge:.0f}' for edge in edges)})",
        ", ".join(f"{value:.1f}" for value in counted),
        f"{soft.min():.1f}, {np.median(soft):.0f}",
        f"{np.median(1e3 * errors):.2f}, {1e3 * errors.max():.2f}",
        f"{100 * success:.0f}",
        f"{torque:.1f}",
        f"{work:.0f}",
        ", ".join("-" if np.isnan(time) else f"{time:.2f}" for time in times),
        solutions(machine),
        coupling(machine),
        largest_aspect(machine),
        f"{microseconds(machine.forward, theta):.2f}, {microseconds(machine.inverse, points):.2f}",
    ]


ROWS = (
    "l1, arms, rods, mm",
    "mass of all moving links, kg",
    "mean inertia at a motor in the task's region, kg m^2",
    "width of the circle that the elbows can reach, m",
    "reachable within stops, dm^3",
    "of that with conditioning at least 0.1, dm^3",
    "largest box with conditioning at least 0.1, dm^3 (mm)",
    "motors that count for x, y, z",
    "stiffness at P in the softest direction, N/mm: least, median",
    "error of P for 0.1 mm in every length, mm: median, largest",
    "expert's success, %",
    "expert's torque, rms, N m",
    "expert's mechanical work in an episode, J",
    "cycle 25-305-25 along x, along y, s",
    "forward and inverse solutions at home",
    "coupling degrees of the loops",
    "largest aspect of the working mode within the stops, % of all",
    "time of forward, of inverse, us a row",
)

LEARNING = (
    "PPO from scratch: trainings",
    "steps to 95%, median",
    "seconds of CPU to 95%, median",
    "success in PyBullet, median (range), %",
    "steps with unsafe conditioning, mean, %",
)


def figure() -> Figure:
    """Draw the conditioning over the vertical plane x, z through the middle of each region."""
    drawn, axes = plt.subplots(
        2, 2, figsize=(9, 5.6), sharex=True, sharey=True, layout="constrained"
    )
    x, z = np.meshgrid(np.linspace(-1.5, 1.5, 401), np.linspace(-0.05, 1.85, 255), indexing="ij")
    for one, (name, machine) in zip(axes.flat, MACHINES.items(), strict=True):
        (x0, y0, z0), (x1, y1, z1) = machine.region.low, machine.region.high
        points = np.stack([x, np.full_like(x, (y0 + y1) / 2), z], axis=-1)
        theta, (lower, upper) = machine.inverse(points), machine.stops
        within = ((theta >= lower) & (theta <= upper)).all(axis=-1)
        shown = np.where(within, machine.conditioning_at(points), np.nan)
        shown[shown == 0] = np.nan
        colours = one.pcolormesh(x, z, shown, vmin=0, vmax=0.8)
        one.add_patch(Rectangle((x0, z0), x1 - x0, z1 - z0, fill=False))
        one.set(title=name, aspect="equal", ylim=(1.85, -0.05))
    for last, first in zip(axes[-1], axes[:, 0], strict=True):
        last.set(xlabel="x, m")
        first.set(ylabel="z, m, down")
    drawn.colorbar(colours, ax=axes, label="conditioning 1/cond(J)", shrink=0.7)
    return drawn


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table of the page."""
    columns = [
        [*record["measured"][name], *learned(record["learning"].get(name, []))] for name in MACHINES
    ]
    yield from table(["", *MACHINES], zip((*ROWS, *LEARNING), *columns, strict=True))


def main() -> None:
    """Measure all machines and publish the record."""
    parser = make_parser("The TPM and the Delta, measured.")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "study")
    parser.add_argument("--learning-only", action="store_true", help="keep what is measured")
    options = parser.parse_args()
    record = read_record(RECORD)
    learning = record.setdefault("learning", {})
    for name, machine in MACHINES.items():
        if found := list(trainings(machine, options.runs)):
            learning[name] = found
    if not options.learning_only:
        record["measured"] = {name: column(machine) for name, machine in MACHINES.items()}
        record["machine"] = describe(sys.argv)
    publish(record, RECORD, DOCS / "compare.md", "compare", lines, write=options.write)
    if options.write and not options.learning_only:
        with style.style():
            style.save(figure(), DOCS / "images" / "compare.png")


if __name__ == "__main__":
    main()
