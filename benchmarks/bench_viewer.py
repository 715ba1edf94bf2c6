"""Updates a second that the viewer handles while point P is dragged.

A client drags P through the points of the task region that have a posture, over a websocket, as a
page does: as fast as the server takes it, then 60 times a second. An update is handled when its
posture is solved and all links are on their way to the page. The CPU time of the thread that
handles updates depends less on other programs. Needs the extra ``view``.

    python benchmarks/bench_viewer.py
"""

from __future__ import annotations

import os
import threading
import time
from contextlib import closing, suppress
from typing import Any

import msgspec
import numpy as np
import viser
from websockets.sync.client import ClientConnection, connect

from tpm_gym.errors import TPMError
from tpm_gym.viewer import open_viewer
from tpm_gym.viewer.viewer import Viewer

SECONDS = 5.0
PACE = 250.0  # 1/s; points of the path
SLACK = 0.5  # s; time for the last updates to arrive


def drag(viewer: Viewer, page: ClientConnection, rate: float) -> tuple[int, int, float]:
    """Drag P at ``rate`` updates a second; return counts sent and handled, and ms of CPU each."""
    path = points(viewer)
    handled, clock = 0, [0.0, 0.0]  # time of the thread that handles them, at first and last, s
    draw = viewer.robot.draw

    def count(places: Any) -> None:
        nonlocal handled
        draw(places)
        handled += 1
        clock[min(handled, 2) - 1] = time.thread_time()

    viewer.robot.draw = count  # type: ignore[method-assign]
    start, sent = time.perf_counter(), 0
    while (now := time.perf_counter() - start) < SECONDS:
        point = path[int(PACE * now) % len(path)].tolist()
        message = {
            "type": "TransformControlsUpdateMessage",
            "name": "/robot/P",
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": point,
            "owner": "",
        }
        page.send(msgspec.msgpack.encode(message))
        sent += 1
        time.sleep(max(0.0, sent / rate - (time.perf_counter() - start)))
    time.sleep(SLACK)
    viewer.robot.draw = draw  # type: ignore[method-assign]
    return sent, handled, 1000 * (clock[1] - clock[0]) / (handled - 1)


def points(viewer: Viewer) -> list[Any]:
    """Return a curve through the task region, less the points without a posture, m."""
    region, explore = viewer.explore.posture.machine.region, viewer.explore
    low, high = np.array(region.low), np.array(region.high)
    found = []
    for moment in np.arange(0.0, SECONDS, 1 / PACE):
        share = 0.5 + 0.45 * np.sin(np.array([2.0, 3.0, 5.0]) * moment)
        point = low + share * (high - low)
        with suppress(TPMError):
            viewer.kind.at_point(point, explore.operation.value, explore.working)
            found.append(point)
    return found


def receive(page: ClientConnection) -> None:
    """Take what the server sends, as a page does."""
    for _ in page:
        pass


def measure(machine: str) -> None:
    """Measure a machine in all its operation modes."""
    with closing(open_viewer(machine, port=8600)) as viewer:
        address = viewer.address.replace("http", "ws")
        protocol: Any = f"viser-v{viser.__version__}"
        with connect(address, subprotocols=[protocol], max_size=None) as page:
            threading.Thread(target=receive, args=(page,), daemon=True).start()
            for operation in viewer.explore.operation.options:
                viewer.explore.operation.value = operation
                viewer.worker.wait()
                for name, rate in (("as fast as possible", 1000.0), ("60 a second", 60.0)):
                    sent, handled, cost = drag(viewer, page, rate)
                    print(
                        f"{machine}, {operation}, {name}: {sent / SECONDS:.0f} a second sent, "
                        f"{handled / SECONDS:.0f} a second handled, {cost:.1f} ms of CPU each",
                        flush=True,
                    )


def main() -> None:
    """Measure the wide machine, which can be rotated everywhere, and the Delta."""
    for machine in ("wide", "delta"):
        measure(machine)
    print(f"load {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
