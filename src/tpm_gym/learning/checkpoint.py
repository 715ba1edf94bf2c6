"""Checkpoints on disk: each is whole or not there, and says so itself if it has been damaged.

A checkpoint is a folder ``checkpoints/<step>/``. It is written as ``<step>.tmp``, flushed to the
disk and then renamed, so that a process killed at any moment leaves the ones before untouched.
``manifest.json`` holds the size and the SHA-256 of every file, and one of itself. Nothing in it is
a pickle that would be loaded: the files are JSON, NumPy arrays, and tensors that
``torch.load(weights_only=True)`` reads; all of them are checked before they are parsed.
"""

import hashlib
import io
import json
import os
import re
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from tpm_gym.learning.errors import CheckpointError
from tpm_gym.learning.run_folder import RESTORED

FORMAT: Final = 1
KEPT: Final = 2  # checkpoints; the second is there for when the first turns out to be damaged
MANIFEST: Final = "manifest.json"
ARRAYS: Final = "arrays.npz"
STATE: Final = "state.json"
TENSORS: Final = "torch.pt"
FILES: Final = frozenset({MANIFEST, ARRAYS, STATE, TENSORS, *RESTORED})
"""All that a checkpoint may hold; a folder with anything else in it is not ours to delete."""

_NAME: Final = re.compile(r"\d{9,}")
_OURS: Final = re.compile(r"\d{9,}(\.tmp|\.old)?")
_SPARE: Final = 1 << 20  # bytes that have to stay free besides, for logs and headers


@dataclass(frozen=True)
class Content:
    """What a checkpoint holds: small files, named as in :data:`FILES`, and large arrays, by name.

    Arrays may be views into memory that training writes to.
    """

    step: int
    finished: bool
    files: Mapping[str, bytes]
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes on the disk, to a few kilobytes."""
        arrays = sum(array.nbytes for array in self.arrays.values())
        return arrays + sum(len(data) for data in self.files.values())


@dataclass
class CheckpointStore:
    """The checkpoints of one run, in a folder that is made when the first is saved."""

    folder: Path
    _whole: list[int] = field(default_factory=list, init=False)  # steps kept, oldest first

    @property
    def newest(self) -> int | None:
        """Step of the newest whole checkpoint that was saved or loaded; None before."""
        return self._whole[-1] if self._whole else None

    def save(self, content: Content) -> None:
        """Write a checkpoint, then delete all but the last two.

        Raises:
            CheckpointError: The disk is full, or cannot be written for another reason. What
                was written of the new checkpoint is removed; the ones before are as they were.
        """
        if content.step == self.newest and not content.finished:
            return
        target = self._path(content.step)
        part = target.with_suffix(".tmp")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            _remove(part)  # left by a process that was killed
            self._check_space(content)
            part.mkdir()
            _fill(part, content)
            if target.exists():
                _remove(target.with_suffix(".old"))
                target.rename(target.with_suffix(".old"))
            part.rename(target)
            _flush_folder(self.folder)
        except BaseException as error:
            _remove(part)
            if isinstance(error, OSError):
                self._refuse(target, error.strerror or str(error), error)
            raise
        earlier = [step for step in self._whole if step != content.step]
        self._whole = [*earlier, content.step][-KEPT:]
        self._tidy()

    def load(self, warn: Callable[[str], object]) -> Content | None:
        """Read the newest checkpoint that is whole.

        Args:
            warn: Called with a sentence for every newer one that is damaged.

        Returns:
            Its content; None where there are no checkpoints.

        Raises:
            CheckpointError: There are some, but all are damaged.
        """
        steps = self._steps()
        problems = []
        for step in reversed(steps):
            try:
                content = _read(self._path(step))
            except CheckpointError as error:
                problems.append(str(error))
                continue
            for problem in problems:
                warn(f"{problem}; using the checkpoint before, of step {step:,}")
            # The damaged ones are deleted once there is a new one to take their place.
            self._whole = [earlier for earlier in steps if earlier <= step][-KEPT:]
            return content
        if not problems:
            return None
        listed = "".join(f"\n  {problem}" for problem in problems)
        anew = "start the run anew with --overwrite"
        raise CheckpointError(f"no checkpoint in {self.folder} is whole; {anew}:{listed}")

    def clear(self) -> None:
        """Delete all checkpoints, but nothing else that is in their folder."""
        self._whole = []
        if self.folder.is_dir():
            self._tidy()
            with suppress(OSError):  # something else is in it
                self.folder.rmdir()

    def _path(self, step: int) -> Path:
        return self.folder / f"{step:09d}"

    def _steps(self) -> list[int]:
        """Steps of all checkpoints in the folder, whole or damaged, oldest first."""
        if not self.folder.is_dir():
            return []
        names = (entry.name for entry in self.folder.iterdir())
        return sorted(int(name) for name in names if _NAME.fullmatch(name))

    def _check_space(self, content: Content) -> None:
        needed, free = content.size + _SPARE, shutil.disk_usage(self.folder).free
        if free < needed:
            problem = f"{needed / 1e6:,.1f} MB are needed, {free / 1e6:,.1f} MB are free"
            self._refuse(self._path(content.step), problem)

    def _refuse(self, target: Path, problem: str, cause: OSError | None = None) -> NoReturn:
        kept = "there is none yet" if self.newest is None else f"that of step {self.newest:,} stays"
        raise CheckpointError(f"cannot write checkpoint {target}: {problem}; {kept}") from cause

    def _tidy(self) -> None:
        """Delete what earlier processes and earlier checkpoints left, but nothing of the user's."""
        kept = {self._path(step).name for step in self._whole}
        for entry in self.folder.iterdir():
            if _OURS.fullmatch(entry.name) and entry.name not in kept:
                _remove(entry)


