"""Evaluation of policies over seeded episodes: a table, JSON, a video and a picture."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress
from rich.table import Table

from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning import provenance
from tpm_gym.learning.configuration import (
    GOALS,
    OF_TASK,
    UNSET,
    EnvOptions,
    GivenEnvOptions,
    Randomised,
    check_least,
    of_task,
    parse_randomisation,
    unset,
)
from tpm_gym.learning.environments import (
    USUAL,
    check_env_id,
    conditions_set_by,
    import_module_of,
    make_envs,
    set_by,
)
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.estimates import Estimate
from tpm_gym.learning.film import Frame, Play, write_contact_sheet, write_video
from tpm_gym.learning.policies import load_policy, trained_in
from tpm_gym.learning.rollout import BATCH, TEST_SEED, Episode, Policy, run_episodes, summarise
from tpm_gym.simulation.randomisation import Randomisation

_SHARE = (100.0, "{:.1f}", "%")  # factor, format and unit
# Label, key, factor, format and unit of each row of the table; the task's events are in between.
_SUCCESS = (
    ("success at end", "success_at_end", *_SHARE),
    ("success once", "success_once", *_SHARE),
)
_ROWS = (
    ("return", "return", 1.0, "{:.2f}", ""),
    ("conditioning, least", "conditioning_min", 1.0, "{:.3f}", ""),
    ("conditioning, mean", "conditioning_mean", 1.0, "{:.3f}", ""),
    ("share of steps with unsafe conditioning", "unsafe_share", *_SHARE),
    ("closure error, largest", "closure_error_max", 1e3, "{:.4f}", " mm"),
    ("observed P off, largest", "fk_error_max", 1e3, "{:.4f}", " mm"),
    ("torque, RMS", "torque_rms", 1.0, "{:.1f}", " N m"),
    ("torque, peak", "torque_peak", 1.0, "{:.1f}", " N m"),
)


@dataclass(frozen=True)
class EvaluationConfig:
    """Test policies on episodes that no training uses; print a table."""

    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="POLICY ...")]
    """expert, random, the id of a published policy, an exported policy or the folder of a run."""

    env: Annotated[str, unset(str, "the policy's; a module:id must be given", "ID")] = UNSET
    """Environment id, or module:id if a module of yours registers it. If the policy was
    trained in module:id, this option is required: importing a module runs its code, so a module is
    imported only if you name it."""

    episodes: int = 100
    """Episodes of each policy."""

    seed: int = TEST_SEED
    """Seed of the first episode. Training, and the choice of the best policy, use seeds below the
    default seed."""

    goals: Annotated[Literal["sampled", "tempting"], GOALS] = UNSET
    """Places of goals: "sampled" is anywhere in the task region, "tempting" is only next to a
    singularity of the robot."""

    penalty_weight: Annotated[float, unset(float, "the id's, mostly 1", "FLOAT")] = UNSET
    """Weight of the singularity penalty in the return."""

    env_options: GivenEnvOptions = field(default_factory=EnvOptions)

    randomisation: Randomised = ()
    """Attributes of Randomisation, each with a number (encoder_noise=1e-4) or with a range LOW:HIGH
    (block_mass=0.5:2)."""

    json: Annotated[Path | None, unset(Path, "not written", "PATH")] = None
    """File for metrics, episodes and versions."""

    video: Annotated[Path | None, unset(Path, "not written", "PATH")] = None
    """MP4 of the first episodes; several policies get a file each."""

    video_episodes: int = 3
    """Episodes of the video."""

    picture: Annotated[Path | None, unset(Path, "not written", "PATH")] = None
    """PNG of six different moments of the first episode; several policies get a file each."""

    camera: Literal["table", "overview", "cup"] = "table"
    """Camera of video and picture: the task region, the whole robot, or close to the cup."""


@dataclass(frozen=True)
class Result:
    """Evaluation of one policy: its name, metrics, episodes and the time they took."""

    policy: str
    metrics: dict[str, Estimate]
    records: list[Episode]
    wall_seconds: float

    @property
    def events(self) -> dict[str, str]:
        """Label of each event's metric in the table, as in ``{"crossed_once": "crossed once"}``."""
        return {name: name.replace("_", " ") for name in self.records[0].events}

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
    """Evaluate the policies of a configuration in order, and write the requested files.

    The table is printed on ``console``, by default the standard output.

    Raises:
        LearningError: An option is not valid, or a policy cannot be used.
        ConfigurationError: The environment does not have an option, or refuses its value.
    """
    # Output to a file has no margin at which a table must be folded.
    console = console or Console(width=None if sys.stdout.isatty() else 200)
    _check(config)
    config = _complete(config)
    count = min(config.episodes, BATCH) if config.env_options.in_batches else 1
    with closing(_make_envs(config, count)) as envs:
        # All policies are loaded before the first one runs, so that a mistyped name fails at once.
        policies = [(spec, load_policy(spec, envs)) for spec in config.policy]
        results = [_evaluate_one(envs, *policy, config, console) for policy in policies]
    console.print(_table(config, results))
    if config.json is not None:
        provenance.write_json(config.json, _description(config, results))
        console.print(f"json: {config.json}", markup=False)
    if config.video is not None or config.picture is not None:
        _film(config, console)
    return results


