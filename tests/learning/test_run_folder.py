"""The folder of a run: what may be deleted, and in which order."""

import errno
import json
import os
from pathlib import Path

import pytest
from trainings import Killed

from tpm_gym.learning import TrainingConfig, train
from tpm_gym.learning.errors import RunError
from tpm_gym.learning.run_folder import description, prepare

OURS = {"algo": "sac", "env": "TPMReach-v0", "training_seeds": [0, 0]}


@pytest.fixture
def run(tmp_path):
    """A run with files and folders."""
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "000000050.checkpoint").write_text("")
    (folder / "tests").mkdir()
    (folder / "tests" / "nominal.json").write_text('{"env": 1, "episodes": 1, "command": ""}')
    (folder / "config.json").write_text(json.dumps(OURS))
    files = ("best.zip", "last.safetensors", "progress.csv", "learning_curve.png")
    for name in (*files, "events.out.tfevents.1.host"):
        (folder / name).write_text("")
    return folder


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_run_is_replaced_only_if_asked_to(run):
    before = names(run)
    with pytest.raises(RunError, match="--overwrite"):
        prepare(run, overwrite=False)
    assert names(run) == before
    prepare(run, overwrite=True)
    assert names(run) == []


def test_the_partial_file_of_a_killed_process_does_not_occupy_a_folder(tmp_path):
    (tmp_path / ".config.json").write_text("{")
    prepare(tmp_path, overwrite=False)  # as for an empty folder, and nothing is deleted
    assert names(tmp_path) == [".config.json"]


@pytest.mark.parametrize("config", [None, '{"model_type": "bert"}', "{", "[]", '"text"'])
def test_what_another_program_wrote_is_never_deleted(config, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    if config is not None:
        (tmp_path / "config.json").write_text(config)
    before = names(tmp_path)
    assert description(tmp_path) is None
    with pytest.raises(RunError, match=r"config\.json of a training"):
        prepare(tmp_path, overwrite=True)
    assert names(tmp_path) == before


def test_a_death_while_deleting_leaves_a_run_that_can_be_deleted(run, monkeypatch):
    delete = Path.unlink

    def unlink(path, missing_ok=False):
        if path.name == "config.json":
            raise Killed
        delete(path, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", unlink)
        with pytest.raises(Killed):
            prepare(run, overwrite=True)
    assert names(run) == ["config.json"]
    prepare(run, overwrite=True)
    assert names(run) == []


def test_only_what_a_run_writes_is_deleted_and_no_link_is_followed(run, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "best.zip").write_text("")
    (run / "link").symlink_to(tmp_path / "elsewhere")
    strangers = ["notes.md", "tests/mine.json", "tests/plot.pdf", "checkpoints/copy/weights.pt"]
    for name in strangers:
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_text("{}")
    prepare(run, overwrite=True)
    assert {str(path.relative_to(run)) for path in run.rglob("*.*")} == set(strangers)
    assert names(run) == ["checkpoints", "link", "notes.md", "tests"]
    assert names(tmp_path / "elsewhere") == ["best.zip"]


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_a_folder_that_cannot_be_made_is_one_line(tmp_path, monkeypatch, number):
    def refuse(*args, **options):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(RunError, match=f"{os.strerror(number)}; choose another --run") as caught:
        train(TrainingConfig(run=tmp_path / "run"))
    assert "\n" not in str(caught.value)
