"""A headless Chromium over the DevTools protocol's pipe: enough to look at a page and to use it."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# The browser reads commands at descriptor 3 and answers at 4, whatever numbers the pipes have here.
_LAUNCHER = (
    "import os, sys; r, w = int(sys.argv[1]), int(sys.argv[2]); "
    "r, w = os.dup(os.dup(os.dup(r))), os.dup(os.dup(os.dup(w))); "
    "os.dup2(r, 3); os.dup2(w, 4); os.execvp(sys.argv[3], sys.argv[3:])"
)


class BrowserError(Exception):
    """The browser did not do what it was told to, or not in time."""


def chromium() -> str | None:
    """Return the path of a Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page in a headless Chromium with software WebGL; a context manager.

    `messages` holds what the page logs as errors or warnings, exceptions, and what its policy refused;
    `requests` every address that it asked for.
    """

    def __init__(self, program: str | None = None, timeout_s: float = 60.0) -> None:
        found = program or chromium()
        if found is None:
            raise BrowserError("there is no Chromium; mend it with: apt-get install chromium")
        self.timeout_s = timeout_s
        self.messages: list[str] = []
        self.requests: list[str] = []
        self._count = 0
        self._rest = b""
        self._profile = tempfile.mkdtemp(prefix="chromium-")
        flags = [
            "--headless=new",
            "--no-sandbox",
            "--use-gl=angle",
            "--use-angle=swiftshader",
            "--no-first-run",
            "--enable-unsafe-swiftshader",
            "--hide-scrollbars",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            f"--user-data-dir={self._profile}",
            "--remote-debugging-pipe",
            "--disable-extensions",
            "about:blank",
        ]
        there, self._out = os.pipe()
        self._in, back = os.pipe()
        with contextlib.ExitStack() as stack:
            for descriptor in (there, back):
                stack.callback(os.close, descriptor)
            self._process = subprocess.Popen(
                [sys.executable, "-c", _LAUNCHER, str(there), str(back), found, *flags],
                pass_fds=(there, back),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        fcntl.fcntl(self._in, fcntl.F_SETFL, os.O_NONBLOCK)
        target = self.send("Target.getTargets")["targetInfos"]
        page = next(info for info in target if info["type"] == "page")
        attached = self.send("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    _session: str | None = None

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *trouble: object) -> None:
        with contextlib.suppress(BrowserError, OSError):
            self._session = None
            self.send("Browser.close")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5)
        self._process.kill()
        self._process.wait()
        os.close(self._in)
        os.close(self._out)
        shutil.rmtree(self._profile, ignore_errors=True)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self._count += 1
        command: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            command["sessionId"] = self._session
        os.write(self._out, json.dumps(command).encode() + b"\0")
        end = time.monotonic() + self.timeout_s
        while True:
            message = self._message(end, method)
            if message.get("id") == self._count:
                if "error" in message:
                    raise BrowserError(f"{method}: {message['error']['message']}")
                return dict(message["result"])
            self._note(message)

    def _message(self, end: float, method: str) -> dict[str, Any]:
        while b"\0" not in self._rest:
            if not select.select([self._in], [], [], max(end - time.monotonic(), 0))[0]:
                raise BrowserError(f"{method}: no answer within {self.timeout_s:g} s")
            part = os.read(self._in, 1 << 20)
            if not part:
                raise BrowserError(f"{method}: the browser has ended")
            self._rest += part
        text, _, self._rest = self._rest.partition(b"\0")
        return dict(json.loads(text))

    def _note(self, message: dict[str, Any]) -> None:
        method, said = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = said["exceptionDetails"]
            self.messages.append(details.get("exception", {}).get("description") or details["text"])
        elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning", "assert"):
            self.messages.append(" ".join(str(a.get("value", a.get("description"))) for a in said["args"]))
        elif method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.messages.append(said["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(said["request"]["url"])

    def look(self, width: int, height: int, *, dark: bool = False, phone: bool = False) -> None:
        """Set the size of the window and the colour scheme."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])

    def open(self, path: str | Path, anchor: str = "") -> None:
        """Load a file and wait until it is there."""
        self.send("Page.navigate", url="about:blank")
        address = Path(path).resolve().as_uri() + (f"#{anchor}" if anchor else "")
        self.send("Page.navigate", url=address)
        self.wait("location.protocol === 'file:' && document.readyState === 'complete'")

    def run(self, script: str) -> Any:
        """Return the value of an expression, awaited; an exception becomes a BrowserError."""
        answer = self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", {}).get("description") or details["text"])
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + self.timeout_s
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > end:
                raise BrowserError(f"{condition} is not true after {self.timeout_s:g} s")
            time.sleep(0.05)

    def screenshot(self, path: str | Path | None = None, *, whole: bool = False) -> bytes:
        """Return what the window, or the whole page, shows as PNG; and write it."""
        clip = {}
        if whole:
            size = self.send("Page.getLayoutMetrics")["cssContentSize"]
            clip = {"clip": {**size, "scale": 1}, "captureBeyondViewport": True}
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png", **clip)["data"])
        if path is not None:
            Path(path).write_bytes(data)
        return data

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Do "mouseMoved", "mousePressed", "mouseReleased" or "mouseWheel" at a place."""
        held = (
            {"button": "left", "buttons": 1, "clickCount": 1}
            if kind in ("mousePressed", "mouseReleased")
            else {}
        )
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **{**held, **more})

    def drag(self, x: float, y: float, right: float, down: float, **more: Any) -> None:
        """Drag from a place."""
        self.mouse("mousePressed", x, y, **more)
        for part in (0.5, 1.0):
            self.mouse("mouseMoved", x + part * right, y + part * down, button="left", buttons=1, **more)
        self.mouse("mouseReleased", x + right, y + down, **more)

    def key(self, key: str, *, shift: bool = False) -> None:
        """Press a key by its name, such as ArrowLeft."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key, modifiers=8 if shift else 0)
