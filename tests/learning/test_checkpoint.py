"""A whole checkpoint is left by a death at any moment, and damage anywhere is noticed."""

import hashlib
import io
import json
import os
import resource
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.errors import CheckpointError

KILLED = 9


def content(step: int, finished: bool = False) -> Content:
    """Content that is different in every byte for every step."""
    rng = np.random.default_rng(step)
    return Content(
        step,
        finished,
        {"state.json": json.dumps({"step": step}).encode(), "torch.pt": rng.bytes(5000)},
        {"buffer/rows": rng.normal(size=(700, 3)), "buffer/place": np.array([step, 0])},
    )


def assert_equal(first: Content | None, second: Content) -> None:
    assert first is not None
    assert (first.step, first.finished) == (second.step, second.finished)
    assert first.files == second.files
    assert first.arrays.keys() == second.arrays.keys()
    for name, array in first.arrays.items():
        assert array.dtype == second.arrays[name].dtype
        np.testing.assert_array_equal(array, second.arrays[name])


@pytest.fixture
def folder(tmp_path):
    """A folder with whole checkpoints of steps 1 and 2."""
    store = CheckpointStore(tmp_path / "checkpoints")
    for step in (1, 2):
        store.save(content(step))
    return tmp_path / "checkpoints"


def file_of(step: int) -> str:
    return f"{step:09d}.checkpoint"


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_what_is_loaded_is_what_was_saved(folder):
    store = CheckpointStore(folder)
    assert_equal(store.load(pytest.fail), content(2))
    assert store.newest == 2
    store.save(content(2, finished=True))
    assert_equal(CheckpointStore(folder).load(pytest.fail), content(2, finished=True))


def test_the_last_two_are_kept_and_nothing_else_is_touched(folder):
    mine = ["1.checkpoint", "123456789.checkpoint.bak", "123456789.npz", "notes.txt"]
    for name in mine:
        (folder / name).write_text("mine")
    (folder / f"{file_of(5)}.tmp").write_text("left by a killed process")
    store = CheckpointStore(folder)
    store.load(pytest.fail)
    for step in (3, 40):
        store.save(content(step))
    assert names(folder) == sorted([*mine, file_of(3), file_of(40)])
    store.clear()
    assert names(folder) == mine


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda data: b"",
        lambda data: data + b"\0",
        lambda data: bytes(len(data)),  # as a file system may leave a file after a power failure
        *(lambda data, p=p: flipped(data, int(p * (len(data) - 1))) for p in (0, 0.001, 0.5, 1)),
    ],
)
def test_any_damage_is_named_and_the_one_before_is_used(folder, damage):
    damaged = folder / file_of(2)
    damaged.write_bytes(damage(damaged.read_bytes()))
    warned: list[str] = []
    store = CheckpointStore(folder)
    assert_equal(store.load(warned.append), content(1))
    (warning,) = warned
    assert str(damaged) in warning
    assert file_of(2) in names(folder)  # until a new one takes its place
    store.save(content(2))  # done again, it ends at the same step
    assert_equal(CheckpointStore(folder).load(pytest.fail), content(2))


def test_a_checkpoint_of_another_version_is_named(folder):
    archive = io.BytesIO()
    np.savez(archive, head=np.array([99, 2, 0]))
    signed = hashlib.sha256(archive.getvalue()).digest() + archive.getvalue()
    (folder / file_of(2)).write_bytes(signed)
    (folder / file_of(1)).unlink()
    warned: list[str] = []
    with pytest.raises(CheckpointError, match=r"is whole; .*--overwrite"):
        CheckpointStore(folder).load(warned.append)
    assert "format 99, this version of tpm_gym reads 5" in "".join(warned)


# -- dying ------------------------------------------------------------------------------------


def in_child(action: Callable[[], object]) -> int:
    """Run something in a process of its own; return its exit status."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads: of no interest here
        child = os.fork()
    if child == 0:
        status = 1
        try:
            action()
            status = 0
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


class Dying:
    """Ends the process at the n-th operation on files, before it takes place."""

    EVENTS = ("open", "os.mkdir", "os.rename", "os.remove", "os.scandir")

    def __init__(self, operation: int) -> None:
        self.left = operation
        flush = os.fsync

        def fsync(handle):
            self.count()
            flush(handle)

        os.fsync = fsync
        sys.addaudithook(lambda event, args: self.count() if event in self.EVENTS else None)

    def count(self) -> None:
        self.left -= 1
        if self.left < 0:
            os._exit(KILLED)


def save_and_die(folder: Path, operation: int) -> None:
    store = CheckpointStore(folder)
    store.load(pytest.fail)
    Dying(operation)
    store.save(content(3))


def test_a_death_at_any_file_operation_leaves_a_whole_checkpoint(folder, tmp_path):
    seen = set()
    for operation in range(1000):
        copy = tmp_path / f"copy{operation}"
        shutil.copytree(folder, copy)
        status = in_child(lambda copy=copy, operation=operation: save_and_die(copy, operation))
        assert status in (0, KILLED)
        store = CheckpointStore(copy)
        loaded = store.load(pytest.fail)
        assert loaded is not None
        assert_equal(loaded, content(loaded.step))
        seen.add(loaded.step)
        store.save(content(4))
        assert names(copy) == [file_of(loaded.step), file_of(4)]
        shutil.rmtree(copy)
        if status == 0:
            break
    assert operation >= 7, "hardly any operation was seen"
    assert seen == {2, 3}


# -- disks that are full ------------------------------------------------------------------------


def save_with_limit(folder: Path, limit: int) -> None:
    """Save where no file can grow beyond a limit: a write that really fails half way."""
    store = CheckpointStore(folder)
    store.load(pytest.fail)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    with pytest.raises(CheckpointError, match="that of step 2 stays"):
        store.save(content(3))


@pytest.mark.parametrize("limit", [0, 10, 100, 12_000])
def test_a_write_that_fails_half_way_leaves_the_others_whole(folder, limit):
    assert in_child(lambda: save_with_limit(folder, limit)) == 0
    assert names(folder) == [file_of(1), file_of(2)]
    assert_equal(CheckpointStore(folder).load(pytest.fail), content(2))