def _fill(folder: Path, content: Content) -> None:
    """Write all files of a checkpoint, the manifest last, and wait until the disk has them."""
    # Not compressed: that would take ten times as long and save little of random motion.
    archive = io.BytesIO()
    arrays: dict[str, Any] = dict(content.arrays)
    np.savez(archive, allow_pickle=False, **arrays)
    files = {**content.files, ARRAYS: archive.getvalue()}
    manifest = {
        "format": FORMAT,
        "step": content.step,
        "finished": content.finished,
        "files": {name: _fingerprint(data) for name, data in files.items()},
    }
    manifest["sha256"] = _digest(_canonical(manifest))
    files[MANIFEST] = (json.dumps(manifest, indent=2) + "\n").encode()
    for name, data in files.items():
        _write(folder / name, data)
    _flush_folder(folder)


def _read(folder: Path) -> Content:
    """Read a checkpoint after checking every byte of it."""
    manifest = _read_manifest(folder / MANIFEST)
    files = {}
    for name, expected in manifest["files"].items():
        data = _read_bytes(folder / name)
        if len(data) != expected["size"]:
            raise _damaged(
                folder / name, f"has {len(data):,} bytes instead of {expected['size']:,}"
            )
        if _fingerprint(data) != expected:
            raise _damaged(folder / name, "differs from what was written (SHA-256)")
        files[name] = data
    with np.load(io.BytesIO(files.pop(ARRAYS)), allow_pickle=False) as loaded:
        arrays = {name: loaded[name] for name in loaded.files}
    return Content(manifest["step"], manifest["finished"], files, arrays)


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(_read_bytes(path))
        digest = manifest.pop("sha256")
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise _damaged(path, "is not a manifest") from error
    if digest != _digest(_canonical(manifest)):
        raise _damaged(path, "differs from what was written (SHA-256)")
    if manifest["format"] != FORMAT:
        problem = f"has format {manifest['format']}, this version of tpm_gym reads {FORMAT}"
        raise _damaged(path, problem)
    return dict(manifest)


def _damaged(path: Path, problem: str) -> CheckpointError:
    return CheckpointError(f"damaged checkpoint: {path} {problem}")


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _damaged(path, f"cannot be read: {error.strerror}") from error


def _write(path: Path, data: bytes) -> None:
    """Write a new file and wait until the disk has it."""
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _flush_folder(folder: Path) -> None:
    """Wait until the disk has the names in a folder; Windows has no such call."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove(folder: Path) -> None:
    """Delete a folder of ours as far as possible; what stays goes after the next checkpoint."""
    with suppress(OSError):  # it is not there, or no folder
        if all(entry.name in FILES and entry.is_file() for entry in folder.iterdir()):
            shutil.rmtree(folder, ignore_errors=True)


def _fingerprint(data: bytes) -> dict[str, Any]:
    return {"size": len(data), "sha256": _digest(data)}


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _canonical(manifest: Mapping[str, Any]) -> bytes:
    """The text that the manifest's own digest is taken of."""
    return json.dumps(manifest, sort_keys=True).encode()
