"""A headless Chromium that photographs pages and says what is wrong with them, driven over a pipe."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import select
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from switchmt_snn.errors import MissingExtraError, TrainingFailed

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
"""What a browser of the Chromium family is called on the PATH."""
TIMEOUT_S = 60
"""A page or an answer that takes longer is an error."""
_SETTLE_S = 0.3
"""After a page has loaded: time for its scripts and for a late error."""


def find_browser() -> str:
    """Path of an installed browser.

    Raises:
        MissingExtraError: there is none.
    """
    for name in NAMES:
        if (path := shutil.which(name)) is not None:
            return path
    raise MissingExtraError(
        f"no browser to photograph pages with, expected one of {', '.join(NAMES)} on the PATH; run: apt-get install "
        "chromium"
    )


@dataclass(frozen=True)
class View:
    """How a page is looked at.

    Attributes:
        width: of the window, in CSS pixels.
        dark: the reader asked for dark colours.
        paper: as it is printed, in place of a screen.
        scale: device pixels per CSS pixel.
    """

    width: int = 1280
    dark: bool = False
    paper: bool = False
    scale: float = 1.0


@dataclass(frozen=True)
class Look:
    """What a view of a page showed.

    Attributes:
        height: of the whole page, in CSS pixels.
        too_wide: elements that reach beyond the window's right edge, so that the page scrolls sideways.
        complaints: errors and warnings of the console.
        requests: addresses that the page asked for, beyond itself and data that it holds.
    """

    height: int
    too_wide: tuple[str, ...]
    complaints: tuple[str, ...]
    requests: tuple[str, ...]


class Browser:
    """One page at a time; use ``opened()``."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._to, self._from = to_browser, from_browser
        self._pending = b""
        self._last = 0
        self._events: list[dict[str, Any]] = []
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = ""
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def look(self, page: Path, view: View) -> Look:
        """Open a page and see whether it is sound."""
        self._events.clear()
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=view.width,
            height=900,
            deviceScaleFactor=view.scale,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if view.dark else "light"}
        self._call("Emulation.setEmulatedMedia", media="print" if view.paper else "screen", features=[scheme])
        address = page.resolve().as_uri()
        self._call("Page.navigate", url=address)
        self._until("Page.loadEventFired")
        time.sleep(_SETTLE_S)
        height, too_wide = self.evaluate(_MEASURE)
        complaints, requests = [], []
        for event in self._events:
            facts = event["params"]
            if event["method"] == "Runtime.exceptionThrown":
                complaints.append(str(facts["exceptionDetails"].get("text")))
            elif event["method"] == "Log.entryAdded" and facts["entry"]["level"] in ("error", "warning"):
                complaints.append(str(facts["entry"]["text"]))
            elif event["method"] == "Runtime.consoleAPICalled" and facts["type"] in ("error", "warning", "assert"):
                complaints.append(" ".join(str(one.get("value")) for one in facts["args"]))
            elif event["method"] == "Network.requestWillBeSent":
                url = facts["request"]["url"]
                if url != address and not url.startswith("data:"):
                    requests.append(url)
        return Look(int(height), tuple(too_wide), tuple(complaints), tuple(requests))

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression in the open page; a promise is waited for."""
        answer = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise TrainingFailed(f"the page's script failed: {answer['exceptionDetails'].get('text')}")
        return answer["result"].get("value")

    def photograph(self, top: float, width: float, height: float) -> bytes:
        """A PNG of the open page from ``top`` on, at the view's scale."""
        clip = {"x": 0, "y": top, "width": width, "height": height, "scale": 1}
        shot = self._call("Page.captureScreenshot", format="png", clip=clip, captureBeyondViewport=True)
        return base64.b64decode(shot["data"])

    def print_pdf(self) -> bytes:
        """The open page as a PDF, on the paper that its style names."""
        shot = self._call("Page.printToPDF", printBackground=True, preferCSSPageSize=True)
        return base64.b64decode(shot["data"])

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._last += 1
        message: dict[str, Any] = {"id": self._last, "method": method, "params": params}
        if getattr(self, "_session", ""):
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._to, data) :]
        while True:
            answer = self._message(method)
            if answer.get("id") == self._last:
                if "error" in answer:
                    raise TrainingFailed(f"the browser refused {method}: {answer['error'].get('message')}")
                return dict(answer["result"])
            if "method" in answer:
                self._events.append(answer)

    def _until(self, event: str) -> None:
        while not any(seen["method"] == event for seen in self._events):
            self._events.append(self._message(event))

    def _message(self, awaited: str) -> dict[str, Any]:
        while b"\0" not in self._pending:
            ready, _, _ = select.select([self._from], [], [], TIMEOUT_S)
            part = os.read(self._from, 1 << 20) if ready else b""
            if not part:
                raise TrainingFailed(
                    f"the browser {'ended' if ready else f'was silent for {TIMEOUT_S} s'}, expected its answer to "
                    f"{awaited}; start it by hand to see why"
                )
            self._pending += part
        message, self._pending = self._pending.split(b"\0", 1)
        return dict(json.loads(message))


_MEASURE = """(() => {
  const wide = [...document.querySelectorAll('body *')].filter(e => {
    const box = e.getBoundingClientRect();
    if (!box.width || box.right <= document.documentElement.clientWidth + 1) return false;
    for (let up = e.parentElement; up; up = up.parentElement)
      if (getComputedStyle(up).overflowX !== 'visible') return false;
    return true;
  }).map(e => e.tagName.toLowerCase() + '.' + e.getAttribute('class') + ' ' + e.textContent.trim().slice(0, 40));
  const sideways = document.documentElement.scrollWidth > document.documentElement.clientWidth;
  return [document.documentElement.scrollHeight, sideways ? wide.concat(['the page']) : wide];
})()"""


@contextlib.contextmanager
def opened(path: str | None = None) -> Iterator[Browser]:
    """A browser that ends with the block.

    Args:
        path: of its program; None searches (``find_browser``).
    """
    program = path or find_browser()
    mine, theirs = _pipes()
    with tempfile.TemporaryDirectory(prefix="browser-", ignore_cleanup_errors=True) as profile:
        words = [
            program,
            "--headless=new",
            "--remote-debugging-pipe",
            "--no-sandbox",  # it opens our own pages only, and containers run as root
            "--disable-gpu",
            "--hide-scrollbars",
            "--no-first-run",
            "--disable-background-networking",
            f"--user-data-dir={profile}",
        ]
        files = [
            (os.POSIX_SPAWN_DUP2, theirs[0], 3),
            (os.POSIX_SPAWN_DUP2, theirs[1], 4),
            (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0),
        ]
        process = os.posix_spawn(program, words, os.environ, file_actions=files, setpgroup=0)
        for end in theirs:
            os.close(end)
        try:
            yield Browser(*mine)
        finally:
            for end in mine:
                os.close(end)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)


def _pipes() -> tuple[tuple[int, int], tuple[int, int]]:
    """(Our writing and reading end, the browser's reading and writing end), all above the numbers 3 and 4."""
    ends = []
    for end in (*os.pipe(), *os.pipe()):
        ends.append(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10))
        os.close(end)
    their_read, my_write, my_read, their_write = ends
    return (my_write, my_read), (their_read, their_write)
