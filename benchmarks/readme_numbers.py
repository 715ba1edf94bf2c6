"""Fill the numbers of README.md, and the table of speed in docs/speed.md, from the records.

    python benchmarks/readme_numbers.py

``make bench-speed`` and ``make bench-engine`` write the records, and run this. A number without a
record says how to measure it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from shared import ROOT, fill, processor_line, quartiles, read_record, spread, table

from tpm_gym.resources import POLICIES

RECORDS = ROOT / "docs" / "records"
README, SPEED = ROOT / "README.md", ROOT / "docs" / "speed.md"
OURS, PANDA, FETCH = "TPMPickAndPlace-v0", "PandaPickAndPlace-v3", "FetchPickAndPlace-v4"
MANY = f"{OURS}, analytic, none, 1024"


def publish() -> None:
    """Fill the pages."""
    fill(README, "numbers", numbers())
    fill(README, "policies", policies())
    fill(SPEED, "speed", speed(read_record(RECORDS / "speed.json")))


def numbers() -> Iterator[str]:
    """Yield the table of README.md: steps a second beside other packages."""
    speed, analytic = (read_record(RECORDS / f"{name}.json") for name in ("speed", "analytic"))
    one = {name: entry["rounds"] for name, entry in speed.get("contestants", {}).items()}
    rows = analytic.get("speed", {}).get("rows", {}).get("rates", {})
    many = {name: entry["rates"] for name, entry in rows.items()}
    panda, fetch = f"`{PANDA}` of panda-gym", f"`{FETCH}` of Gymnasium-Robotics"
    yield from table(
        ["`TPMPickAndPlace-v0` beside", "steps a second, ratio", "measured by"],
        [
            [f"{panda}, both in PyBullet", _ratio(one, OURS, PANDA), "`make bench-speed`"],
            [fetch, _ratio(one, OURS, FETCH), "`make bench-speed`"],
            [
                f"{panda}, with 1,024 robots in the analytic engine",
                _ratio(many, MANY, PANDA),
                "`make bench-engine`",
            ],
        ],
    )


def _ratio(rates: dict[str, Sequence[float]], ours: str, other: str) -> str:
    """Return median and quartiles of the ratios of steps a second, round by round."""
    if not {ours, other} <= rates.keys():
        return "not measured yet"
    ratios = [one / two for one, two in zip(rates[ours], rates[other], strict=True)]
    return spread(quartiles(ratios), "{:.0f}" if min(ratios) > 20 else "{:.1f}")


def policies() -> Iterator[str]:
    """Yield the table of the published policies, from their files."""
    rows = []
    for path in sorted(POLICIES.glob("*.evaluation.json")):
        test = json.loads(path.read_text(encoding="utf-8"))
        policy = json.loads((POLICIES / f"{test['env']}.json").read_text(encoding="utf-8"))
        recipe = policy["recipe"]
        success = [100 * test["success_at_end"][name] for name in ("mean", "low", "high")]
        mean, low, high = success
        shown = " with demonstrations" if recipe["demonstrations"] else ""
        elsewhere = f" on `{policy['env']}`" if policy["env"] != test["env"] else ""
        rows.append(
            [
                f"`{test['env']}`",
                f"{mean:.1f}% [{low:.1f}, {high:.1f}] of {test['episodes']:,}",
                f"{policy['algorithm'].upper()}{shown}{elsewhere}, {recipe['n_timesteps']:,} steps",
            ]
        )
    yield from table(["policy", "success in PyBullet, 95% interval", "training"], rows)


def speed(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table of docs/speed.md: one environment of each package."""
    if not record:
        yield "Not measured yet on this version."
        return
    yield f"`make bench-speed` on {processor_line(record)}; {record['rounds']} rounds of "
    yield f"{record['steps']:,} steps, medians and quartiles."
    yield ""
    entries = sorted(
        record["contestants"].items(), key=lambda item: -item[1]["steps_per_second"][1]
    )
    yield from table(
        ["environment", "steps a second", f"times {record['baseline']}", "step over raw physics"],
        [
            [
                name,
                spread(entry["steps_per_second"], "{:,.0f}"),
                _cell(entry, "ratio_to_baseline"),
                _cell(entry, "step_over_with_motors"),
            ]
            for name, entry in entries
        ],
    )
    for name, reason in record["unavailable"].items():
        yield f"\n{name} is missing: {reason}"


def _cell(entry: dict[str, Any], name: str) -> str:
    return spread(entry[name], "{:.2f}") if name in entry else "-"


if __name__ == "__main__":
    publish()
