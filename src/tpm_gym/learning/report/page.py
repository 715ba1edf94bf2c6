"""The text of docs/results.md, from the records of runs."""

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from statistics import fmean, median
from typing import Any, Final

from tpm_gym.learning.estimates import LEARNED, median_time, settled
from tpm_gym.learning.robustness import OF_SERVOS, UNITS, ends, halving, nominal
from tpm_gym.learning.rollout import WORST
from tpm_gym.learning.study import StudyConfig, plan_runs
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation.randomisation import LIMITS

Record = dict[str, Any]
Group = list[Record]

LEARNING_CURVES, PENALTY = "results_learning_curves.png", "results_penalty.png"
ROBUSTNESS = "results_robustness.png"
ENGINES: Final = {"analytic": "closed form", "pybullet": "PyBullet"}
"""Of tests: what the page calls them."""
NONE: Final = "\N{EM DASH}"

STUDIES: Final = (
    StudyConfig("results", engine="analytic"),
    StudyConfig(
        "results", engine="analytic", algos=("tqc",), envs=("TPMPickAndPlace-v0",), seeds=1
    ),
    StudyConfig("penalty", engine="analytic"),
    StudyConfig("robustness", engine="analytic"),
    StudyConfig("robustness", engine="pybullet", episodes=100),
)

_INTRO: Final = f"""# Results

Written by `make results` from the records in [results](results); no result here was typed by hand.

- **Success** is that of the last step of an episode. Each run is tested with the policy that did
  best in the evaluations during training, on held-out seeds that neither training nor those
  evaluations have seen, in the engine that it was trained in and in PyBullet. Intervals are
  Wilson's, at 95%. Of several seeds it is the median, and in brackets that of each, by seed; a run
  without a test counts as 0.
- **Time to {LEARNED:.0%}** is that of the first evaluation during training from which success stays
  at {LEARNED:.0%} or above to the end of training. Minutes are wall-clock and include the
  evaluations; minutes and steps include the playing of demonstrations. For several seeds it is the
  median, "never" where that is a run that never did.
- **Smallest conditioning** is the least 1/cond(J) of all steps of all test episodes (and seeds),
  **time below safe** the share of their steps with 1/cond(J) < \
{PAPER_TPM.safe_conditioning} (the mean of seeds): as
  tested in PyBullet.
"""


_HOW: Final = """\
With `+modified`, files that git tracks differed from the commit. A study runs on Ray (the extra
`cluster`), two runs at a time on this machine alone. With `--address` it runs on a cluster that
`ray start` has started, whose nodes see the working folder on a shared disk. A run whose process or
node dies goes on elsewhere from its last checkpoint. All of it again:
"""


def page(records: Sequence[Record], figures: Sequence[str]) -> str:
    """Return the page as Markdown."""
    bisections, runs = split(records)
    plain = [r for r in runs if r["goals"] == "sampled" and r["penalty_weight"] == 1.0]
    tempted = [r for r in runs if r["goals"] == "tempting"]
    parts = [_INTRO, *_missing(records), *_training(plain, figures), *_penalty(tempted, figures)]
    return "\n".join([*parts, *_robustness(bisections, figures), *_how(records)])


def command(config: StudyConfig) -> str:
    """The command of one of the studies."""
    words = ["tpm-gym study", "--plan", config.plan, "--engine", config.engine]
    for name in ("algos", "envs"):
        if chosen := getattr(config, name):
            words += [f"--{name}", *chosen]
    if config.seeds != StudyConfig.seeds:
        words += ["--seeds", str(config.seeds)]
    return " ".join([*words, "--episodes", str(config.episodes)])


def _missing(records: Sequence[Record]) -> list[str]:
    """What of the studies there are no records of."""
    there = {record["run"] for record in records}
    lines = []
    for config in STUDIES:
        planned = [run.folder.name for run in plan_runs(config)]
        left = [name for name in planned if name not in there]
        if left:
            kinds = Counter(re.sub(r"-s\d+$", "", name) for name in left)
            names = ", ".join(f"{kind} ({count})" for kind, count in kinds.items())
            lines.append(f"- `{command(config)}`: {'all of it' if left == planned else names}.")
    return ["## Not run yet\n", "\n".join(lines) + "\n"] if lines else []


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
        names = ("env", "algo", "recipe", "engine", "steps", "envs", "goals", "penalty_weight")
        key = json.dumps([record[name] for name in names], sort_keys=True)
        groups.setdefault(key, []).append(record)
    return list(groups.values())


def method(record: Record) -> str:
    """Name the algorithm of a run, and whether it begins with demonstrations."""
    recipe = record["recipe"]
    name = str(record["algo"]).upper() + (" + HER" if recipe["hindsight"] else "")
    return name + (", demonstrations" if recipe["demonstrations"] else "")


def engine_of(record: Record) -> str:
    """Name the engine of a record as the page does."""
    return ENGINES.get(record["engine"], str(record["engine"]))


