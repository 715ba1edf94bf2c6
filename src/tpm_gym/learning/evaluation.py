"""Evaluate policies over seeded episodes: a table, and optionally JSON, a video and a picture."""

import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning import provenance
from tpm_gym.learning.configuration import UNSET, EnvOptions, check_least, shown_default, unset
from tpm_gym.learning.environments import check_env_id, make_env, make_envs
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.estimates import Estimate
from tpm_gym.learning.film import write_contact_sheet, write_video
from tpm_gym.learning.policies import TrainedPolicy, load_policy, trained_env
from tpm_gym.learning.rollout import (
    BATCH,
    TEST_SEED,
    Episode,
    GoalEnv,
    Policy,
    run_batch,
    run_episodes,
    summarise,
)

# Label, key, factor and format of each row of the table.
_ROWS = (
    ("success at end", "success_at_end", 100.0, "{:.1f}", "%"),
    ("success once", "success_once", 100.0, "{:.1f}", "%"),
    ("return", "return", 1.0, "{:.2f}", ""),
    ("conditioning, least", "conditioning_min", 1.0, "{:.3f}", ""),
    ("conditioning, mean", "conditioning_mean", 1.0, "{:.3f}", ""),
    ("share of steps below safe", "unsafe_share", 100.0, "{:.1f}", "%"),
    ("closure error, largest", "closure_error_max", 1e3, "{:.4f}", " mm"),
    ("observed P off, largest", "fk_error_max", 1e3, "{:.4f}", " mm"),
    ("torque, RMS", "torque_rms", 1.0, "{:.1f}", " N m"),
    ("torque, peak", "torque_peak", 1.0, "{:.1f}", " N m"),
)


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluate policies over seeded episodes: a table, and optionally JSON, a video and a picture.

    A .zip file of Stable-Baselines3 holds pickles, which can run any code: it is refused unless
    --trust-pickle is given.
    """

    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="POLICY ...")]
    """Policies: expert, random, the id of a published policy, an exported one (.json), or the
    folder of a run (its best)."""

    env: Annotated[str, unset(str, "the one the policy was trained on", "ID")] = UNSET
    """Environment id, or module:id for one that a module of yours registers."""

    episodes: int = 100
    """Episodes per policy."""

    seed: int = TEST_SEED
    """Seed of the first episode. The default is used neither in training nor to select policies."""

    goals: Literal["sampled", "tempting"] = "sampled"
    """As the environment samples them, or goals that tempt towards the singularity."""

    penalty_weight: float = 1.0
    """Weight of the singularity penalty in the return."""

    env_options: tyro.conf.OmitArgPrefixes[EnvOptions] = field(default_factory=EnvOptions)

    randomisation: Annotated[tuple[str, ...], shown_default("nowhere", "KEY=VALUE ...")] = ()
    """Where the machine differs from the nominal one: attributes of tpm_gym's Randomisation, each
    a number, or for factors LOW:HIGH to draw from, for example encoder_noise=1e-4 puck_mass=0.5:2.
    Those about the puck change nothing where there is none."""

    json: Annotated[Path | None, unset(Path, "not written", "PATH")] = None
    """Write metrics, episodes and versions here."""

    video: Annotated[Path | None, unset(Path, "not written", "PATH")] = None
    """Write an MP4 of the first episodes here; several policies get a file each."""

    video_episodes: int = 3
    """Episodes in a video."""

    picture: Annotated[Path | None, unset(Path, "not written", "PATH")] = None
    """Write a PNG of six moments of the first episode here; several policies get a file each."""

    trust_pickle: bool = False
    """Load .zip files as well, which can run any code that is in them."""


@dataclass(frozen=True)
class Result:
    """The evaluation of one policy, as it was named; the episodes took ``wall_seconds``."""

    policy: str
    metrics: dict[str, Estimate]
    records: list[Episode]
    wall_seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain data, the metrics at its top level."""
        steps = sum(record.length for record in self.records)
        return {
            "policy": self.policy,
            **{name: estimate.as_dict() for name, estimate in self.metrics.items()},
            "wall_seconds": self.wall_seconds,
            "steps_per_second": steps / self.wall_seconds,
            "records": [record.as_dict() for record in self.records],
        }


