"""The text of docs/results.md, from the records of runs."""

import json
from collections.abc import Iterable, Sequence
from statistics import fmean, median
from typing import Any, Final

from tpm_gym.learning.estimates import (
    BOOTSTRAP_SAMPLES,
    BOOTSTRAP_SEED,
    LEARNED,
    interquartile_mean,
    median_time,
    settled,
)
from tpm_gym.learning.robustness import OF_SERVOS, UNITS, ends, halving, nominal
from tpm_gym.learning.rollout import WORST
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation.randomisation import LIMITS

Record = dict[str, Any]
Group = list[Record]

NOMINAL, TEMPTING = "nominal", "tempting"
LEARNING_CURVES, PENALTY = "results_learning_curves.png", "results_penalty.png"
ROBUSTNESS = "results_robustness.png"
NONE: Final = "\N{EM DASH}"

_INTRO: Final = f"""# Results

Written by `make results` from the records in [results](results); no result here was typed by hand.

**Stale:** these records are of the physics before friction in PyBullet became a cone, the vacuum a
pressure with a limit, and the motors real ones. The published policies have been trained and tested
anew since; all else here is as it was.

- **Success** is that of the last step of an episode. Each run is tested with the policy that did
  best in the evaluations during training, on held-out seeds that neither training nor those
  evaluations have seen; its interval is Wilson's, at 95%.
- **IQM** is the interquartile mean over seeds (of five, the mean of the middle three), with a 95%
  bootstrap interval ({BOOTSTRAP_SAMPLES:,} resamples of the seeds, seed {BOOTSTRAP_SEED}). A run
  without a test counts as 0.
- **Time to {LEARNED:.0%}** is that of the first evaluation during training from which success stays
  at {LEARNED:.0%} or above to the end of training; those evaluations are short (20 episodes, so at
  most one may fail), the same episodes each time. Minutes include them; minutes and steps include
  the playing of demonstrations. For several seeds it is the median, "never" where that is a
  run that never did.
- **Smallest conditioning** is the least 1/cond(J) of all steps of all test episodes (and seeds),
  **time below safe** the share of their steps with 1/cond(J) < \
{PAPER_TPM.safe_conditioning} (the mean of seeds).
- **Observed P off** is the largest distance between the observed position of the platform (forward
  kinematics of the encoders) and the simulated one, of all steps, episodes and seeds.
"""


_STUDY: Final = """\
With `+modified`, files that git tracks differed from the commit. Minutes are wall-clock, of two
runs at a time on two cores, and of some runs too long: tests ran beside them. All of it again:

```bash
tpm-gym study --plan results
tpm-gym study --plan penalty
tpm-gym study --plan penalty --envs TPMPickAndPlaceJoints-v0 --steps 100000
tpm-gym study --plan robustness --episodes 300
tpm-gym report collect
make results
```

A study runs on Ray (the extra `cluster`), two runs at a time on this machine alone. With
`--address` it runs on a cluster that `ray start` has started, whose nodes see the working folder on
a shared disk. A run whose process or node dies goes on elsewhere from its last checkpoint.

These are its commands for the first seed, and the first of each bisection. Each record holds its
own, as it was then: `train/train.py` is `tpm-gym train`, `train/evaluate.py` `tpm-gym evaluate`.
"""


def page(records: Sequence[Record], figures: Sequence[str]) -> str:
    """Return the page as Markdown."""
    bisections, runs = split(records)
    plain = [r for r in runs if r["goals"] == "sampled" and r["penalty_weight"] == 1.0]
    tempted = [r for r in runs if r["goals"] == "tempting"]
    parts = [_INTRO, *_training(plain, figures), *_penalty(tempted, figures)]
    return "\n".join([*parts, *_robustness(bisections, figures), *_how(records)])


def split(records: Iterable[Record]) -> tuple[Group, Group]:
    """Return the records of bisections, and those of trainings."""
    found: tuple[Group, Group] = ([], [])
    for record in records:
        found["attribute" not in record].append(record)
    return found