def success(record: Record, test: str = "pybullet") -> float:
    """Success rate of a run in the test in an engine; 0 where it has none."""
    return float(record["tests"].get(test, {}).get("success_at_end", {}).get("mean", 0.0))


def _order(record: Record) -> tuple[Any, ...]:
    weight = record["penalty_weight"]
    return record["env"], method(record), record["engine"], record["steps"], weight, record["seed"]


# -- sections ---------------------------------------------------------------------------------


def _training(records: Group, figures: Sequence[str]) -> list[str]:
    """How well, and how fast, the recipes learn."""
    if not records:
        return []
    head = (
        "id | method | trained in | steps | success in closed form | success in PyBullet | "
        "steps to 95% | minutes to 95% | minutes in all"
    )
    rows = [_training_row(group) for group in grouped(records)]
    tested = (
        "Methods without demonstrations start from scratch. Steps are over all environments. "
        f"{_episodes(records)}\n"
    )
    parts = ["## Learning: from scratch, or with demonstrations\n", tested, _table(head, rows)]
    if LEARNING_CURVES in figures:
        parts.append(f"![Learning curves](images/{LEARNING_CURVES})\n")
        parts.append("A curve that does not start at 0 starts after the demonstrations.\n")
    head = (
        "id | method | seed | success in closed form | success in PyBullet | steps to 95% | "
        "minutes to 95% | minutes in all | smallest conditioning | time below safe | return"
    )
    runs = [_run_row(record) for group in grouped(records) for record in group]
    return [*parts, "### Every run\n", _table(head, runs), *_failures(records)]


def _training_row(group: Group) -> list[str]:
    times = [_time_to_learn(record) for record in group]
    first = group[0]
    return [
        first["env"],
        method(first),
        engine_of(first),
        f"{first['steps']:,}",
        *(_median(group, engine) for engine in ENGINES),
        _or_never(median_time([steps for steps, _ in times]), "{:,.0f}"),
        _or_never(median_time([minutes for _, minutes in times]), "{:.1f}"),
        f"{median(map(_minutes, group)):.1f}",
    ]


def _run_row(record: Record) -> list[str]:
    steps, minutes = _time_to_learn(record)
    return [
        record["env"],
        method(record),
        str(record["seed"]),
        *(_tested(record, engine) for engine in ENGINES),
        _or_never(steps, "{:,.0f}"),
        _or_never(minutes, "{:.1f}"),
        f"{_minutes(record):.1f}",
        _worst([record], "conditioning_min", "{:.3f}"),
        _mean([record], "unsafe_share", "{:.1%}"),
        _mean([record], "return", "{:.2f}"),
    ]


def _minutes(record: Record) -> float:
    """How long a training took; 0 where it did not come to an evaluation."""
    return float((record["evaluations"]["wall_seconds"] or [0.0])[-1]) / 60


def _failures(records: Group) -> list[str]:
    lines = []
    for record in sorted(records, key=_order):
        name = f"{record['env']}, {method(record)}, seed {record['seed']}"
        if record["goals"] == "tempting":
            name += f", penalty weight {record['penalty_weight']:g}"
        if not record["finished"]:
            reached = (record["evaluations"]["steps"] or [0])[-1]
            lines.append(f"- {name}: stopped after {reached:,} of {record['steps']:,} steps.")
        elif "pybullet" not in record["tests"]:
            lines.append(f"- {name}: not tested.")
        elif success(record) < LEARNED:
            lines.append(f"- {name}: success {_tested(record, 'pybullet')}, below {LEARNED:.0%}.")
    body = "\n".join(lines) if lines else f"None: every run has {LEARNED:.0%} or more."
    return ["### Failures\n", body + "\n"]


def _penalty(records: Group, figures: Sequence[str]) -> list[str]:
    """Whether the singularity penalty does what it is for."""
    if not records:
        return []
    head = (
        "id | method | trained in | penalty weight | success in closed form | success in PyBullet "
        "| return | time below safe (seeds) | smallest conditioning | conditioning, mean"
    )
    rows = [
        [
            group[0]["env"],
            method(group[0]),
            engine_of(group[0]),
            f"{group[0]['penalty_weight']:g}",
            *(_median(group, engine) for engine in ENGINES),
            _mean(group, "return", "{:.2f}"),
            _mean(group, "unsafe_share", "{:.1%}", spread=True),
            _worst(group, "conditioning_min", "{:.3f}"),
            _mean(group, "conditioning_mean", "{:.3f}"),
        ]
        for group in grouped(records)
    ]
    text = (
        "## Does the penalty work?\n\nTrained and tested on goals that tempt towards the "
        "singularity (`--goals tempting`): goals, and pucks, lie just within the safe threshold, "
        "and straight lines in the joint angles lead beyond it. Returns are counted with the "
        f"penalty, whatever a policy was trained with. {_episodes(records)}\n"
    )
    parts = [text, _table(head, rows), *_compared(records)]
    if PENALTY in figures:
        parts.append(f"![Success and time below safe by weight](images/{PENALTY})\n")
    return [*parts, *_failures(records)]


