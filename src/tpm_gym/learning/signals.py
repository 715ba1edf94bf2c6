"""Requests to stop: Ctrl-C, or the SIGTERM of a batch system."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType


@dataclass
class SignalListener:
    """Store of the first request to stop; the second request ends the process at once.

    The first request raises no exception: an exception in the middle of an update could leave a
    half-updated network, which would then be saved.
    """

    received: signal.Signals | None = None

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Handle SIGINT (Ctrl-C) and SIGTERM inside the context."""
        signals = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, self._receive) for number in signals}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            sys.exit(128 + number)
        self.received = signal.Signals(number)
