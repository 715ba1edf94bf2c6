"""Improve lengths and motions by gradients, and draw the results of docs/gradients.md.

    make gradients

Writes docs/records/gradients.json and docs/images/gradients.png, and prints the page's tables.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gradients import drawing, ways
from gradients.lengths import Design, largest_box, random_lengths

from tpm_gym.kinematics.geometry import PAPER, WIDE
from tpm_gym.learning import figure_style as style
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM
from tpm_gym.simulation.state import CONTROL_PERIOD

DOCS = Path(__file__).resolve().parent
RECORD, IMAGE = DOCS / "records" / "gradients.json", DOCS / "images" / "gradients.png"
STARTS, CARRIES = 6, 6


def designs() -> tuple[dict[str, Design], list[float]]:
    """Return boxes of the paper's lengths, of WIDE and of the best search; and all volumes."""
    rng = np.random.default_rng(0)
    found = [largest_box(random_lengths(rng), free=True) for _ in range(STARTS)]
    best = max(found, key=lambda design: design.volume)
    named = {"paper": largest_box(PAPER), "wide": largest_box(WIDE), "found": best}
    return named, [design.volume for design in found]


def carried(carry: ways.Carry) -> dict[str, Any]:
    """Return the torques of the expert's and the best motion, closed-form and in PyBullet, N m."""
    found = carry.least_torque()
    row: dict[str, Any] = {"machine": carry.machine.name, "commands": found.tolist()}
    for name, commands in (("expert", carry.expert()), ("found", found)):
        torque, simulated = carry.torque(commands), carry.simulated(commands)
        row[name] = {
            "rms": float(ways.rms(torque)),
            "peak": float(torque.abs().max()),
            "rms_pybullet": float(ways.rms(simulated)),
            "rms_weight": float(ways.rms(carry.dynamics.gravity(carry.joints(commands)))),
        }
    return row


def report(record: dict[str, Any]) -> str:
    """Return the tables of docs/gradients.md."""
    lines = [
        "| lengths (mm) | l1 | l2 | l3 | l4 | l5 | l6 | l7 | box (mm) | litres |",
        "|---" * 10 + "|",
    ]
    for name, design in record["designs"].items():
        size = np.subtract(design["high"], design["low"])
        cells = " | ".join(f"{1e3 * length:.0f}" for length in design["lengths"])
        box = " x ".join(f"{1e3 * edge:.0f}" for edge in size)
        lines.append(f"| {name} | {cells} | {box} | {1e3 * size.prod():.2f} |")
    volumes = ", ".join(f"{1e3 * volume:.2f}" for volume in record["volumes"])
    lines += [
        f"\nLitres that the searches found: {volumes}.\n",
        "| machine | time (s) | weight | expert | least | heat | peaks | PyBullet | heat |",
        "|---" * 9 + "|",
    ]
    for row in record["carries"]:
        expert, found = row["expert"], row["found"]
        heat, simulated = (less_heat(row, kind) for kind in ("rms", "rms_pybullet"))
        lines.append(
            f"| {row['machine']} | {CONTROL_PERIOD * (len(row['commands']) - 2):.2f} "
            f"| {expert['rms_weight']:.2f} | {expert['rms']:.2f} | {found['rms']:.2f} "
            f"| {-heat:.0%} | {expert['peak']:.1f}, {found['peak']:.1f} "
            f"| {expert['rms_pybullet']:.2f}, {found['rms_pybullet']:.2f} | {-simulated:.0%} |"
        )
    return "\n".join(lines)


def less_heat(row: dict[str, Any], kind: str) -> float:
    """Return the share of the expert's heat that is saved; heat goes with torque squared."""
    return float(1 - (row["found"][kind] / row["expert"][kind]) ** 2)


def main() -> None:
    """Search, write, print, draw."""
    torch.set_num_threads(1)
    named, volumes = designs()
    carries = [carry for machine in (PAPER_TPM, WIDE_TPM) for carry in ways.draw(machine, CARRIES)]
    boxes = {
        name: {"lengths": [*vars(geometry).values()], "low": box.low, "high": box.high}
        for name, (geometry, box) in named.items()
    }
    rows = [carried(carry) for carry in carries]
    record = {"designs": boxes, "volumes": volumes, "carries": rows}
    RECORD.write_text(json.dumps(record, separators=(",", ":")) + "\n", encoding="utf-8")
    print(report(record))
    least = torch.tensor(rows[0]["commands"], dtype=torch.float64)
    with style.style():
        style.save(drawing.figure(named, carries[0], carries[0].expert(), least), IMAGE)


if __name__ == "__main__":
    main()