def evaluate(config: EvaluationConfig, console: Console | None = None) -> list[Result]:
    """Evaluate the policies of a configuration, in order, and write what it asks for.

    Args:
        console: Where the table is printed; by default the standard output.

    Raises:
        LearningError: An option is not valid, or a policy cannot be used.
        ConfigurationError: The environment has no such option, or not with this value.
    """
    # A file has no margin at which a table would have to be folded.
    console = console or Console(width=None if sys.stdout.isatty() else 200)
    _check(config)
    env_id = _resolve_env(config)
    with closing(_make_env(env_id, config)) as env:
        # All are loaded before the first one runs: a mistyped name shows at once.
        policies = list(zip(config.policy, _load(config, env), strict=True))
        results = [_evaluate_one(env, *policy, config, console) for policy in policies]
    console.print(_table(env_id, config, results))
    if config.json is not None:
        provenance.write_json(config.json, _description(env_id, config, results))
        console.print(f"json: {config.json}", markup=False)
    if config.video is not None or config.picture is not None:
        _film(env_id, config, console)
    return results


def _check(config: EvaluationConfig) -> None:
    check_least(config, 1, "episodes", "video_episodes")
    check_least(config, 0, "seed")
    if not config.policy:
        raise ConfigError("--policy: name at least one policy")
    for option, suffix in (("video", ".mp4"), ("picture", ".png")):
        path = getattr(config, option)
        if path is not None and path.suffix != suffix:
            raise ConfigError(f"--{option} {path}: must end in {suffix}")
    for option in ("json", "video", "picture"):
        if (path := getattr(config, option)) is not None:
            provenance.require_writable(f"--{option}", path)


def _resolve_env(config: EvaluationConfig) -> str:
    """Return the environment id that was asked for, or that the policies were trained on."""
    env_id = config.env
    if env_id is UNSET:
        ids = sorted({found for spec in config.policy if (found := trained_env(spec)) is not None})
        if not ids:
            raise ConfigError("expert and random have no environment of their own: give --env ID")
        if len(ids) > 1:
            raise ConfigError(
                f"policies were trained on {', '.join(ids)}: choose one with --env ID"
            )
        env_id = ids[0]
    check_env_id(env_id)
    return env_id


def _make_env(env_id: str, config: EvaluationConfig, render_mode: str | None = None) -> GoalEnv:
    return make_env(
        env_id,
        goals=config.goals,
        penalty_weight=config.penalty_weight,
        randomisation=parse_randomisation(config.randomisation),
        render_mode=render_mode,
        **config.env_options.given(),
    )


def _make_batch(env: GoalEnv, config: EvaluationConfig) -> TPMVectorEnv:
    """As many environments like this one as are worth running at a time."""
    assert env.spec is not None
    options = {k: v for k, v in env.spec.kwargs.items() if k != "render_mode"}
    return make_envs(env.spec.id, min(config.episodes, BATCH), **options)


def parse_randomisation(entries: Sequence[str]) -> dict[str, Any]:
    """Return words such as ``friction=0.5:1`` as a mapping; tpm_gym checks keys and values.

    Raises:
        ConfigError: A word has another form, or names something twice.
    """
    result: dict[str, Any] = {}
    for entry in entries:
        name, equals, text = entry.partition("=")
        try:
            numbers = [int(n) if n.isdecimal() else float(n) for n in text.split(":")]
        except ValueError:
            numbers = []
        if not (name and equals and 1 <= len(numbers) <= 2) or name in result:
            valid = "must be KEY=NUMBER or KEY=LOW:HIGH, each key once"
            raise ConfigError(f"--randomisation {entry}: {valid}")
        result[name] = numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])
    return result


def _load(config: EvaluationConfig, env: GoalEnv) -> list[Policy]:
    trust = config.trust_pickle
    return [load_policy(spec, env, trust_pickle=trust) for spec in config.policy]


