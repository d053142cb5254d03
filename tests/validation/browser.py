"""Debian's Chromium, without a window and driven by Playwright, for tests and figures of pages.

Playwright is a package of the extra ``dev``; it downloads no browser here.
``python -m tests.validation.browser --install`` installs Debian's package ``chromium`` where no
browser is found.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from lscan.errors import LscanError
from sim.render.backend import found_or_installed

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


PACKAGE = "chromium"
NAMES = ("chromium", "chromium-browser", "google-chrome")
VERSION_TIMEOUT_S = 60.0  # it takes about 0.1 s; this is for a machine under heavy load
TIMEOUT_MS = 120_000.0


class BrowserError(LscanError):
    """Chromium is missing or does not do what it was asked; the line says which."""

    exit_code = 2


class BrowserMissing(BrowserError):
    """No Chromium, or no Playwright, on this machine; the line names the package."""


@contextmanager
def headless_chromium() -> Iterator[Browser]:
    """A Chromium without a window that ends, and whose profile is removed, with the block.

    Raises
    ------
    BrowserMissing
        Where there is no Chromium or no Playwright.
    BrowserError
        Where Chromium does not start, or does not do what the block asks of it.
    """
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        raise BrowserMissing(
            "no Playwright here: install the Python package playwright, or lscan[dev]"
        ) from error
    binary = find_chromium()
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(
                executable_path=binary,
                chromium_sandbox=os.geteuid() != 0,  # Chromium refuses to run its sandbox as root
                args=["--disable-gpu"],
            )
        except Error as error:
            output = re.search(r"\[err\] (.*)", error.message)
            reason = output[1] if output else _first_line(error)
            raise BrowserError(f"Chromium does not start ({reason})") from error
        try:
            yield browser
        except Error as error:
            raise BrowserError(_first_line(error)) from error
        finally:
            browser.close()


def wait_for(page: Page, condition: str) -> None:
    """Wait until a condition holds in the page.

    Parameters
    ----------
    page : Page, an open page
    condition : str, JavaScript; it is sent as a function: a bare expression goes through eval(),
        which the Content Security Policy of the live page forbids
    """
    page.wait_for_function(f"() => ({condition})")


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def find_chromium() -> str:
    """The browser to drive: LSCAN_CHROMIUM, or the first of NAMES that prints its version.

    Ubuntu's chromium-browser is a script that asks for a snap: its presence is not enough.
    Raises BrowserMissing naming the package to install.
    """
    named = os.environ.get("LSCAN_CHROMIUM")
    for name in (named,) if named else NAMES:
        found = shutil.which(name)
        if found and _prints_version(found):
            return found
    if named:
        raise BrowserMissing(f"LSCAN_CHROMIUM: no such program, or no Chromium (got {named!r})")
    raise BrowserMissing(
        f"no Chromium here: install the Debian package {PACKAGE}, "
        "or name another one in LSCAN_CHROMIUM"
    )


def _prints_version(binary: str) -> bool:
    try:
        done = subprocess.run([binary, "--version"], capture_output=True, timeout=VERSION_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and b"Chrom" in done.stdout


def find_or_install() -> str:
    """The browser to drive, installed first where there is none; BrowserMissing says why not."""
    return found_or_installed(find_chromium, (PACKAGE,), "LSCAN_CHROMIUM")


def main(arguments: list[str] | None = None) -> int:
    """The exit code of ``python -m tests.validation.browser [--install]``.

    0 where there is a browser, else 2 after one line; with --install always 0, because the
    tests that need a browser skip without one and say why.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tests.validation.browser", description="Find the Chromium of the tests."
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
