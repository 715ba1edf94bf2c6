"""Updates a second that the viewer handles while point P is dragged.

A client drags P through the task region over a websocket, as a page does, as fast as the server
takes it, and then 60 times a second. An update is handled when its posture is solved and all links
are on their way to the page. Needs the extra ``view``.

    python benchmarks/bench_viewer.py
"""

from __future__ import annotations

import threading
import time
from contextlib import closing
from typing import Any

import msgspec
import numpy as np
import viser
from websockets.sync.client import ClientConnection, connect

from tpm_gym.viewer import open_viewer
from tpm_gym.viewer.viewer import Viewer

SECONDS = 5.0
SLACK = 0.5  # s; time for the last updates to arrive


def drag(viewer: Viewer, page: ClientConnection, rate: float) -> tuple[int, int]:
    """Drag P at ``rate`` updates a second; return how many were sent, and how many handled."""
    region = viewer.explore.posture.machine.region
    low, high = np.array(region.low), np.array(region.high)
    handled = 0
    draw = viewer.robot.draw

    def count(places: Any) -> None:
        nonlocal handled
        draw(places)
        handled += 1

    viewer.robot.draw = count  # type: ignore[method-assign]
    start, sent = time.perf_counter(), 0
    while (now := time.perf_counter() - start) < SECONDS:
        share = 0.5 + 0.45 * np.sin(np.array([2.0, 3.0, 5.0]) * now)
        point = (low + share * (high - low)).tolist()
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
    return sent, handled


def receive(page: ClientConnection) -> None:
    """Take what the server sends, as a page does."""
    for _ in page:
        pass


def main() -> None:
    """Measure both operation modes."""
    with closing(open_viewer("wide", port=8600)) as viewer:
        address = viewer.address.replace("http", "ws")
        protocol: Any = f"viser-v{viser.__version__}"
        with connect(address, subprotocols=[protocol], max_size=None) as page:
            threading.Thread(target=receive, args=(page,), daemon=True).start()
            for operation in ("translating", "rotated"):
                viewer.explore.operation.value = operation
                viewer.worker.wait()
                for name, rate in (("as fast as possible", 1000.0), ("60 a second", 60.0)):
                    sent, handled = drag(viewer, page, rate)
                    print(
                        f"{operation}, {name}: {sent / SECONDS:.0f} a second sent, "
                        f"{handled / SECONDS:.0f} a second handled"
                    )


if __name__ == "__main__":
    main()