def _compared(records: Group) -> list[str]:
    """One line an id and method: time below safe without the penalty and with it."""
    shares: dict[tuple[str, str], dict[float, list[float]]] = {}
    for record in records:
        by_weight = shares.setdefault((record["env"], method(record)), {})
        values = by_weight.setdefault(record["penalty_weight"], [])
        values += _values([record], "unsafe_share", "mean")
    lines = []
    for (env, name), by_weight in sorted(shares.items()):
        if not (by_weight.get(0.0) and by_weight.get(1.0)):
            continue
        without, with_it = (fmean(by_weight[weight]) for weight in (0.0, 1.0))
        times = f"{without / with_it:,.0f} times less" if with_it > 0 else "never below"
        lines.append(
            f"- {env}, {name}: {without:.2%} without the penalty, {with_it:.3%} with it: {times}."
        )
    return ["Time below safe, mean over seeds:\n", "\n".join(lines) + "\n"] if lines else []


def _robustness(records: Group, figures: Sequence[str]) -> list[str]:
    """How far machines may differ from the one that the published policies were trained on."""
    if not records:
        return []
    parts = [
        "## Robustness\n\nThe published policies, trained on the nominal machine alone, on others "
        "that differ from it in one thing. Success halves between the two values given, found by "
        "bisection; or it does not up to the largest value, as far as a machine may differ here, "
        "and success there is given. Errors of lengths and biases are drawn up to the value in "
        "each episode, noise has it as its standard deviation; all else has the value itself. "
        "Twice as far off in lengths and biases, some machines have no assembly where their "
        "encoders say that they are at home.\n"
    ]
    for engine, name in ENGINES.items():
        of = [record for record in records if record["engine"] == engine]
        if of:
            episodes = " or ".join(sorted({str(record["episodes"]) for record in of}))
            parts += [f"In {name}, {episodes} episodes a test:\n", _bisections(of)]
    if ROBUSTNESS in figures:
        parts.append(f"![Success by what differs](images/{ROBUSTNESS})\n")
    return parts


def _bisections(records: Group) -> str:
    """A row for each end of each attribute, a column an id."""
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
    return _table(" | ".join(["what differs", "nominal", "up to", *ids]), rows)


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
        return f"{rates[end]:.1%} at {end:g}"
    return f"{found.before:g} to {found.after:g}"


def _episodes(records: Group) -> str:
    """How many episodes the tests in each engine had, as a sentence."""
    found = []
    for engine, name in ENGINES.items():
        tests = [record["tests"].get(engine) for record in records]
        counts = " or ".join(map(str, sorted({test["episodes"] for test in tests if test})))
        found.append(f"{counts or 'no'} in {name}")
    return f"Held-out episodes a seed: {', '.join(found)}."


def _how(records: Sequence[Record]) -> list[str]:
    studies = ["```bash", *map(command, STUDIES), "tpm-gym report collect", "make results", "```\n"]
    if not records:
        return ["## How\n", _HOW, *studies]
    commits: dict[str, set[str]] = {}
    for record in records:
        used = [record, *record["tests"].values()]
        commits.setdefault(_machine(record), set()).update(_commit(by["git_commit"]) for by in used)
    listed = "\n".join(
        f"- {machine}; commits {', '.join(sorted(of))}" for machine, of in sorted(commits.items())
    )
    text = "The commands of a single run are in its record in `docs/results`.\n"
    return ["## How\n", listed + "\n", _HOW, *studies, text]


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


def _median(group: Group, engine: str) -> str:
    """Median success in an engine, and each seed's; a dash where none was tested there."""
    if not any(engine in record["tests"] for record in group):
        return NONE
    rates = [success(record, engine) for record in group]
    return f"{median(rates):.1%} ({', '.join(f'{rate * 100:.1f}' for rate in rates)})"


def _tested(record: Record, test: str) -> str:
    """Success with its interval; a run that is not finished says so."""
    if test not in record["tests"]:
        return NONE if record["finished"] else "not finished"
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


def _values(group: Group, metric: str, key: str) -> list[float]:
    """A metric of the tests in PyBullet."""
    found = [record["tests"].get("pybullet", {}).get(metric, {}).get(key) for record in group]
    return [float(value) for value in found if value is not None]


def _worst(group: Group, metric: str, form: str) -> str:
    values = _values(group, metric, "worst")
    return form.format(WORST[metric](values)) if values else NONE


def _mean(group: Group, metric: str, form: str, spread: bool = False) -> str:
    values = _values(group, metric, "mean")
    if not values:
        return NONE
    text = form.format(sum(values) / len(values))
    ends = f" ({form.format(min(values))} to {form.format(max(values))})"
    return text + (ends if spread else "")
