"""Text of docs/results.md and docs/results-runs.md: tables of the records, in two templates."""

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from tpm_gym.errors import MissingPackageError
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.provenance import write_whole
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation.randomisation import LIMITS

from .bisection import SERVO_ATTRIBUTES, UNITS, ends, halving, nominal
from .plan import Study, plan_runs
from .records import RECORDS, Record, read_records

try:
    import jinja2
    import pandas as pd
except ImportError as error:
    raise MissingPackageError(str(error.name), "studies") from error

PAGE: Final = Path("docs", "results.md")
RUNS: Final = "results-runs.md"
"""Name of the page of every run, beside the page."""
BENCHMARK: Final = "benchmark.md"
"""Name of the page of all ids, beside the page."""
LEARNED: Final = 0.95
"""Success rate of a policy that has learned its task."""
ENGINES: Final = {"analytic": "analytic engine", "pybullet": "PyBullet"}
"""Display names of the engines."""
NONE: Final = "\N{EM DASH}"
STUDIES: Final = (
    Study("results", engine="analytic"),
    Study("results", engine="analytic", algos=("tqc",), envs=("TPMPickAndPlace-v0",), seeds=1),
    Study(
        "results",
        engine="analytic",
        algos=("ppo",),
        envs=(
            "TPMPush-v0",
            "TPMStack-v0",
            "TPMThrow-v0",
            "TPMConveyorDense-v0",
            "TPMCycle-v0",
            "TPMCrossing-v0",
        ),
    ),
    Study("penalty", engine="analytic"),
    Study("robustness", engine="analytic"),
    Study("robustness", engine="pybullet", episodes=100),
)

_SUCCESS: Final = "success_at_end.mean"
_METRICS: Final = (
    *(f"{engine}.success_at_end.{part}" for engine in ENGINES for part in ("mean", "low", "high")),
    *(f"pybullet.{name}.mean" for name in ("return", "unsafe_share", "conditioning_mean")),
    "pybullet.conditioning_min.worst",
    *(f"{engine}.episodes" for engine in ENGINES),
)
_ORDER: Final = ["env", "method", "engine", "steps", "penalty_weight", "seed"]
_GROUP: Final = [*_ORDER[:-1], "envs", "goals", "recipe"]
_MARK: Final = "Written by `make results` from the records in "

Frame = Any  # pandas has no types


@dataclass(frozen=True)
class Write:
    """Write the page, those of every run and of the benchmark, and their figures."""

    records: Path = RECORDS
    """Folder of the records."""

    page: Path = PAGE
    """The page; the others go beside it, figures to images/."""


def write(config: Write) -> list[Path]:
    """Write the page and its figures; return the files written.

    Raises:
        ConfigError: A record is damaged, or the page is a file that this function did not write.
    """
    from . import benchmark  # these import matplotlib
    from .figures import draw

    runs, summary = (config.page.with_name(name) for name in (RUNS, BENCHMARK))
    for old in (config.page, runs, summary):
        if old.exists() and not (old.is_file() and _MARK.encode() in old.read_bytes()):
            raise ConfigError(
                f"--page {old}: was written by hand, or by another program; "
                "move it elsewhere, or choose another --page"
            )
    records = read_records(config.records)
    images = config.page.parent / "images"
    figures = [*draw(records, images), *benchmark.draw(records, images)]
    names = [figure.name for figure in figures]
    texts = {
        config.page: page(records, names),
        runs: every_run(records),
        summary: benchmark.page(records, names),
    }
    for path, text in texts.items():
        write_whole(path, partial(Path.write_text, data=text, encoding="utf-8"))
    return [*texts, *figures]


def page(records: Sequence[Record], figures: Sequence[str]) -> str:
    """Return the page as Markdown.

    Args:
        records: All records.
        figures: File names of the figures to show.
    """
    runs, tempting = split(records)
    return render(
        "page.md.j2",
        safe=PAPER_TPM.safe_conditioning,
        missing=list(_missing(records)),
        episodes=_episodes,
        training=runs,
        training_table=partial(_training_table, runs),
        tempting=tempting,
        penalty_table=partial(_penalty_table, tempting),
        compared=partial(_compared, tempting),
        robustness=any("attribute" in record for record in records),
        figures=figures,
    )


