"""A whole checkpoint is left by a death at any moment, and damage anywhere is noticed."""

import errno
import json
import os
import resource
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tpm_gym.learning import checkpoint
from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.errors import CheckpointError

FILES = ("manifest.json", "state.json", "torch.pt", "arrays.npz")
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


def assert_equal(first: Content, second: Content) -> None:
    assert (first.step, first.finished) == (second.step, second.finished)
    assert first.files == second.files
    assert first.arrays.keys() == second.arrays.keys()
    for name, array in first.arrays.items():
        assert array.dtype == second.arrays[name].dtype
        np.testing.assert_array_equal(array, second.arrays[name])


def no_warning(text: str) -> None:
    raise AssertionError(text)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with whole checkpoints of steps 1 and 2."""
    store = CheckpointStore(tmp_path / "checkpoints")
    for step in (1, 2):
        store.save(content(step))
    return tmp_path / "checkpoints"


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_what_is_loaded_is_what_was_saved(folder: Path) -> None:
    store = CheckpointStore(folder)
    assert_equal(store.load(no_warning), content(2))
    assert store.newest == 2
    store.save(content(2, finished=True))
    assert CheckpointStore(folder).load(no_warning).finished


def test_the_last_two_are_kept_and_nothing_else_is_touched(folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")
    (folder / "000000001.old").mkdir()
    mine = [folder / "123456789.old" / "mine", folder / "000000004.tmp" / "torch.pt"]
    for path in mine:
        path.mkdir(parents=True)
    store = CheckpointStore(folder)
    store.load(no_warning)
    for step in (3, 40):
        store.save(content(step))
    kept = ["000000003", "000000004.tmp", "000000040", "123456789.old", "notes.txt"]
    assert names(folder) == kept
    store.clear()
    assert names(folder) == [name for name in kept if not name.endswith(("3", "40"))]
    assert all(path.is_dir() for path in mine)


def test_checkpoints_are_ordered_by_number(folder: Path) -> None:
    store = CheckpointStore(folder)
    for step in (999_999_999, 1_000_000_000):
        store.save(content(step))
    assert CheckpointStore(folder).load(no_warning).step == 1_000_000_000


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "truncated": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "grown": lambda data: data + b"\0",
    "flipped": lambda data: flipped(data, len(data) // 2, 4),
    # What a file system may leave of a file whose content had not reached the disk
    "zeros": lambda data: bytes(len(data)),
}


def flipped(data: bytes, place: int, bits: int) -> bytes:
    return data[:place] + bytes([data[place] ^ bits]) + data[place + 1 :]


def damage(path: Path, kind: str = "flipped") -> None:
    path.write_bytes(DAMAGES[kind](path.read_bytes()))


@pytest.mark.parametrize("kind", [*DAMAGES, "gone"])
@pytest.mark.parametrize("name", FILES)
def test_any_damage_to_any_file_is_named_and_the_one_before_is_used(
    folder: Path, name: str, kind: str
) -> None:
    damaged = folder / "000000002" / name
    if kind == "gone":
        damaged.unlink()
    else:
        damage(damaged, kind)
    warned: list[str] = []
    store = CheckpointStore(folder)
    assert_equal(store.load(warned.append), content(1))
    assert len(warned) == 1
    assert str(damaged) in warned[0]
    assert "step 1" in warned[0]


def test_every_bit_of_the_manifest_counts(folder: Path) -> None:
    path = folder / "000000002" / "manifest.json"
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(flipped(whole, place, 1))
        try:
            loaded = CheckpointStore(folder).load(lambda text: None)
        except Exception as error:  # any other kind is what this looks for
            raise AssertionError(f"bit flip in byte {place}") from error
        # White space between entries means nothing; everything else is noticed.
        assert_equal(loaded, content(1 if not chr(whole[place]).isspace() else loaded.step))


def test_another_format_is_named(folder: Path) -> None:
    path = folder / "000000002" / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["sha256"]
    manifest["format"] = 99
    manifest["sha256"] = checkpoint._digest(checkpoint._canonical(manifest))
    path.write_text(json.dumps(manifest))
    warned: list[str] = []
    assert CheckpointStore(folder).load(warned.append).step == 1
    assert "has format 99" in warned[0]


def test_no_whole_checkpoint_says_what_to_do(folder: Path, tmp_path: Path) -> None:
    for where in (tmp_path / "nowhere", tmp_path):
        assert CheckpointStore(where).load(no_warning) is None
    damage(folder / "000000001" / "torch.pt")
    damage(folder / "000000002" / "arrays.npz", "truncated")
    with pytest.raises(CheckpointError, match="--overwrite") as caught:
        CheckpointStore(folder).load(no_warning)
    assert [path in str(caught.value) for path in ("torch.pt", "arrays.npz")] == [True, True]


def test_pickles_are_neither_written_nor_read(folder: Path) -> None:
    with pytest.raises(ValueError, match="allow_pickle"):
        CheckpointStore(folder).save(Content(3, False, {}, {"bad": np.array([object()])}))
    assert names(folder) == ["000000001", "000000002"]


def test_a_damaged_checkpoint_gives_way_to_the_next(folder: Path) -> None:
    store = CheckpointStore(folder)
    store.save(content(30))
    store.save(content(40))
    damage(folder / "000000040" / "torch.pt")
    store = CheckpointStore(folder)
    assert store.load(lambda text: None).step == 30
    assert "000000040" in names(folder)
    store.save(content(35))
    assert names(folder) == ["000000030", "000000035"]
    damage(folder / "000000035" / "torch.pt")
    store = CheckpointStore(folder)
    store.load(lambda text: None)
    store.save(content(35))  # done again, it ends at the same step
    assert names(folder) == ["000000030", "000000035"]
    assert_equal(CheckpointStore(folder).load(no_warning), content(35))


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

    EVENTS = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.scandir", "os.chmod")

    def __init__(self, operation: int) -> None:
        self.left = operation
        flush = os.fsync

        def fsync(handle: int) -> None:
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
    store.load(no_warning)
    Dying(operation)
    store.save(content(3))


def test_a_death_at_any_file_operation_leaves_a_whole_checkpoint(
    folder: Path, tmp_path: Path
) -> None:
    seen = set()
    for operation in range(1000):
        copy = tmp_path / f"copy{operation}"
        shutil.copytree(folder, copy)
        status = in_child(lambda copy=copy, operation=operation: save_and_die(copy, operation))
        assert status in (0, KILLED)
        store = CheckpointStore(copy)
        loaded = store.load(no_warning)
        assert_equal(loaded, content(loaded.step))
        seen.add(loaded.step)
        store.save(content(4))
        assert names(copy) == [f"{loaded.step:09d}", "000000004"]
        shutil.rmtree(copy)
        if status == 0:
            break
    assert operation > 15, "hardly any operation was seen"
    assert seen == {2, 3}


# -- disks that are full ------------------------------------------------------------------------


def save_with_limit(folder: Path, limit: int) -> None:
    """Save where no file can grow beyond a limit: a write that really fails half way."""
    store = CheckpointStore(folder)
    store.load(no_warning)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    with pytest.raises(CheckpointError, match="that of step 2 stays"):
        store.save(content(3))


@pytest.mark.parametrize("limit", [0, 10, 100, 4096, 6000, 12_000])
def test_a_write_that_fails_half_way_leaves_the_others_whole(folder: Path, limit: int) -> None:
    assert in_child(lambda: save_with_limit(folder, limit)) == 0
    assert names(folder) == ["000000001", "000000002"]
    assert_equal(CheckpointStore(folder).load(no_warning), content(2))


@pytest.mark.parametrize("moment", range(5))
@pytest.mark.parametrize(
    ("problem", "raised", "message"),
    [
        (OSError(errno.ENOSPC, "full"), CheckpointError, "full; that of step 2 stays"),
        (KeyboardInterrupt(), KeyboardInterrupt, None),
    ],
)
def test_a_flush_that_fails_is_named_and_the_partial_checkpoint_removed(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    problem: BaseException,
    raised: type[BaseException],
    message: str | None,
    moment: int,
) -> None:
    store = CheckpointStore(folder)
    store.load(no_warning)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", Mock(side_effect=[None] * moment + [problem]))
        with pytest.raises(raised, match=message):
            store.save(content(3))
    assert names(folder) == ["000000001", "000000002"]
    store.save(content(3))
    assert_equal(CheckpointStore(folder).load(no_warning), content(3))


def test_what_will_not_fit_is_not_begun(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = CheckpointStore(folder)
    store.load(no_warning)
    usage: Any = shutil.disk_usage(folder)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1_000_000))
    with pytest.raises(CheckpointError, match=r"1\.1 MB are needed, 1\.0 MB are free"):
        store.save(content(3))
    assert names(folder) == ["000000001", "000000002"]
    monkeypatch.undo()
    store.save(content(3))
    assert names(folder) == ["000000002", "000000003"]
