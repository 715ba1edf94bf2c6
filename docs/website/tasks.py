"""A page for each registered task, from its class, its spaces, its expert and the records.

``make docs`` also writes docs/task-sheets.md, for readers who do not build these pages.

``tpm_task_modules`` in conf.py names further modules to import, which register tasks of their own.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
from PIL import Image
from sphinx.builders.html import StandaloneHTMLBuilder
from studies.figures import learning_curves
from studies.page import groups, split
from studies.records import read_records

import tpm_gym
from tpm_gym.errors import ConfigurationError
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.estimates import Estimate, wilson
from tpm_gym.learning.figure_style import save, style
from tpm_gym.learning.policies import load_policy
from tpm_gym.learning.rollout import TEST_SEED, run_episodes
from tpm_gym.simulation import Camera
from tpm_gym.tasks.expert import Expert
from tpm_gym.tasks.registry import TASKS
from tpm_gym.tasks.task import Task
from website.projects import GENERATED, ROOT, write

PAGES = GENERATED / "tasks"
SHEETS = ROOT / "docs" / "task-sheets.md"
EPISODES = 200
"""Episodes of the expert in each id."""
WIDTH, HEIGHT = 480, 360
CAMERAS = {"crossing": Camera((0.0, -0.01, 0.10), 0.75, yaw=85.0, pitch=-22.0)}
"""Cameras of films that the usual one does not suit: Crossing is seen along the plane it passes."""
_ROLE = re.compile(r":\w+:`~?(?:[\w.]*\.)?(\w+)`")


def setup(app: Any) -> None:
    """Write the pages before any page is read."""
    app.add_config_value("tpm_task_modules", [], "env")
    StandaloneHTMLBuilder.supported_image_types.append("image/webp")  # every browser shows it
    app.connect("builder-inited", lambda app: write_pages(app.config.tpm_task_modules))


def write_pages(modules: Sequence[str] = ()) -> None:
    """Write a page, a film and learning curves for each task, and delete pages of other tasks."""
    for module in modules:
        importlib.import_module(module)
    for name in TASKS:
        _draw_film(name)
        _draw_curves(name)
        write(PAGES / f"{name}.md", "\n".join(page(name)))
    write(SHEETS, "\n".join(sheets()))
    for old in PAGES.glob("*"):
        if not any(old.name.startswith(f"{name}.") or old.stem == name for name in TASKS):
            old.unlink()


def page(name: str) -> Iterator[str]:
    """Yield the lines of the page of a task, Markdown.

    Args:
        name: Name of the task in options, such as ``"pick_and_place"``.
    """
    ids = ids_of(name)
    tasks = {env_id: _task(env_id) for env_id in ids}
    task = next(iter(tasks.values()))
    yield from (f"# {_title(name)}", "", *_sentences(TASKS[name]), "")
    if _film(name).exists():
        seconds = task.control_period * _steps(ids[0])
        yield from (f"![The scripted expert in {ids[0]}, {seconds:g} s]({_film(name).name})", "")
    yield from _ids(tasks)
    yield from _scene(task)
    yield from _action(task)
    yield from _observation(task)
    yield from _reward(tasks)
    yield from _events(task)
    yield from _expert(ids)
    yield from _learning(name)


def sheets() -> Iterator[str]:
    """Yield the lines of the page with observation, reward and events of the package's tasks."""
    yield from (
        "# Observation, reward and success of each task",
        "",
        "`make docs` writes this page from the classes of [the tasks](../src/tpm_gym/tasks). "
        "Numbers are of the paper's machine; goals and entries are in the world frame. "
        "`help(tpm_gym.TPMEnv)` explains actions, frames and `info`.",
        "",
        "An observation is a dictionary of `achieved_goal`, `desired_goal` and `observation`, a "
        "vector that has the entries of these tables. An entry is stored as "
        "(value - centre) / scale; `env.unwrapped.task.decode` inverts that. "
        'The reward is the sum of the terms, `info["reward_terms"]`.',
        "",
    )
    for name in sorted(name for name in TASKS if TASKS[name].__module__.startswith("tpm_gym.")):
        tasks = {env_id: _task(env_id) for env_id in ids_of(name) if "Joints" not in env_id}
        task = next(iter(tasks.values()))
        yield from (f"## {_title(name)}", "", _sentences(TASKS[name])[0], "")
        yield f"Ids: {', '.join(f'`{env_id}`' for env_id in ids_of(name))}."
        yield from ("", f"{_goal(task)} `observation` has {task.observation_size} numbers:", "")
        yield from (*_entries(task), *_terms_of_reward(tasks), _success(task), "", *_events(task))