def _evaluate_one(
    env: GoalEnv, spec: str, policy: Policy, config: EvaluationConfig, console: Console
) -> Result:
    """Run the episodes of one policy, with a progress bar on a terminal."""
    hidden = not console.is_terminal
    start = time.perf_counter()
    with Progress(console=console, disable=hidden) as bar:
        task = bar.add_task(spec, total=config.episodes)
        if config.env_options.in_batches and isinstance(policy, TrainedPolicy):
            with closing(_make_batch(env, config)) as envs:
                records = run_batch(envs, policy, config.episodes, config.seed)
        else:
            records = run_episodes(
                env, policy, config.episodes, config.seed, on_episode=lambda: bar.advance(task)
            )
        wall_seconds = time.perf_counter() - start
    return Result(spec, summarise(records), records, wall_seconds)


def _table(env_id: str, config: EvaluationConfig, results: Sequence[Result]) -> Table:
    """Lay the metrics out with a column per policy."""
    last = config.seed + config.episodes - 1
    table = Table(
        title=f"{env_id}: {config.episodes} episodes, seeds {config.seed} to {last}",
        caption="mean over episodes [95% interval]",
    )
    table.add_column("metric", no_wrap=True)
    for result in results:
        table.add_column(result.policy, justify="right", overflow="fold")
    for label, name, factor, form, unit in _ROWS:
        cells = [_cell(result.metrics[name], factor, form, unit) for result in results]
        table.add_row(label, *cells)
        worst = [result.metrics[name].worst for result in results]
        if any(value is not None for value in worst):
            table.add_row(
                "  worst of all steps",
                *(form.format((value or 0.0) * factor) + unit for value in worst),
                style="dim",
            )
    rates = [f"{result.as_dict()['steps_per_second']:.0f}" for result in results]
    table.add_row("steps per second", *rates)
    return table


def _cell(estimate: Estimate, factor: float, form: str, unit: str) -> str:
    mean, low, high = (
        form.format(value * factor) for value in (estimate.mean, estimate.low, estimate.high)
    )
    return f"{mean}{unit} \\[{low}, {high}]"


def _description(
    env_id: str, config: EvaluationConfig, results: Sequence[Result]
) -> dict[str, Any]:
    """Return what the JSON file records; a single policy has its metrics at the top level."""
    if len(results) == 1:
        content = results[0].as_dict()
        records = {"records": content.pop("records")}  # last: they are long
    else:
        content = {"policies": [result.as_dict() for result in results]}
        records = {}
    return {
        "env": env_id,
        "episodes": config.episodes,
        "seed": config.seed,
        "goals": config.goals,
        "penalty_weight": config.penalty_weight,
        "randomisation": parse_randomisation(config.randomisation),
        "env_options": config.env_options.given(),
        **content,
        **provenance.origin(),
        **records,
    }


def paths_per_policy(path: Path, policies: Sequence[str]) -> list[Path]:
    """Return one file per policy, with the policy's name in it where there are several."""
    if len(policies) == 1:
        return [path]
    names = [Path(spec).stem for spec in policies]
    if len(set(names)) < len(names):
        names = [f"{i + 1}-{name}" for i, name in enumerate(names)]
    return [path.with_name(f"{path.stem}-{name}{path.suffix}") for name in names]


def _film(env_id: str, config: EvaluationConfig, console: Console) -> None:
    """Run the first episodes once more, with rendering, which would have slowed the metrics."""
    with closing(_make_env(env_id, config, render_mode="rgb_array")) as env:
        for i, policy in enumerate(_load(config, env)):
            if config.video is not None:
                path = paths_per_policy(config.video, config.policy)[i]
                episodes = min(config.video_episodes, config.episodes)
                write_video(path, env, policy, episodes, config.seed)
                console.print(f"video: {path}", markup=False)
            if config.picture is not None:
                path = paths_per_policy(config.picture, config.policy)[i]
                write_contact_sheet(path, env, policy, config.seed)
                console.print(f"picture: {path}", markup=False)