def every_run(records: Sequence[Record]) -> str:
    """Return the page of every run as Markdown: its tests, robustness, machines, commands."""
    runs, tempting = split(records)
    return render(
        "runs.md.j2",
        failures=_failures,
        training=runs,
        runs_table=partial(_runs_table, runs),
        tempting=tempting,
        robustness=list(_robustness([record for record in records if "attribute" in record])),
        machines=_machines(records),
        commands=[command(study) for study in STUDIES],
    )


def render(template: str, **values: Any) -> str:
    """Fill a template of this folder, all of which get ``mark`` and ``learned``."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(values, mark=_MARK, learned=f"{LEARNED:.0%}")


def command(study: Study) -> str:
    """Return the command of a study."""
    words = ["python -m benchmarks.studies run --plan", study.plan, "--engine", study.engine]
    for name in ("algos", "envs"):
        if chosen := getattr(study, name):
            words += [f"--{name}", *chosen]
    if study.seeds != Study.seeds:
        words += ["--seeds", str(study.seeds)]
    return " ".join([*words, "--episodes", str(study.episodes)])


# -- frames: a row for each run -------------------------------------------------------------------


def split(records: Sequence[Record]) -> tuple[Frame, Frame]:
    """Return the trainings on goals as sampled, and those on tempting goals, a row for each run.

    Tests become columns such as "pybullet.success_at_end.mean", NaN where there was no test.
    Trainings with another penalty weight on goals as sampled are left out.
    """
    rows = [_row(record) for record in records if "attribute" not in record]
    runs = pd.DataFrame(rows, columns=list(rows[0]) if rows else [*_GROUP, "seed", *_METRICS])
    runs = runs.sort_values(_ORDER, kind="stable")
    plain = runs[(runs["goals"] == "sampled") & (runs["penalty_weight"] == 1.0)]
    return _labelled(plain), _labelled(runs[runs["goals"] == "tempting"])


def _row(record: Record) -> dict[str, Any]:
    curves, recipe = record["evaluations"], record["recipe"]
    steps, seconds = curves["steps"], curves["wall_seconds"]
    index = settled(curves.get("success_at_end", [])) if record["finished"] else None
    name = str(record["algo"]).upper() + (" + HER" if recipe["hindsight"] else "")
    tests = pd.json_normalize(record["tests"]).to_dict("records")
    return {
        **{name: record[name] for name in ("run", "env", "seed", "steps", "envs", "goals")},
        "finished": record["finished"],
        "penalty_weight": record["penalty_weight"],
        "method": name + (", demonstrations" if recipe["demonstrations"] else ""),
        "engine": ENGINES.get(record["engine"], record["engine"]),
        "recipe": json.dumps(recipe, sort_keys=True),
        "reached": record.get("reached", (steps or [0])[-1]),
        "minutes": (seconds or [0.0])[-1] / 60,
        "cpu_minutes": curves.get("cpu_seconds", [np.nan])[-1] / 60,
        "learned_steps": np.inf if index is None else steps[index],
        "learned_minutes": np.inf if index is None else seconds[index] / 60,
        "learned_seconds": np.inf if index is None else curves.get("cpu_seconds", seconds)[index],
        "curve": dict(zip(steps, curves.get("success_at_end", []), strict=False)),
        **dict.fromkeys(_METRICS, np.nan),
        **{name: tests[0][name] for name in _METRICS if tests and name in tests[0]},
    }


def settled(successes: Sequence[float]) -> int | None:
    """Return the index of the first evaluation from which success stays at ``LEARNED`` or above.

    None if the last evaluation is below, or there is none.
    """
    below = [index for index, success in enumerate(successes) if success < LEARNED - 1e-9]
    first = below[-1] + 1 if below else 0
    return first if first < len(successes) else None


def _labelled(runs: Frame) -> Frame:
    """Add a column "label": the method, with engine and steps where these differ between runs."""
    by_engine = runs.groupby(["env", "method"])["engine"].transform("nunique") > 1
    by_steps = runs.groupby(["env", "method", "engine"])["steps"].transform("nunique") > 1
    labels = [
        run.method
        + (f", {run.engine}" if engine else "")
        + (f", {run.steps:,} steps" if steps else "")
        for run, engine, steps in zip(runs.itertuples(), by_engine, by_steps, strict=True)
    ]
    return runs.assign(label=labels)


def groups(runs: Frame) -> list[Frame]:
    """Return runs that differ by their seed alone together, seeds in order."""
    return [group for _, group in runs.groupby(_GROUP, sort=False)]


# -- tables and lists -----------------------------------------------------------------------------


def _missing(records: Sequence[Record]) -> Iterator[tuple[str, str]]:
    """Yield the commands of studies that are not complete, and the missing runs."""
    there = {record["run"] for record in records}
    for study in STUDIES:
        planned = [run.folder.name for run in plan_runs(study)]
        left = [name for name in planned if name not in there]
        kinds = Counter(re.sub(r"-s\d+$", "", name) for name in left)
        names = ", ".join(f"{kind} ({count})" for kind, count in kinds.items())
        if left:
            yield command(study), "all of it" if left == planned else names


def _training_table(runs: Frame) -> Frame:
    """Return a row for each group of seeds; it tells the engine if there are several."""
    several = runs["engine"].nunique() > 1
    return pd.DataFrame(
        {
            "id": first.env,
            "method": first.method,
            **({"trained in": first.engine} if several else {}),
            "steps": f"{first.steps:,}",
            **_successes(group),
            "steps to 95%": _or_never(group.learned_steps.median(), "{:,.0f}"),
            "minutes in all": f"{group.minutes.median():.1f}",
            "minutes of CPU": _cell(group.cpu_minutes.dropna().median(), "{:.1f}"),
        }
        for group in groups(runs)
        for first in group.head(1).itertuples()
    )


def _runs_table(runs: Frame) -> Frame:
    return pd.DataFrame(
        {
            "id": run["env"],
            "method": run["label"],
            "seed": str(run["seed"]),
            **{f"success ({name})": _tested(run, engine) for engine, name in ENGINES.items()},
            "steps to 95%": _or_never(run["learned_steps"], "{:,.0f}"),
            "minutes to 95%": _or_never(run["learned_minutes"], "{:.1f}"),
            "minutes in all": f"{run['minutes']:.1f}",
            "minutes of CPU": _cell(run["cpu_minutes"], "{:.1f}"),
            "smallest conditioning": _cell(run["pybullet.conditioning_min.worst"], "{:.3f}"),
            "steps with unsafe conditioning": _cell(run["pybullet.unsafe_share.mean"], "{:.1%}"),
            "return": _cell(run["pybullet.return.mean"], "{:.2f}"),
        }
        for group in groups(runs)
        for run in group.to_dict("records")
    )


def _penalty_table(runs: Frame) -> Frame:
    def row(group: Frame) -> dict[str, str]:
        first, unsafe = group.iloc[0], group["pybullet.unsafe_share.mean"]
        spread = f" ({unsafe.min():.1%} to {unsafe.max():.1%})"
        return {
            "id": first.env,
            "method": first.label,
            "trained in": first.engine,
            "penalty weight": f"{first.penalty_weight:g}",
            **_successes(group),
            "return": _cell(group["pybullet.return.mean"].mean(), "{:.2f}"),
            "steps with unsafe conditioning (range of seeds)": _cell(
                unsafe.mean(), "{:.1%}" + spread
            ),
            "smallest conditioning": _cell(
                group["pybullet.conditioning_min.worst"].min(), "{:.3f}"
            ),
            "mean conditioning": _cell(group["pybullet.conditioning_mean.mean"].mean(), "{:.3f}"),
        }

    return pd.DataFrame([row(group) for group in groups(runs)])


def _compared(runs: Frame) -> list[str]:
    """Return a line for each id and method: steps with unsafe conditioning, by penalty."""
    shares = runs.groupby(["env", "label", "penalty_weight"])["pybullet.unsafe_share.mean"].mean()
    shares = shares.unstack().reindex(columns=[0.0, 1.0]).dropna()
    return [
        f"{env}, {label}: {without:.2%} without the penalty, {with_it:.3%} with it: "
        + (f"{without / with_it:,.0f} times less." if with_it > 0 else "never.")
        for (env, label), without, with_it in shares.itertuples()
    ]


def _failures(runs: Frame) -> list[str]:
    """Return a line for each run that stopped, was not tested, or did not learn its task."""
    lines = []
    for run in runs.to_dict("records"):
        success = run[f"pybullet.{_SUCCESS}"]
        if not run["finished"]:
            problem = f"stopped after {run['reached']:,} of {run['steps']:,} steps"
        elif np.isnan(success):
            problem = "not tested"
        elif success < LEARNED:
            problem = f"success {_tested(run, 'pybullet')}, below {LEARNED:.0%}"
        else:
            continue
        weight = f", penalty weight {run['penalty_weight']:g}" if run["goals"] == "tempting" else ""
        lines.append(f"{run['env']}, {run['label']}, seed {run['seed']}{weight}: {problem}.")
    return lines


def _robustness(records: Sequence[Record]) -> Iterator[tuple[str, str, Frame]]:
    """Yield each engine, its number of episodes, and a table: a row a limit, a column an id."""
    for engine, name in ENGINES.items():
        found = {(r["env"], r["attribute"]): r for r in records if r["engine"] == engine}
        if not found:
            continue
        ids = sorted({env for env, _ in found})
        rows = []
        for attribute, end in [(name, end) for name in LIMITS for end in ends(name)]:
            if not any((env, attribute) in found for env in ids):
                continue
            drive = ", servo drives" if attribute in SERVO_ATTRIBUTES else ""
            unit = UNITS.get(attribute, "factor") + drive
            rows.append(
                {
                    "attribute": f"{attribute.replace('_', ' ')} ({unit})",
                    "nominal": f"{nominal(attribute):g}",
                    "limit": f"{end:g}",
                    **{env: _halves(found.get((env, attribute)), end) for env in ids},
                }
            )
        episodes = " or ".join(sorted({str(record["episodes"]) for record in found.values()}))
        yield name, episodes, pd.DataFrame(rows)


def successes(record: Record) -> dict[float, float]:
    """Return the success rate of each value in the tests of a bisection."""
    return {float(v): test["success_at_end"]["mean"] for v, test in record["tests"].items()}


def _machines(records: Sequence[Record]) -> list[str]:
    """Return a line for each machine and its versions, with the commits that ran there."""
    commits: dict[str, set[str]] = {}
    for record in records:
        machine = record["machine"] or {}
        parts = [f"{machine.get(name)}" for name in ("system", "architecture", "processor")]
        used = [f"{name} {value}" for name, value in (record["versions"] or {}).items()]
        kind = f"{', '.join(parts)}, {machine.get('cpu_count')} CPUs; {', '.join(used)}"
        for source in (record, *record["tests"].values()):
            commit, plus, modified = str(source["git_commit"]).partition("+")
            commits.setdefault(kind, set()).add(commit[:10] + plus + modified)
    return [f"{kind}; commits {', '.join(sorted(of))}" for kind, of in sorted(commits.items())]


# -- cells ----------------------------------------------------------------------------------------


def _episodes(runs: Frame) -> str:
    """Return the numbers of episodes of the tests, as part of a sentence."""
    counts = {
        name: sorted(runs[f"{engine}.episodes"].dropna().astype(int).unique())
        for engine, name in ENGINES.items()
    }
    return ", ".join(
        f"{' or '.join(map(str, count)) or 'no'} ({name})" for name, count in counts.items()
    )


def _successes(group: Frame) -> dict[str, str]:
    """Return a cell for each engine: median success, and the range of the seeds."""
    cells = {}
    for engine, name in ENGINES.items():
        rates = group[f"{engine}.{_SUCCESS}"]
        filled = rates.fillna(0.0)
        spread = (
            f" ({100 * filled.min():.1f} to {100 * filled.max():.1f})" if len(rates) > 1 else ""
        )
        cell = NONE if rates.isna().all() else f"{filled.median():.1%}{spread}"
        cells[f"success ({name})"] = cell
    return cells


def _tested(run: dict[str, Any], engine: str) -> str:
    """Return success with its interval; "not finished" for a run that stopped before its test."""
    mean, low, high = (run[f"{engine}.success_at_end.{part}"] for part in ("mean", "low", "high"))
    if np.isnan(mean):
        return NONE if run["finished"] else "not finished"
    return f"{mean:.1%} [{low * 100:.1f}, {high * 100:.1f}]"


def _halves(record: Record | None, end: float) -> str:
    """Return the two values between which success halves on the way to a limit."""
    if record is None:
        return NONE
    rates = successes(record)
    found = halving(record["attribute"], end, rates)
    if found.missing is not None:
        return "not finished"
    if found.after is None:
        return f"{rates[end]:.1%} at {end:g}"
    return f"{found.before:g} to {found.after:g}"


def _or_never(value: float, form: str) -> str:
    return form.format(value) if np.isfinite(value) else "never"


def _cell(value: float, form: str) -> str:
    return NONE if np.isnan(value) else form.format(value)
