"""Headless Chromium, driven as a person drives it, for the tests and figures of the live page.

It speaks the browser's own DevTools protocol (chromedevtools.github.io/devtools-protocol) over
a websocket: clicks and keys go in where the mouse and the keyboard do, so that a button that
is covered, disabled or out of reach does not answer.

``python -m sim.testing.browser --install`` installs Debian's package ``chromium`` where no
browser is found.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from lscan.errors import LscanError
from sim.debian import PackageError, install_first

PACKAGE = "chromium"
NAMES = ("chromium", "chromium-browser", "google-chrome")
START_TIMEOUT_S = 60.0  # a start takes about 1 s; this is for a machine under heavy load
CALL_TIMEOUT_S = 60.0
POLL_S = 0.03

_OPTIONS = (
    "--headless=new",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-default-apps",
    "--disable-dev-shm-usage",  # containers give it 64 MiB
    "--disable-extensions",
    "--disable-gpu",
    "--disable-sync",
    "--mute-audio",
)
# Key names of the DevTools protocol with their Windows virtual key codes; text where they type.
_KEYS: Mapping[str, tuple[int, str]] = {
    "Tab": (9, ""),
    "Enter": (13, "\r"),
    "Escape": (27, ""),
    " ": (32, " "),
    "ArrowLeft": (37, ""),
    "ArrowRight": (39, ""),
    "Backspace": (8, ""),
}
_SHIFT = 8  # the protocol's bit for the Shift key


class BrowserError(LscanError):
    """Chromium is missing or does not do what it was asked; the line says which."""

    exit_code = 2


class BrowserMissing(BrowserError):
    """No Chromium on this machine; the line names the package."""


class Browser:
    """One page of a headless Chromium with a profile of its own, both gone after ``close``.

    Use as a context manager.  Raises BrowserMissing where there is no Chromium, and
    BrowserError where it does not start, stops answering, or waits in vain.
    """

    def __init__(self, width: int = 1280, height: int = 800) -> None:
        binary = find_chromium()
        self._errors: list[str] = []
        self._last_id = 0
        with ExitStack() as opened:
            kept = tempfile.TemporaryDirectory(prefix="lscan-browser-", ignore_cleanup_errors=True)
            profile = Path(opened.enter_context(kept))
            process = _start(binary, profile)
            opened.callback(_end, process)
            self._page = opened.enter_context(_attach(_wait_for_port(process, profile)))
            for domain in ("Page", "Runtime", "Log", "Network"):
                self.call(f"{domain}.enable")
            self.resize(width, height)
            self._opened = opened.pop_all()

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the browser and remove its profile; a second call does nothing."""
        self._opened.close()

    # ---- what a person does ---------------------------------------------------------------

    def open(self, url: str) -> None:
        """Load ``url`` and wait until it and its scripts are there."""
        failed = self.call("Page.navigate", url=url).get("errorText")
        if failed:
            raise BrowserError(f"{url}: the page does not load ({failed})")
        self.wait_for("document.readyState === 'complete'")

    def click(self, selector: str) -> None:
        """Click with the mouse on the middle of the element; BrowserError if it is covered."""
        place = self.evaluate(
            f"""(() => {{
              const element = document.querySelector({json.dumps(selector)});
              if (!element) return null;
              element.scrollIntoView({{block: "center", behavior: "instant"}});
              const box = element.getBoundingClientRect();
              const x = box.x + box.width / 2, y = box.y + box.height / 2;
              const top = document.elementFromPoint(x, y);
              return [x, y, element === top || element.contains(top)];
            }})()"""
        )
        if place is None or not place[2]:
            fault = "no such element" if place is None else "something covers it"
            raise BrowserError(f"click: {fault} (got {selector!r})")
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            held = {"button": "left", "clickCount": 1} if kind != "mouseMoved" else {}
            self.call("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], **held)

    def press(self, key: str, *, shift: bool = False) -> None:
        """Press and release one key: a character, or one of _KEYS as in KeyboardEvent.key."""
        code, text = _KEYS[key] if key in _KEYS else (ord(key.upper()) * key.isalnum(), key)
        event = {
            "key": key,
            "windowsVirtualKeyCode": code,
            "modifiers": _SHIFT if shift else 0,
        }
        typed = {"text": text} if text else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", **event, **typed)
        self.call("Input.dispatchKeyEvent", type="keyUp", **event)

    def type(self, text: str) -> None:
        """Press the keys of ``text`` one after the other."""
        for character in text:
            self.press(character)

    # ---- what a person sees ---------------------------------------------------------------

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression in the page, a promise awaited; JSON types only."""
        answer = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise BrowserError(f"{_told(answer['exceptionDetails'])} (in {script[:200]!r})")
        return answer["result"].get("value")

    def wait_for(self, condition: str, timeout_s: float = 120.0) -> Any:
        """The first true value of the JavaScript ``condition``; BrowserError after timeout_s."""
        deadline = time.monotonic() + timeout_s
        while True:
            value = self.evaluate(condition)
            if value:
                return value
            if time.monotonic() > deadline:
                raise BrowserError(f"not true within {timeout_s:g} s: {condition}")
            time.sleep(POLL_S)

    def resize(self, width: int, height: int, *, mobile: bool = False) -> None:
        """Show the page in a window of this many CSS pixels, touched if ``mobile``."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if mobile else 1,
            mobile=mobile,
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=mobile)

    def prefer(self, scheme: str) -> None:
        """Ask the page for its ``light`` or ``dark`` colours."""
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.call("Emulation.setEmulatedMedia", features=[feature])

    def screenshot(self, path: Path, *, whole: bool = False) -> None:
        """Write what the window shows, or the ``whole`` page, to ``path`` as PNG."""
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(shot["data"]))

    def take_errors(self) -> list[str]:
        """What the console complained of since the last call: exceptions, refusals, failures."""
        self.evaluate("1")  # events come in order: what happened before has been told now
        taken, self._errors = self._errors, []
        return taken

    # ---- the protocol ---------------------------------------------------------------------

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of one command of the DevTools protocol."""
        self._last_id += 1
        command = {"id": self._last_id, "method": method, "params": parameters}
        try:
            self._page.send(json.dumps(command))
            while True:
                message = json.loads(self._page.recv(timeout=CALL_TIMEOUT_S))
                if message.get("id") == self._last_id:
                    break
                self._note(message)
        except (TimeoutError, ConnectionClosed, OSError) as error:
            raise BrowserError(f"Chromium does not answer {method} ({error})") from error
        if "error" in message:
            raise BrowserError(f"{method}: {message['error'].get('message')}")
        result: dict[str, Any] = message["result"]
        return result

    def _note(self, message: Mapping[str, Any]) -> None:
        """Keep an event that tells of an error."""
        detail = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                self._errors.append(f"exception: {_told(detail['exceptionDetails'])}")
            case "Runtime.consoleAPICalled" if detail["type"] in ("error", "assert"):
                words = [str(argument.get("value", "")) for argument in detail["args"]]
                self._errors.append(f"console: {' '.join(words)}")
            case "Log.entryAdded" if detail["entry"]["level"] == "error":
                entry = detail["entry"]
                self._errors.append(f"{entry['source']}: {entry['text']} {entry.get('url', '')}")


def _start(binary: str, profile: Path) -> subprocess.Popen[bytes]:
    options = [*_OPTIONS, f"--user-data-dir={profile}"]
    if os.geteuid() == 0:
        options.append("--no-sandbox")  # Chromium refuses to run its sandbox as root
    with (profile / "stderr").open("wb") as stderr:
        return subprocess.Popen(
            [binary, *options, "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            start_new_session=True,
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # its helpers are in its group
    process.wait()


def _wait_for_port(process: subprocess.Popen[bytes], profile: Path) -> int:
    """The port at which the browser just started answers; BrowserError if it never does."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline and process.poll() is None:
        with suppress(OSError, ValueError, IndexError):
            return int((profile / "DevToolsActivePort").read_text().splitlines()[0])
        time.sleep(POLL_S)
    said = (profile / "stderr").read_text(errors="replace").strip()
    raise BrowserError(f"Chromium does not start ({said.splitlines()[-1] if said else 'no word'})")