def grouped(records: Iterable[Record]) -> list[Group]:
    """Put runs together that differ by their seed alone, seeds in order."""
    groups: dict[str, Group] = {}
    for record in sorted(records, key=_order):
        names = ("env", "algo", "recipe", "steps", "envs", "goals", "penalty_weight")
        key = json.dumps([record[name] for name in names], sort_keys=True)
        groups.setdefault(key, []).append(record)
    return list(groups.values())


def method(record: Record) -> str:
    """Name the algorithm of a run, and its recipe where that is not the usual one."""
    name = str(record["algo"]).upper() + (" + HER" if record["recipe"]["hindsight"] else "")
    usual = record["recipe_file"] == f"{record['algo']}.yml"
    return name if usual else f"{name} ({record['recipe_file']})"


def success(record: Record, test: str) -> float:
    """Success rate of a run in a test; 0 where it has none."""
    return float(record["tests"].get(test, {}).get("success_at_end", {}).get("mean", 0.0))


def _order(record: Record) -> tuple[Any, ...]:
    return record["env"], record["algo"], record["steps"], record["penalty_weight"], record["seed"]


# -- sections ---------------------------------------------------------------------------------


def _training(records: Group, figures: Sequence[str]) -> list[str]:
    """How well, and how fast, the recipes learn."""
    if not records:
        return []
    head = (
        "id | method | steps | seeds | success, IQM | median | steps to 95% | minutes to 95% | "
        "smallest conditioning | time below safe"
    )
    rows = [_training_row(group) for group in grouped(records)]
    tested = f"Each seed is tested on {_episodes(records, [NOMINAL])} held-out episodes.\n"
    parts = ["## Learning\n", tested, _table(head, rows)]
    if LEARNING_CURVES in figures:
        parts.append(f"![Learning curves](images/{LEARNING_CURVES})\n")
        parts.append("A curve that does not start at 0 starts after the demonstrations.\n")
    head = (
        "id | method | seed | success | steps to 95% | minutes to 95% | minutes in all | "
        "smallest conditioning | time below safe | observed P off"
    )
    runs = [_run_row(record) for group in grouped(records) for record in group]
    return [*parts, "### Every run\n", _table(head, runs), *_failures(records, NOMINAL)]


def _training_row(group: Group) -> list[str]:
    times = [_time_to_learn(record) for record in group]
    first = group[0]
    return [
        first["env"],
        method(first),
        f"{first['steps']:,}",
        str(len(group)),
        _iqm([success(record, NOMINAL) for record in group]),
        f"{median(success(record, NOMINAL) for record in group):.1%}",
        _or_never(median_time([steps for steps, _ in times]), "{:,.0f}"),
        _or_never(median_time([minutes for _, minutes in times]), "{:.1f}"),
        _worst(group, NOMINAL, "conditioning_min", "{:.3f}"),
        _mean(group, NOMINAL, "unsafe_share", "{:.1%}"),
    ]


def _run_row(record: Record) -> list[str]:
    steps, minutes = _time_to_learn(record)
    walls = record["evaluations"]["wall_seconds"]
    return [
        record["env"],
        method(record),
        str(record["seed"]),
        _tested(record, NOMINAL),
        _or_never(steps, "{:,.0f}"),
        _or_never(minutes, "{:.1f}"),
        f"{walls[-1] / 60:.1f}" if walls else NONE,
        _worst([record], NOMINAL, "conditioning_min", "{:.3f}"),
        _mean([record], NOMINAL, "unsafe_share", "{:.1%}"),
        _worst([record], NOMINAL, "fk_error_max", "{:.3f} mm", 1e3),
    ]


def _failures(records: Group, test: str) -> list[str]:
    lines = []
    for record in sorted(records, key=_order):
        name = f"{record['env']}, {method(record)}, seed {record['seed']}"
        if record["goals"] == "tempting":
            name += f", {record['steps']:,} steps, penalty weight {record['penalty_weight']:g}"
        if not record["finished"]:
            reached = (record["evaluations"]["steps"] or [0])[-1]
            lines.append(f"- {name}: stopped after {reached:,} of {record['steps']:,} steps.")
        elif test not in record["tests"]:
            lines.append(f"- {name}: not tested.")
        elif success(record, test) < LEARNED:
            lines.append(f"- {name}: success {_tested(record, test)}, below {LEARNED:.0%}.")
    body = "\n".join(lines) if lines else f"None: every run has {LEARNED:.0%} or more."
    return ["### Failures\n", body + "\n"]


