"""Chromium without a window, driven over its DevTools protocol."""

import base64
import json
import re
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)

_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader",
    "--remote-debugging-port=0",
)  # fmt: skip


class Browser:
    """A page in a browser of its own."""

    def __init__(self, address: str, width: int = 900, height: int = 600) -> None:
        assert CHROMIUM is not None
        self._folder = tempfile.mkdtemp()
        command = [CHROMIUM, *_FLAGS, f"--user-data-dir={self._folder}", "about:blank"]
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        told = Path(self._folder, "DevToolsActivePort")
        port = until(lambda: told.exists() and told.read_text().split("\n")[0])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(target for target in json.load(answer) if target["type"] == "page")
        self._socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self._number, self._events = 0, []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        self._call("Page.navigate", url=address)

    def close(self) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self._events.append(message)

    def evaluate(self, script: str) -> Any:
        """Return the value of JavaScript in the page, of a promise when it is kept."""
        options = {"returnByValue": True, "awaitPromise": True}
        found = self._call("Runtime.evaluate", expression=script, **options)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def frames(self, count: int) -> float:
        """Wait until the page has drawn this often; return how long that took, s."""
        start = time.monotonic()
        self.evaluate(f"""new Promise(done => {{
            let left = {count};
            const next = () => left-- > 0 ? requestAnimationFrame(next) : done(true);
            next();
        }})""")
        return time.monotonic() - start

    def click(self, text: str) -> None:
        """Click on the element that shows this text, once it is there."""
        script = f"""(() => {{
            const found = [...document.querySelectorAll('button, span, label, p, div')].find(
                e => !e.childElementCount && e.textContent.trim() === {json.dumps(text)}
                     && e.offsetParent);
            if (!found) return null;
            const box = found.getBoundingClientRect();
            return [box.x + box.width / 2, box.y + box.height / 2];
        }})()"""
        x, y = until(lambda: self.evaluate(script))
        self.press(x, y)
        self.release(x, y)

    def select(self, label: str, option: str) -> None:
        """Choose an option of the list with this label."""
        script = f"""(() => {{
            const found = [...document.querySelectorAll('label')].find(
                e => e.textContent.trim() === {json.dumps(label)} && e.offsetParent);
            if (!found) return null;
            const box = document.getElementById(found.htmlFor).getBoundingClientRect();
            return [box.x + box.width / 2, box.y + box.height / 2];
        }})()"""
        x, y = until(lambda: self.evaluate(script))
        self.press(x, y)
        self.release(x, y)
        self.click(option)

    def press(self, x: float, y: float) -> None:
        self._mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)

    def drag_to(self, x: float, y: float) -> None:
        self._mouse("mouseMoved", x, y, button="left", buttons=1)

    def release(self, x: float, y: float) -> None:
        self._mouse("mouseReleased", x, y, button="left", clickCount=1)

    def move(self, x: float, y: float) -> None:
        self._mouse("mouseMoved", x, y)

    def _mouse(self, kind: str, x: float, y: float, **options: Any) -> None:
        self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **options)

    def picture(self, path: Path) -> None:
        """Write a PNG of the page."""
        data = self._call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))

    @property
    def complaints(self) -> list[Any]:
        """Errors and exceptions in the console."""
        self.evaluate("1")  # takes in what was said until now
        wrong = []
        for event in self._events:
            name, params = event["method"], event["params"]
            error = name == "Runtime.consoleAPICalled" and params["type"] == "error"
            entry = name == "Log.entryAdded" and params["entry"]["level"] == "error"
            if error or entry or name == "Runtime.exceptionThrown":
                wrong.append(params)
        return wrong

    @property
    def requested(self) -> set[str]:
        """Schemes and hosts of what the page has asked for, such as ``http://127.0.0.1``."""
        self.evaluate("1")
        addresses = [
            event["params"]["request"]["url"]
            for event in self._events
            if event["method"] == "Network.requestWillBeSent"
        ]
        return {re.match(r"[a-z]+:(//[^/:]*)?", address)[0] for address in addresses}


def until(true: Callable[[], Any], seconds: float = 60.0) -> Any:
    """Wait until a function returns something true; return that."""
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
    return found