def _attach(port: int) -> ClientConnection:
    """A connection to the page that the browser opened with."""
    listing = f"http://127.0.0.1:{port}/json/list"
    with urllib.request.urlopen(listing, timeout=CALL_TIMEOUT_S) as answer:
        targets = json.load(answer)
    page = next(target for target in targets if target["type"] == "page")
    return connect(page["webSocketDebuggerUrl"], max_size=None, open_timeout=CALL_TIMEOUT_S)


def _told(details: Mapping[str, Any]) -> str:
    """The first line of an exception as the protocol reports it."""
    thrown = details.get("exception", {})
    return str(thrown.get("description") or thrown.get("value") or details["text"]).split("\n")[0]


def find_chromium() -> str:
    """The browser to drive: LSCAN_CHROMIUM, or the first of NAMES that tells its version.

    Ubuntu's chromium-browser is a script that asks for a snap: being there is not enough.
    Raises BrowserMissing naming the package to install.
    """
    named = os.environ.get("LSCAN_CHROMIUM")
    for name in (named,) if named else NAMES:
        found = shutil.which(name)
        if found and _tells_version(found):
            return found
    if named:
        raise BrowserMissing(f"LSCAN_CHROMIUM: no such program, or no Chromium (got {named!r})")
    raise BrowserMissing(
        f"no Chromium here: install the Debian package {PACKAGE}, "
        "or name another one in LSCAN_CHROMIUM"
    )


def _tells_version(binary: str) -> bool:
    try:
        done = subprocess.run([binary, "--version"], capture_output=True, timeout=START_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and b"Chrom" in done.stdout


def find_or_install() -> str:
    """The browser to drive, installed first where there is none; BrowserMissing says why not."""
    try:
        return find_chromium()
    except BrowserMissing as missing:
        if os.environ.get("LSCAN_CHROMIUM"):
            raise
        try:
            install_first((PACKAGE,))
        except PackageError as refused:
            raise BrowserMissing(f"{missing}; {refused}") from refused
    return find_chromium()


def main(arguments: list[str] | None = None) -> int:
    """The exit code of ``python -m sim.testing.browser [--install]``.

    0 where there is a browser, else 2 after one line; with --install always 0, because the
    tests that need a browser skip without one and say why.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sim.testing.browser", description="Find the Chromium of the tests."
    )
    parser.add_argument("--install", action="store_true", help="install Chromium if none is here")
    options = parser.parse_args(arguments)
    try:
        print(find_or_install() if options.install else find_chromium())
    except BrowserMissing as error:
        print(error, file=sys.stderr)
        return 0 if options.install else error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