def _check(config: EvaluationConfig) -> None:
    if not config.policy:
        raise ConfigError("--policy: give at least one")
    check_least(config, 1, "episodes", "video_episodes")
    check_least(config, 0, "seed")
    for option, suffix in {"json": "", "video": ".mp4", "picture": ".png"}.items():
        if (path := getattr(config, option)) is not None:
            if not path.name.endswith(suffix):
                raise ConfigError(f"--{option} {path}: must end in {suffix}")
            provenance.require_writable(f"--{option}", path)


def _complete(config: EvaluationConfig) -> EvaluationConfig:
    """Take env, machine, drive and shield from the policies if they are not given.

    Goals and penalty weight that are not given are those of the environment id.
    """
    trained = {spec: found for spec in config.policy if (found := trained_in(spec)) is not None}
    if config.env is UNSET:
        if not trained:
            raise ConfigError("expert and random have no environment of their own: give --env ID")
        env_id = _common("env", {spec: env for spec, (env, _) in trained.items()})
    else:
        env_id = config.env
        import_module_of(env_id)
    given, usual = config.env_options.given(), _conditions(env_id, {})
    for name in ("machine", "drive", "shield"):
        values = {spec: found[name] for spec, (_, found) in trained.items() if name in found}
        if values and name not in given:
            given[name] = _common(name, values)
        if given.get(name) == usual[name]:  # a machine of the id may have no registered name
            del given[name]
    usual = of_task(env_id)
    missing = {name: value for name, value in usual.items() if getattr(config, name) is UNSET}
    return replace(config, env=env_id, env_options=EnvOptions(**given), **missing)


def _common(option: str, values: Mapping[str, Any]) -> Any:
    """Return the value of an option; raise ConfigError if the policies have different values."""
    found = set(values.values())
    if len(found) > 1:
        each = ", ".join(f"{value} ({spec})" for spec, value in values.items())
        example = f"--{option} {next(iter(values.values()))}"
        raise ConfigError(f"policies differ in {option}: {each}; choose one, as in {example}")
    return found.pop()


