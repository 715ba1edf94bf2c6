"""Measure errors of the closed loops against cost, over trees, closures, solvers and time steps.

    make bench-fidelity
    python benchmarks/bench_fidelity.py --quick
    python benchmarks/bench_fidelity.py --long 1000000

Three quantities are measured at each time step of three motions: the largest loop gap, the distance
of the platform from the forward kinematics of the true encoders, and the tilt. Random: uniform
random Cartesian actions. Expert: commands of the scripted expert in TPMPickAndPlace-v0. Fast: full
speed with sudden changes of direction, and sweeps of 1.5 Hz over the whole region, more than twice
as fast as the environments allow.

With ``--write``, results go to runs/fidelity.json, docs/images/fidelity.png and
docs/loops-sweep.md. ``--long N`` runs the default alone in the real environment, for N time steps
of each motion.
"""

from __future__ import annotations

import sys
from functools import partial

import fidelity_long
import fidelity_report as report
import shared
from fidelity_lab import Motion, expert_motion, fast_motion, random_motion
from fidelity_sweep import errors_of, sweep, time_all

ROUNDS, BLOCK = 9, 25
"""Rounds of timing; control periods timed in each round."""


def motions(quick: bool) -> list[Motion]:
    """Return the three motions, shorter if ``quick``."""
    return [
        random_motion(100 if quick else 800),
        expert_motion(2 if quick else 12),
        fast_motion(80 if quick else 400),
    ]


def run_sweep(quick: bool, write: bool) -> None:
    """Measure and print; with ``write``, also replace the files."""
    description = shared.describe(sys.argv)
    followed, results = motions(quick), []
    for config in sweep():
        print(f"{len(results) + 1} of {len(sweep())}: {config.name}", file=sys.stderr)
        results.append(errors_of(config, followed))
    print("timing", file=sys.stderr)
    time_all(results, random_motion(BLOCK, seed=2), 3 if quick else ROUNDS)
    line = shared.processor_line(description)
    print(f"{line}\n")
    report.print_table(results)
    if write:
        report.write_json(results, description)
        publish()


def publish() -> None:
    """Draw the picture and fill the page from runs/fidelity.json."""
    results, description = report.read_json()
    line = shared.processor_line(description)
    report.draw(results, line)
    report.write_page(results, line)


def main() -> None:
    """Parse the options and run."""
    parser = shared.make_parser("Fidelity of the closed loops against cost.", quick="a minute")
    parser.add_argument("--redraw", action="store_true", help="picture and page from the last run")
    parser.add_argument("--long", type=int, metavar="N", help="N time steps a motion, default only")
    options = parser.parse_args()
    if options.long is not None:
        fidelity_long.run(options.long, partial(shared.describe, sys.argv), options.write)
    elif options.redraw:
        publish()
    else:
        run_sweep(options.quick, options.write)


if __name__ == "__main__":
    main()
