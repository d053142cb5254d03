"""Chromium that is missing, broken or not to be installed."""

from pathlib import Path

import pytest

from tests.validation.browser import BrowserError, BrowserMissing, headless_chromium


def open_chromium() -> None:
    with headless_chromium():
        pass


def test_without_chromium_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LSCAN_CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(BrowserMissing, match="install the Debian package chromium"):
        open_chromium()
    monkeypatch.setenv("LSCAN_CHROMIUM", "no-such-browser")
    with pytest.raises(BrowserMissing, match=r"LSCAN_CHROMIUM: .*'no-such-browser'"):
        open_chromium()


def test_a_browser_that_does_not_start_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = tmp_path / "chromium"
    script = '[ "$1" = --version ] && echo Chromium 1 && exit; echo no display >&2; exit 1'
    broken.write_text(f"#!/bin/sh\n{script}\n")
    broken.chmod(0o755)
    kept = tmp_path / "profiles"
    kept.mkdir()
    monkeypatch.setenv("LSCAN_CHROMIUM", str(broken))
    monkeypatch.setenv("TMPDIR", str(kept))
    with pytest.raises(BrowserError, match=r"does not start \(no display\)"):
        open_chromium()
    assert list(kept.iterdir()) == []