def _conditions(env_id: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the names of machine, engine and drive, and the shield.

    A value that is not given is the default of ``env_id``.
    """
    check_env_id(env_id)
    return {**USUAL, **conditions_set_by(env_id), **given}


def _shown(config: EvaluationConfig) -> dict[str, str]:
    """Return machine, engine, drive and shield as texts, for the table and the JSON file.

    The shield is left out if it is off.
    """
    found = _conditions(config.env, config.env_options.given())
    return {name: str(value) for name, value in found.items() if value is not False}


def _make_envs(
    config: EvaluationConfig, count: int, render_mode: str | None = None
) -> TPMVectorEnv:
    options: dict[str, Any] = {name: getattr(config, name) for name in OF_TASK}
    if config.randomisation:
        options["randomisation"] = parse_randomisation(config.randomisation)
    options |= config.env_options.given()
    pictures = {"render_mode": render_mode, "camera": config.camera}
    return make_envs(config.env, count, **pictures, **options)


def _evaluate_one(
    envs: TPMVectorEnv, spec: str, policy: Policy, config: EvaluationConfig, console: Console
) -> Result:
    """Run the episodes of one policy, with a progress bar on a terminal."""
    _say_without_bar(console, f"{spec}: {config.episodes:,} episodes")
    start = time.perf_counter()
    with bar(console, spec, config.episodes) as advance:
        records = run_episodes(envs, policy, config.episodes, config.seed, on_episodes=advance)
    return Result(spec, summarise(records), records, time.perf_counter() - start)


def _say_without_bar(console: Console, text: str) -> None:
    """Print ``text``, the description of a slow task, if the console shows no progress bar."""
    if not console.is_terminal:
        console.print(f"{text} ...", markup=False, soft_wrap=True)


@contextmanager
def bar(console: Console, text: str, total: int) -> Iterator[Callable[[int], object]]:
    """Show a progress bar on a terminal; yield a function that advances it."""
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        yield partial(bar.advance, bar.add_task(text, total=total))


def _table(config: EvaluationConfig, results: Sequence[Result]) -> Table:
    """Lay the metrics out with a column per policy."""
    where = ", ".join(f"{name} {value}" for name, value in _shown(config).items())
    seeds = f"seeds {config.seed} to {config.seed + config.episodes - 1}"
    table = Table(
        title=f"{config.env} ({where}): {config.episodes} episodes, {seeds}",
        caption="mean over episodes [95% interval]",
    )
    table.add_column("metric", no_wrap=True)
    for result in results:
        table.add_column(result.policy, justify="right", overflow="fold")
    events = [(label, name, *_SHARE) for name, label in results[0].events.items()]
    for label, name, factor, form, unit in (*_SUCCESS, *events, *_ROWS):

        def show(value: float, form: str = form, factor: float = factor) -> str:
            return form.format(value * factor)

        found = [result.metrics[name] for result in results]
        cells = [f"{show(e.mean)}{unit} \\[{show(e.low)}, {show(e.high)}]" for e in found]
        table.add_row(label, *cells)
        worst = [show(estimate.worst) + unit for estimate in found if estimate.worst is not None]
        if worst:
            table.add_row("  worst episode", *worst, style="dim")
    rates = [f"{result.as_dict()['steps_per_second']:.0f}" for result in results]
    table.add_row("steps per second", *rates)
    return table


def _description(config: EvaluationConfig, results: Sequence[Result]) -> dict[str, Any]:
    """Return the content of the JSON file; a single policy has its metrics at the top level."""
    policies = [result.as_dict() for result in results]
    content = policies[0] if len(policies) == 1 else {"policies": policies}
    records = {name: content.pop(name) for name in ("records",) if name in content}  # long, so last
    recorded = ("env", "episodes", "seed", "goals", "penalty_weight")
    return {
        **{name: getattr(config, name) for name in recorded},
        "randomisation": _randomisation(config),
        "env_options": _shown(config),
        **content,
        **provenance.origin(),
        **records,
    }


def _randomisation(config: EvaluationConfig) -> Any:
    """Return the given randomisation, or that of the environment id, as plain data."""
    if config.randomisation:
        return parse_randomisation(config.randomisation)
    own = (set_by(config.env) or {}).get("randomisation", {})
    return asdict(own) if isinstance(own, Randomisation) else own


def paths_per_policy(path: Path, policies: Sequence[str]) -> list[Path]:
    """Return one path per policy; if there are several, file names contain the policies' names."""
    if len(policies) == 1:
        return [path]
    names = [Path(spec).stem for spec in policies]
    if len(set(names)) < len(names):
        names = [f"{i + 1}-{name}" for i, name in enumerate(names)]
    return [path.with_name(f"{path.stem}-{name}{path.suffix}") for name in names]


def _film(config: EvaluationConfig, console: Console) -> None:
    """Repeat the first episodes with rendering, which is slow and not part of the evaluation."""
    count = min(config.video_episodes, config.episodes)
    frames = 1 + (check_env_id(config.env).max_episode_steps or 0)
    with closing(_make_envs(config, 1, "rgb_array")) as envs:
        policies = [load_policy(spec, envs) for spec in config.policy]
        fps = envs.metadata["render_fps"]
        films: tuple[tuple[str, Path | None, int, Callable[[Path, Play], None]], ...] = (
            ("video", config.video, count, partial(write_video, fps=fps)),
            ("picture", config.picture, 1, partial(write_contact_sheet, fps=fps)),
        )
        for kind, file, episodes, write in films:
            paths = paths_per_policy(file, config.policy) if file is not None else []
            for path, policy in zip(paths, policies, strict=False):
                _say_without_bar(console, f"drawing the {kind} {path}")
                with bar(console, kind, episodes * frames) as advance:
                    write(path, partial(_play, envs, policy, episodes, config.seed, advance))
                console.print(f"{kind}: {path}", markup=False)


def _play(
    envs: TPMVectorEnv,
    policy: Policy,
    episodes: int,
    first_seed: int,
    advance: Callable[[int], object],
    use: Callable[[Frame], object],
) -> None:
    """Play episodes; call ``use`` with every frame."""

    def frame() -> None:
        use(envs.render_tile(1))
        advance(1)

    run_episodes(envs, policy, episodes, first_seed, on_frame=frame)