def _penalty(records: Group, figures: Sequence[str]) -> list[str]:
    """Whether the singularity penalty does what it is for."""
    if not records:
        return []
    head = (
        "id | method | steps | penalty weight | seeds | success, IQM | time below safe (seeds) | "
        "smallest conditioning | observed P off | torque, RMS | torque, peak"
    )
    rows = [
        [
            group[0]["env"],
            method(group[0]),
            f"{group[0]['steps']:,}",
            f"{group[0]['penalty_weight']:g}",
            str(len(group)),
            _iqm([success(record, TEMPTING) for record in group]),
            _mean(group, TEMPTING, "unsafe_share", "{:.1%}", spread=True),
            _worst(group, TEMPTING, "conditioning_min", "{:.3f}"),
            _worst(group, TEMPTING, "fk_error_max", "{:.3f} mm", 1e3),
            _mean(group, TEMPTING, "torque_rms", "{:.1f} N m"),
            _worst(group, TEMPTING, "torque_peak", "{:.0f} N m"),
        ]
        for group in grouped(records)
    ]
    text = (
        "## Does the penalty work?\n\nTrained and tested on goals that tempt towards the "
        "singularity (`--goals tempting`): goals, and pucks, lie just within the safe threshold, "
        "and straight lines in the joint angles lead beyond it. "
        f"{_episodes(records, [TEMPTING])} held-out episodes a seed.\n"
    )
    parts = [text, _table(head, rows), *_compared(records)]
    if PENALTY in figures:
        parts.append(f"![Success and time below safe by weight](images/{PENALTY})\n")
    return [*parts, *_failures(records, TEMPTING)]


def _compared(records: Group) -> list[str]:
    """One line an id, method and its steps: time below safe without the penalty and with it."""
    shares: dict[tuple[str, str, int], dict[float, list[float]]] = {}
    for record in records:
        by_weight = shares.setdefault((record["env"], method(record), record["steps"]), {})
        values = by_weight.setdefault(record["penalty_weight"], [])
        values += _values([record], TEMPTING, "unsafe_share", "mean")
    lines = []
    for (env, name, steps), by_weight in sorted(shares.items()):
        if not (by_weight.get(0.0) and by_weight.get(1.0)):
            continue
        without, with_it = (fmean(by_weight[weight]) for weight in (0.0, 1.0))
        times = f"{without / with_it:,.0f} times less" if with_it > 0 else "never below"
        lines.append(
            f"- {env}, {name}, {steps:,} steps: {without:.2%} without the penalty, {with_it:.3%} "
            f"with it: {times}."
        )
    return ["Time below safe, mean over seeds:\n", "\n".join(lines) + "\n"] if lines else []


def _robustness(records: Group, figures: Sequence[str]) -> list[str]:
    """How far machines may differ from the one that the published policies were trained on."""
    if not records:
        return []
    ids = sorted({record["env"] for record in records})
    found = {(record["env"], record["attribute"]): record for record in records}
    rows = []
    for attribute, end in [(name, end) for name in LIMITS for end in ends(name)]:
        of = [found.get((env, attribute)) for env in ids]
        if any(of):
            unit = UNITS.get(attribute, "factor")
            drive = ", servo drives" if attribute in OF_SERVOS else ""
            name = f"{attribute.replace('_', ' ')} ({unit}{drive})"
            cells = [_halves(record, end) if record else NONE for record in of]
            rows.append([name, f"{nominal(attribute):g}", f"{end:g}", *cells])
    text = (
        "## Robustness\n\nThe published policies, trained on the nominal machine alone, on others "
        "that differ from it in one thing. Success halves between the two values given, found by "
        "bisection; or it does not as far as a machine may differ here, and success there is "
        f"given. {' or '.join(sorted({str(r['episodes']) for r in records}))} episodes a test. "
        "Errors of lengths and biases are drawn up to the value in each episode, noise has it as "
        "its standard deviation; all else has the value itself.\n"
    )
    parts = [text, _table(" | ".join(["what differs", "nominal", "up to", *ids]), rows)]
    if ROBUSTNESS in figures:
        parts.append(f"![Success by what differs](images/{ROBUSTNESS})\n")
    return parts