def ids_of(name: str) -> list[str]:
    """Return the ids of a task, those with sparse rewards first."""
    specs = [gym.spec(env_id) for env_id in tpm_gym.ENV_IDS]
    return [spec.id for spec in specs if spec.kwargs["task"] == name]


def _title(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _task(env_id: str) -> Task:
    with closing(gym.make_vec(env_id, num_envs=1, engine="analytic")) as envs:
        task: Task = envs.unwrapped.task  # type: ignore[attr-defined]
        return task


def _steps(env_id: str) -> int:
    return int(gym.spec(env_id).max_episode_steps or 0)


def _sentences(thing: Any) -> list[str]:
    """Return a docstring up to its sections, in Markdown."""
    text = inspect.cleandoc(thing.__doc__ or "")
    text = re.split(r"\n\n(?:Args|Attributes|Raises|Returns):\n", text)[0]
    return _ROLE.sub(r"`\1`", text).replace("``", "`").split("\n")


# -- sections -----------------------------------------------------------------------------------


def _ids(tasks: dict[str, Task]) -> Iterator[str]:
    yield from ("## Ids", "", "| id | action | reward |", "| --- | --- | --- |")
    for env_id, task in tasks.items():
        control = gym.spec(env_id).kwargs["control"]
        increments = "Cartesian increments" if control == "cartesian" else "joint increments"
        yield f"| `{env_id}` | {increments} | {task.reward} |"
    steps = _steps(next(iter(tasks)))
    yield from (
        "",
        f"An episode is truncated after {steps} control steps of {1e3 * task.control_period:g} ms. "
        f"It is successful if the goal is achieved within {1e3 * task.tolerance:g} mm at its end. "
        "[Options of `gym.make`](../../environments.md#options-of-gym-make) choose engine, machine "
        "and drive.",
        "",
    )


def _scene(task: Task) -> Iterator[str]:
    goals = f"{_goal(task)} Samplings of goals: {_code(task.samplings)}."
    yield from ("## Scene", "", goals, "")
    if task.scene.objects:
        yield from ("| object | width | height | mass |", "| --- | --- | --- | --- |")
        for block in task.scene.objects:
            width, height = (f"{1e3 * length:g} mm" for length in (block.width, block.height))
            yield f"| `{block.name}` | {width} | {height} | {1e3 * block.mass:g} g |"
        yield ""


def _goal(task: Task) -> str:
    points = "one point" if task.goal_size == 3 else f"{task.goal_size // 3} points"
    return f"A goal has {task.goal_size} numbers: the world coordinates in m of {points}."


def _action(task: Task) -> Iterator[str]:
    command = next(entry for entry in task.entries if entry.name == "command")
    step = ", ".join(f"{1e3 * value:.3g}" for value in command.scale)
    yield from (
        "## Action",
        "",
        f"{task.action_size} numbers in [-1, 1]; other values are clipped.",
    )
    yield from ("", "| entries | meaning |", "| --- | --- |")
    yield f"| 0 to 2, Cartesian | increment of the command for point P, at most {step} mm |"
    yield "| 0 to 2, joints | increment of the three joint positions, limited for P as above |"
    if task.vacuum:
        yield "| 3 | above 0: vacuum on |"
    yield ""


def _observation(task: Task) -> Iterator[str]:
    yield from (
        "## Observation",
        "",
        f"A dictionary of `achieved_goal` and `desired_goal`, ({task.goal_size},) m in the world "
        f"frame, and `observation`, ({task.observation_size},), which has these entries. Each is "
        "stored as (value - centre) / scale; `env.unwrapped.task.decode` inverts that.",
        "",
    )
    yield from _entries(task)


def _entries(task: Task) -> Iterator[str]:
    yield from (
        "| entry | size | unit | meaning | centre | scale |",
        "| --- | --- | --- | --- | --- | --- |",
    )
    for entry in task.entries:
        yield (
            f"| `{entry.name}` | {len(entry.scale)} | {entry.unit} | {entry.meaning} "
            f"| {_numbers(entry.centre)} | {_numbers(entry.scale)} |"
        )
    yield ""


def _reward(tasks: dict[str, Task]) -> Iterator[str]:
    yield from ("## Reward", "")
    yield from ("The reward is the sum of these terms, `info['reward_terms']`:", "")
    yield from _terms_of_reward(tasks)
    yield from (_success(next(iter(tasks.values()))), "")


def _terms_of_reward(tasks: dict[str, Task]) -> Iterator[str]:
    yield from ("| term | ids | value |", "| --- | --- | --- |")
    sparse, dense = ([i for i, t in tasks.items() if t.reward == r] for r in ("sparse", "dense"))
    task = tasks[sparse[0]]
    within = f"{1e3 * task.tolerance:g} mm"
    yield f"| `goal` | sparse | 0 if the distance to the goal (gap) is below {within}, else -1 |"
    own = type(task).goal_term is not Task.goal_term
    distance = "minus the distance to the goal (gap) / 0.1 m"
    yield f"| `goal` | dense | {_result(type(task).goal_term) if own else distance} |"
    safe = f"{task.machine.safe_conditioning:g}"
    yield (
        f"| `singularity` | all | -`penalty_weight` x (1 - (c / {safe})^4) if the conditioning "
        f"c = 1/cond(J) is below {safe}, else 0; -`penalty_weight` after a change of mode |"
    )
    always = _terms(sparse[0])
    for term in _terms(dense[0]):
        if term not in ("goal", "singularity"):
            which = "all" if term in always else "dense"
            yield f"| `{term}` | {which} | {_result(type(task).shaping)} |"
    yield ""


def _success(task: Task) -> str:
    """Return the condition of success; if the task overrides gap, in the words of its gap."""
    own = type(task).gap is not Task.gap
    distance = _result(type(task).gap) if own else "the distance to the goal"
    return f'Success, `info["is_success"]`: {distance} is below {1e3 * task.tolerance:g} mm.'


def _events(task: Task) -> Iterator[str]:
    """Yield the task's own entries of ``info``, if it has any."""
    if task.events:
        yield from ("| event in `info` | meaning |", "| --- | --- |")
        yield from (f"| `{e}` | {_result(getattr(type(task), e))} |" for e in task.events)
        yield ""


def _result(function: Any) -> str:
    """Return a function's docstring without "Return" and without the shape of the result."""
    text = " ".join(line for line in _sentences(function) if line)
    return re.sub(r", \((n|\.\.\.),\)( m)?", "", text).removeprefix("Return ").removesuffix(".")


def _terms(env_id: str) -> list[str]:
    with closing(gym.make_vec(env_id, num_envs=1, engine="analytic")) as envs:
        envs.reset(seed=0)
        *_, infos = envs.step(envs.action_space.sample() * 0)
        return [name for name in infos["reward_terms"] if not name.startswith("_")]


def _expert(ids: Sequence[str]) -> Iterator[str]:
    yield from ("## Expert", "")
    if solved(ids[0]) is None:
        yield from ("This task has no expert.", "")
        return
    yield from (
        f"Success of `tpm_gym.tasks.Expert` in {EPISODES} episodes of the analytic engine, "
        "measured when this page was built:",
        "",
        "| id | success, 95% interval | command |",
        "| --- | --- | --- |",
    )
    for env_id in ids:
        found = solved(env_id)
        command = f"tpm-gym evaluate --policy expert --env {env_id} --engine analytic"
        yield f"| `{env_id}` | {_share(found)} | `{command} --episodes {EPISODES}` |"
    yield ""


def solved(env_id: str) -> Estimate | None:
    """Return the expert's success at the end in the analytic engine; None without a plan."""
    with closing(make_envs(env_id, EPISODES, engine="analytic")) as envs:
        try:
            episodes = run_episodes(envs, load_policy("expert", envs), EPISODES, TEST_SEED)
        except ConfigurationError as error:
            if error.name == "expert":
                return None
            raise
    return wilson([episode.success_at_end for episode in episodes])


def _learning(name: str) -> Iterator[str]:
    runs = _runs(name)
    yield from ("## Learning", "")
    if not len(runs):
        yield from ("No training of this task is on record. [Train it](../../training.md).", "")
        return
    yield from (
        "Median of the seeds, from the records in [docs/results](../../results). Test episodes "
        "take place in PyBullet; minutes are wall-clock time, on two cores.",
        "",
        "| id | method | seeds | steps | success | minutes |",
        "| --- | --- | --- | --- | --- | --- |",
    )
    for group in groups(runs):
        first, tested = group.iloc[0], group["pybullet.success_at_end.mean"]
        yield (
            f"| `{first.env}` | {first.label} | {len(group)} | {first.steps:,} "
            f"| {tested.fillna(0).median():.1%} | {group.minutes.median():.1f} |"
        )
    yield from (
        "",
        f"![Learning curves of the ids]({_curves(name).name})",
        "",
        "[Results](../../results.md) has every run.",
        "",
    )


# -- pictures -----------------------------------------------------------------------------------


def _film(name: str) -> Path:
    return PAGES / f"{name}.webp"


def _curves(name: str) -> Path:
    return PAGES / f"{name}.curves.png"


def _draw_film(name: str) -> None:
    """Film an episode of the expert, where PyBullet is installed and the task has an expert."""
    env_id = ids_of(name)[0]
    if importlib.util.find_spec("pybullet") is None or solved(env_id) is None:
        return
    size: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "camera": CAMERAS.get(name, "table")}
    with closing(gym.make(env_id, render_mode="rgb_array", **size)) as env:
        expert, frames, done = Expert(env), [], False
        observation, _ = env.reset(seed=TEST_SEED + 6)
        while not done:
            frames.append(env.render())
            observation, _, _, done, _ = env.step(expert.act(observation))
    first, *rest = [Image.fromarray(frame) for frame in frames]
    shown = max(40, round(1e3 * TASKS[name].control_period))  # ms; faster is not seen
    lasting = [shown] * len(rest) + [1500]  # the end stays for a while
    PAGES.mkdir(parents=True, exist_ok=True)
    first.save(_film(name), save_all=True, append_images=rest, duration=lasting, loop=0, quality=80)


def _draw_curves(name: str) -> None:
    runs = _runs(name)
    if len(runs):
        PAGES.mkdir(parents=True, exist_ok=True)
        with style():
            save(learning_curves(runs), _curves(name))


def _runs(name: str) -> Any:
    runs, _ = split(read_records(ROOT / "docs" / "results"))
    return runs[runs["env"].isin(ids_of(name))]


# -- cells --------------------------------------------------------------------------------------


def _code(names: Sequence[str]) -> str:
    return ", ".join(f'`"{name}"`' for name in names)


def _numbers(values: Sequence[float]) -> str:
    return (
        ", ".join(f"{value:.3g}" for value in values)
        if len(set(values)) > 1
        else (f"{values[0]:.3g}")
    )


def _share(found: Estimate | None) -> str:
    return f"{found.mean:.1%} [{100 * found.low:.1f}, {100 * found.high:.1f}]" if found else "-"
