"""The log of a run, as CSV and TensorBoard events, which a resumed run continues."""

from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import CSVOutputFormat, Logger, TensorBoardOutputFormat
from tensorboard.compat.proto.event_pb2 import (  # type: ignore[import-untyped]
    Event,
    SessionLog,
)

from tpm_gym.learning.run_folder import PROGRESS_FILE


def make_logger(run: Path, resumed_at: int | None = None) -> Logger:
    """Open the log of a run, which may go on at a step; its progress.csv has been cut back then."""
    path = run / PROGRESS_FILE
    before = "" if resumed_at is None or not path.is_file() else path.read_text(encoding="utf-8")
    table = CSVOutputFormat(str(path))  # empties the file
    table.file.write(before)
    table.file.flush()
    table.keys = before.split("\n", 1)[0].split(",") if before else []
    events = TensorBoardOutputFormat(str(run))
    if resumed_at is not None:
        _hide_later_events(events, resumed_at)
    return Logger(str(run), [table, events])


def _hide_later_events(events: TensorBoardOutputFormat, step: int) -> None:
    """Let TensorBoard drop what an earlier process logged after ``step``: it is done again."""
    start = Event(step=step + 1, session_log=SessionLog(status=SessionLog.START))
    writer: Any = events.writer
    writer._get_file_writer().add_event(start)