def successes(record: Record) -> dict[float, float]:
    """Success by value in the tests of a bisection."""
    return {float(v): test["success_at_end"]["mean"] for v, test in record["tests"].items()}


def _halves(record: Record, end: float) -> str:
    """Where success halves on the way to one end."""
    rates = successes(record)
    found = halving(record["attribute"], end, rates)
    if found.missing is not None:
        return "not finished"
    if found.after is None:
        return f"not in range: {rates[end]:.1%}"
    return f"{found.before:g} to {found.after:g}"


def _episodes(records: Group, names: Sequence[str]) -> str:
    """How many episodes the tests of these names had."""
    tests = [record["tests"].get(name) for record in records for name in names]
    return " or ".join(map(str, sorted({test["episodes"] for test in tests if test}))) or "no"


def _how(records: Sequence[Record]) -> list[str]:
    commits: dict[str, set[str]] = {}
    for record in records:
        used = [record, *record["tests"].values()]
        commits.setdefault(_machine(record), set()).update(_commit(by["git_commit"]) for by in used)
    listed = "\n".join(
        f"- {machine}; commits {', '.join(sorted(of))}" for machine, of in sorted(commits.items())
    )
    commands = []
    bisections, runs = split(records)
    for first, *_ in grouped(runs):
        commands.append(str(first["command"]))
        commands += [str(test["command"]) for test in first["tests"].values()]
    commands += [str(record["command"]) for record in bisections]
    return ["## How\n", listed + "\n", _STUDY, "```bash", *commands, "```\n"]


def _commit(name: str | None) -> str:
    """A short commit; what was modified when it ran stays marked."""
    commit, plus, modified = str(name).partition("+")
    return commit[:10] + plus + modified


def _machine(record: Record) -> str:
    machine = record["machine"] or {}
    kind = ", ".join(f"{machine.get(name)}" for name in ("system", "architecture", "processor"))
    used = ", ".join(f"{name} {value}" for name, value in (record["versions"] or {}).items())
    return f"{kind}, {machine.get('cpu_count')} CPUs; {used}"


# -- cells ------------------------------------------------------------------------------------


def _table(head: str, rows: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * (head.count("|") + 1)
    lines = [head, *(" | ".join(cells) for cells in [rule, *rows])]
    return "\n".join(f"| {line} |" for line in lines) + "\n"


def _iqm(scores: Sequence[float]) -> str:
    found = interquartile_mean(scores)
    return f"{found.mean:.1%} [{found.low * 100:.1f}, {found.high * 100:.1f}]"


def _tested(record: Record, test: str) -> str:
    """Success with its interval; a run without a test says so."""
    if test not in record["tests"]:
        return "not finished" if not record["finished"] else "not tested"
    found = record["tests"][test]["success_at_end"]
    return f"{found['mean']:.1%} [{found['low'] * 100:.1f}, {found['high'] * 100:.1f}]"


def _time_to_learn(record: Record) -> tuple[float | None, float | None]:
    """Steps and minutes until success stays; None where it does not, or training ended early."""
    curves = record["evaluations"]
    index = settled(curves.get("success_at_end", [])) if record["finished"] else None
    if index is None:
        return None, None
    return float(curves["steps"][index]), curves["wall_seconds"][index] / 60


def _or_never(value: float | None, form: str) -> str:
    return "never" if value is None else form.format(value)


def _values(group: Group, test: str, metric: str, key: str) -> list[float]:
    found = [record["tests"].get(test, {}).get(metric, {}).get(key) for record in group]
    return [float(value) for value in found if value is not None]


def _worst(group: Group, test: str, metric: str, form: str, factor: float = 1.0) -> str:
    values = _values(group, test, metric, "worst")
    return form.format(WORST[metric](values) * factor) if values else NONE


def _mean(group: Group, test: str, metric: str, form: str, spread: bool = False) -> str:
    values = _values(group, test, metric, "mean")
    if not values:
        return NONE
    text = form.format(sum(values) / len(values))
    ends = f" ({form.format(min(values))} to {form.format(max(values))})"
    return text + (ends if spread else "")
