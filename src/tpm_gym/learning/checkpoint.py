"""Checkpoints on disk, each in one file, written atomically and with a checksum.

A checkpoint is the file ``checkpoints/<step>.checkpoint``: the SHA-256 of a NumPy archive, then the
archive. The file is written under another name, flushed to the disk and renamed, so a kill leaves
earlier checkpoints untouched. Nothing is unpickled. Small files (JSON, and tensors for
``torch.load(weights_only=True)``) are stored as arrays of bytes.
"""

import hashlib
import io
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tpm_gym.learning.errors import CheckpointError

FORMAT: Final = 5
KEPT: Final = 2  # checkpoints; the second is used if the first turns out to be damaged
STATE: Final = "state.json"
TENSORS: Final = "torch.pt"

_SUM: Final = hashlib.sha256().digest_size  # bytes
_NAME: Final = re.compile(r"(\d{9,})\.checkpoint(\.tmp)?")


@dataclass(frozen=True)
class Content:
    """Content of a checkpoint: small files and large arrays, both by name."""

    step: int
    finished: bool
    files: Mapping[str, bytes]
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@dataclass
class CheckpointStore:
    """Checkpoints of one run, in a folder that is made when the first checkpoint is saved."""

    folder: Path
    _whole: list[int] = field(default_factory=list, init=False)  # steps kept, oldest first

    @property
    def newest(self) -> int | None:
        """Step of the checkpoint that was saved or loaded last; None if there is none."""
        return self._whole[-1] if self._whole else None

    def path(self, step: int) -> Path:
        """Return the file of a step's checkpoint."""
        return self.folder / f"{step:09d}.checkpoint"

    def save(self, content: Content) -> None:
        """Write a checkpoint, then delete all but the newest two."""
        if content.step == self.newest and not content.finished:
            return
        target = self.path(content.step)
        part = target.with_name(f"{target.name}.tmp")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            _write(part, content)
            part.replace(target)
            _flush_folder(self.folder)
        except OSError as error:
            earlier = f"that of step {self.newest:,} stays" if self._whole else "there is none yet"
            raise CheckpointError(f"cannot write {target}: {error.strerror}; {earlier}") from error
        finally:
            with suppress(OSError):
                part.unlink(missing_ok=True)
        earlier_steps = [step for step in self._whole if step != content.step]
        self._whole = [*earlier_steps, content.step][-KEPT:]
        self._tidy()

    def load(self, warn: Callable[[str], object]) -> Content | None:
        """Read the newest checkpoint that is whole; return None if there are no checkpoints.

        ``warn`` is called with a sentence for each newer checkpoint that is damaged.
        """
        steps = self.steps()
        for step in reversed(steps):
            try:
                content = _read(self.path(step))
            except Exception as error:  # whatever NumPy raises on a damaged file
                warn(f"damaged checkpoint: {self.path(step)} ({error}); trying the one before")
                continue
            # A damaged checkpoint is deleted once a new one can take its place.
            self._whole = [earlier for earlier in steps if earlier <= step][-KEPT:]
            return content
        if steps:
            anew = "start the run anew with --overwrite"
            raise CheckpointError(f"no checkpoint in {self.folder} is whole; {anew}")
        return None

    def clear(self) -> None:
        """Delete all checkpoints, and no other file of their folder."""
        self._whole = []
        if self.folder.is_dir():
            self._tidy()
            with suppress(OSError):  # the folder holds other files
                self.folder.rmdir()

    def steps(self) -> list[int]:
        """Return the steps of all checkpoints in the folder, whole or damaged, oldest first."""
        if not self.folder.is_dir():
            return []
        found = (_NAME.fullmatch(entry.name) for entry in self.folder.iterdir())
        return sorted(int(match[1]) for match in found if match and not match[2])

    def _tidy(self) -> None:
        """Delete partial files of a killed process, and checkpoints that need not be kept.

        The checkpoints of the steps in ``_whole`` are kept.
        """
        kept = {self.path(step).name for step in self._whole}
        for entry in self.folder.iterdir():
            if _NAME.fullmatch(entry.name) and entry.name not in kept:
                with suppress(OSError):  # tried again after the next checkpoint
                    entry.unlink()


def _write(path: Path, content: Content) -> None:
    """Write a checkpoint and flush it to the disk."""
    entries: dict[str, Any] = {"head": np.array([FORMAT, content.step, content.finished])}
    entries |= {f"files/{k}": np.frombuffer(data, np.uint8) for k, data in content.files.items()}
    entries |= {f"arrays/{name}": array for name, array in content.arrays.items()}
    # Compression would take ten times as long, and data of random motion would hardly shrink.
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, **entries)
    with path.open("wb") as file:
        file.write(hashlib.sha256(archive.getbuffer()).digest())
        file.write(archive.getbuffer())
        file.flush()
        os.fsync(file.fileno())


def _read(path: Path) -> Content:
    """Read a checkpoint and verify its checksum."""
    data = path.read_bytes()
    if hashlib.sha256(memoryview(data)[_SUM:]).digest() != data[:_SUM]:
        raise ValueError("its SHA-256 differs from what was written")
    with np.load(io.BytesIO(data[_SUM:]), allow_pickle=False) as loaded:
        entries = {name: loaded[name] for name in loaded.files}
    version, step, finished = entries.pop("head").tolist()
    if version != FORMAT:
        raise ValueError(f"format {version}, this version of tpm_gym reads {FORMAT}")
    files = {name: array.tobytes() for name, array in starting(entries, "files/").items()}
    return Content(step, bool(finished), files, starting(entries, "arrays/"))


def starting(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names start with ``prefix``, and remove it from the names."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _flush_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk; do nothing on Windows, which has no such call."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
