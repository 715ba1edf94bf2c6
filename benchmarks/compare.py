"""Compare the TPM with a Delta: equal motors, stops and cross-sections, lengths as stated.

    make compare

It writes the table of docs/compare.md and draws docs/images/compare.png. Everything is computed by
the same functions of a machine, in its assembly and working mode, and only where every motor is
between its stops.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from shared import fill, table

from tpm_gym.analysis.aspects import largest_block
from tpm_gym.analysis.decoupling import motors as motors_of
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import forward_all, inverse_all
from tpm_gym.kinematics.workspace import Region
from tpm_gym.learning import figure_style as style
from tpm_gym.mechanism import DELTA, PAPER_TPM, WIDE_TPM, Delta, Machine, Mount
from tpm_gym.mechanism.delta import kinematics as delta
from tpm_gym.mechanism.delta.geometry import DeltaGeometry
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.simulation.drives import Servo
from tpm_gym.tasks import Expert

DOCS = Path(__file__).parents[1] / "docs"
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
    "time of forward, of inverse, us a row",
)


def figure() -> Figure:
    """Draw the conditioning over the vertical plane x, z through the middle of each region."""
    drawn, axes = plt.subplots(
        1, len(MACHINES), figsize=(11, 3.2), sharey=True, layout="constrained"
    )
    x, z = np.meshgrid(np.linspace(-0.9, 0.9, 241), np.linspace(0.05, 1.7, 221), indexing="ij")
    for one, (name, machine) in zip(axes, MACHINES.items(), strict=True):
        (x0, y0, z0), (x1, y1, z1) = machine.region.low, machine.region.high
        points = np.stack([x, np.full_like(x, (y0 + y1) / 2), z], axis=-1)
        theta, (lower, upper) = machine.inverse(points), machine.stops
        within = ((theta >= lower) & (theta <= upper)).all(axis=-1)
        shown = np.where(within, machine.conditioning_at(points), np.nan)
        shown[shown == 0] = np.nan
        colours = one.pcolormesh(x, z, shown, vmin=0, vmax=0.8)
        one.add_patch(Rectangle((x0, z0), x1 - x0, z1 - z0, fill=False))
        one.set(title=name, xlabel="x, m", aspect="equal")
    axes[0].set(ylabel="z, m, down", ylim=(1.7, 0.05))
    drawn.colorbar(colours, ax=axes, label="conditioning 1/cond(J)")
    return drawn


def main() -> None:
    """Measure all machines, and write the table."""
    columns = [column(machine) for machine in MACHINES.values()]
    lines = list(table(["", *MACHINES], zip(ROWS, *columns, strict=True)))
    print("\n".join(lines))
    fill(DOCS / "compare.md", "compare", lines)
    with style.style():
        style.save(figure(), DOCS / "images" / "compare.png")


if __name__ == "__main__":
    main()
