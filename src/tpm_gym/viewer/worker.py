"""Thread that runs all changes of the viewer, one after the other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

Job = Callable[[], object]


class Worker:
    """Thread that runs jobs in order; a new job replaces a waiting job of equal name.

    So a fast drag of the mouse skips postures instead of lagging behind.

    Args:
        on_error: Called with an exception of a job.
    """

    def __init__(self, on_error: Callable[[Exception], object]) -> None:
        """Start the thread."""
        self._on_error = on_error
        self._jobs: dict[str, Job] = {}
        self._ticking: tuple[float, Job] | None = None
        self._due = 0.0
        self._change = threading.Condition()
        self._busy = self._closed = False
        self._thread = threading.Thread(target=self._run, name="tpm-gym viewer", daemon=True)
        self._thread.start()

    def put(self, name: str, job: Job) -> None:
        """Run a job as soon as the jobs before it are done."""
        with self._change:
            self._jobs[name] = job
            self._change.notify_all()

    def ask(self, name: str, job: Job) -> None:
        """Run a job after a user has used a control of the page.

        Do nothing if this method is called because a job of this thread has changed the control.
        """
        if threading.current_thread() is not self._thread:
            self.put(name, job)

    def tick(self, period: float, job: Job) -> None:
        """Run a job every ``period`` seconds, or less often if other jobs take longer."""
        with self._change:
            self._ticking, self._due = (period, job), time.monotonic()
            self._change.notify_all()

    def stop_ticking(self) -> None:
        """Stop the periodic job."""
        with self._change:
            self._ticking = None

    def wait(self, timeout: float = 60.0) -> bool:
        """Wait until no job is left; return False if that takes longer than ``timeout`` s."""
        with self._change:
            return self._change.wait_for(lambda: not self._jobs and not self._busy, timeout)

    def close(self) -> None:
        """End the thread after the present job."""
        with self._change:
            self._closed = True
            self._change.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while (job := self._next()) is not None:
            self._try(job)

    def _try(self, job: Job) -> None:
        try:
            job()
        except Exception as error:
            self._on_error(error)

    def _next(self) -> Job | None:
        """Wait for the next job and remove it from the queue; return None after closing."""
        with self._change:
            self._busy = False
            self._change.notify_all()
            while not self._closed:
                # Jobs first: a periodic job that is always late would keep the others waiting.
                if self._jobs:
                    job = self._jobs.pop(next(iter(self._jobs)))
                    break
                if self._ticking is not None and time.monotonic() >= self._due:
                    period, job = self._ticking
                    self._due = max(self._due + period, time.monotonic())
                    break
                left = None if self._ticking is None else self._due - time.monotonic()
                self._change.wait(left)
            else:
                return None
            self._busy = True
            return job
