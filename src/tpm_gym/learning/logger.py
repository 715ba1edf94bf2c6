"""Log of a run as CSV and TensorBoard events, which a resumed run continues."""

from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import CSVOutputFormat, Logger, TensorBoardOutputFormat
from tensorboard.compat.proto.event_pb2 import (  # type: ignore[import-untyped]
    Event,
    SessionLog,
)

from tpm_gym.learning.run_folder import PROGRESS_FILE


def make_logger(run: Path, resumed_at: int | None = None) -> Logger:
    """Open the log of a run; ``resumed_at`` is the step to which progress.csv was set back."""
    path = run / PROGRESS_FILE
    before = "" if resumed_at is None or not path.is_file() else path.read_text(encoding="utf-8")
    table = CSVOutputFormat(str(path))  # empties the file
    table.file.write(before)
    table.file.flush()
    table.keys = before.split("\n", 1)[0].split(",") if before else []
    events = TensorBoardOutputFormat(str(run))
    if resumed_at is not None:
        # TensorBoard then hides events that an earlier process logged after this step.
        start = Event(step=resumed_at + 1, session_log=SessionLog(status=SessionLog.START))
        writer: Any = events.writer
        writer._get_file_writer().add_event(start)
    return Logger(str(run), [table, events])
