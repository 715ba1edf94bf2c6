"""Pages are short, their code runs, their commands exist, their numbers are those of records."""

import importlib
import json
import re
import shlex
import subprocess
from pathlib import Path

import engine_limits
import gymnasium as gym
import matplotlib
import pytest
import tyro
from pages import DOCS, PAGES, blocks, name_of, read
from paths import ROOT
from studies.__main__ import Command as StudiesCommand

import tpm_gym
from tpm_gym.errors import MissingPackageError
from tpm_gym.learning.command_line import Command

MOST_WORDS = 1200
EVIDENCE = {
    "docs/paper.md",  # every equation of the paper
    "docs/loops-sweep.md",  # a table
    "docs/results-runs.md",  # tables
    "docs/task-sheets.md",  # tables
}
FILLED = [
    ("README.md", "numbers", "readme_numbers"),
    ("README.md", "policies", "readme_numbers"),
    ("docs/fidelity.md", "summary", "fidelity_long"),
    ("docs/fidelity.md", "long", "fidelity_long"),
    ("docs/analytic-engine.md", "limits", "engine_limits"),
    ("docs/speed.md", "speed", "readme_numbers"),
    ("docs/speed.md", "analytic", "analytic_report"),
    ("docs/engines.md", "engines", "engine_report"),
    ("docs/datasets.md", "cloning", "bench_cloning"),
    *((f"docs/{name}.md", name, f"bench_{name}")
      for name in ("transfer", "shield", "cycle", "crossing", "conveyor")),
]  # fmt: skip
"""Page, marks around its numbers, and the module that writes them."""
RUN = [page for page in PAGES if blocks(page, "python") and page.name != "extending.md"]
TYPED = [page for page in PAGES if blocks(page, "bash")]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_is_short(page):
    most = 700 if page.name == "README.md" else MOST_WORDS
    assert name_of(page) in EVIDENCE or len(read(page).split()) <= most


@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_the_python_of_a_page_runs(page, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gym, "registry", gym.registry.copy())
    names = {"__name__": page.stem}
    with matplotlib.rc_context({"backend": "Agg"}):
        try:
            exec("\n".join(map(shortened, blocks(page, "python"))), names)
        except MissingPackageError as error:
            pytest.skip(str(error))
    for thing in names.values():
        if isinstance(thing, gym.Env | gym.vector.VectorEnv):
            thing.close()


def shortened(block):
    """Train for 100 steps and test one episode; test_wheel.py sees what is learned."""
    block = re.sub(r"learn\([\d_]+\)", "learn(100)", block)
    return block.replace("2_000_100", "2_000_001")


@pytest.mark.parametrize("page", TYPED, ids=name_of)
def test_the_commands_of_a_page_are_understood(page):
    for block in blocks(page, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            understand(shlex.split(line, comments=True))


def understand(words):
    """Parse a command line as its program does, without running it."""
    match words:
        case []:
            pass
        case ["cd", folder]:
            assert (ROOT / folder).is_dir()
        case ["tpm-gym", *options] | ["python", "-m", "tpm_gym.learning", *options]:
            tyro.cli(Command, args=options)
        case ["python", "-m", "rl_zoo3.train", *_]:
            pass  # tests/learning/test_zoo.py runs it
        case ["python", "-m", "benchmarks.studies", *options]:
            tyro.cli(StudiesCommand, args=options)
        case ["python", "benchmarks/engine_limits.py", *options]:
            engine_limits.parse(options)
        case ["make", target]:
            command = ["make", "--dry-run", "--directory", str(ROOT), target]
            subprocess.run(command, check=True, capture_output=True)
        case ["pip", "install", *options]:
            project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
            for extra in re.findall(r"\[([\w,]+)\]", " ".join(options)):
                for name in extra.split(","):
                    assert re.search(rf"^{name} = \[", project, re.MULTILINE), name
        case _:
            pytest.fail(f"no test knows the command {shlex.join(words)}")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_scripts_and_targets_that_a_page_names_exist(page):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for command in re.findall(r"`(?:\w+=\w+ )?((?:make|python) [^`]+)`", read(page)):
        match command.split():
            case ["make", *targets]:
                for target in targets:
                    assert re.search(rf"^{target}:", makefile, re.MULTILINE), command
            case ["python", script, *options] if script.endswith(".py"):
                text = (ROOT / script).read_text(encoding="utf-8")
                for option in options:
                    known = not option.startswith("--") or f'"{option}"' in text
                    assert known or "sys.argv" in text, command


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_id_on_a_page_exists(page):
    learned_elsewhere = re.compile(r"TPM(Sort|Hover|Shove|Land|Carry)")
    for env_id in re.findall(r"\bTPM\w+-v\d", read(page)):
        assert env_id in tpm_gym.ENV_IDS or learned_elsewhere.match(env_id), env_id


@pytest.mark.usefixtures("needs_pybullet")
@pytest.mark.parametrize(("page", "name", "module"), FILLED)
def test_the_numbers_of_a_page_are_those_of_its_record(page, name, module):
    begin, end = (f"<!-- {name}: {part} -->" for part in ("begin", "end"))
    found = read(ROOT / page).split(begin)[1].split(end)[0].strip().splitlines()
    assert found == "\n".join(expected(name, importlib.import_module(module))).strip().splitlines()


def expected(name, module):
    """Return the lines that a benchmark writes between the marks of that name."""
    if module.__name__ == "readme_numbers":
        record = module.read_record(module.RECORDS / "speed.json")
        return module.speed(record) if name == "speed" else getattr(module, name)()
    write = module.summary if name == "summary" else module.lines
    return write(json.loads(module.RECORD.read_text()) if module.RECORD.exists() else {})


def test_every_page_is_in_a_table_of_contents():
    trees = "\n".join(
        block
        for page in (DOCS / "index.md", DOCS / "tasks.md", DOCS / "api.md")
        for block in re.findall(r"```{toctree}\n(.*?)```", read(page), re.DOTALL)
    )
    listed = {re.sub(r".*<(.*)>", r"\1", line.strip()) for line in trees.splitlines()}
    for page in PAGES:
        inside = page.is_relative_to(DOCS) and page.name != "index.md"
        path = page.relative_to(DOCS).with_suffix("").as_posix() if inside else None
        assert path is None or path in listed, f"{path} is in no toctree"


def test_the_api_has_every_public_name():
    text = read(DOCS / "api" / "tpm_gym.md")
    for name in tpm_gym.__all__:
        assert name == "__version__" or re.search(rf":: tpm_gym\.{name}$", text, re.MULTILINE), name


def test_readme_is_short():
    text = read(ROOT / "README.md")
    assert text.count("![") == 1
    assert [len(block.splitlines()) for block in blocks(ROOT / "README.md", "bash")] == [2]
    assert Path(DOCS / "images" / "pick_and_place.gif").exists()
