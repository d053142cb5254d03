"""Progress bars: on a terminal alone, of long work that nobody asked for, and one in another."""

import sys

import pytest

from lscan.cli.console import command_line, progress_bar, run_command_line
from lscan.files.cache import long_work

STEPS = 3
ERASED = "\x1b[2K"  # what a terminal is sent before a line is drawn anew


def ran(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, bare: bool) -> str:
    """What a command writes on stderr that does long work; bare: without a bar of its own."""
    app = command_line("test")

    @app.command()
    def scan() -> None:
        if bare:
            _tables()
            return
        with progress_bar("scan") as progress:
            _tables()
            progress(7, 7)

    monkeypatch.setattr(sys, "argv", ["test"])
    with pytest.raises(SystemExit) as left:
        run_command_line(app, "test")
    assert left.value.code == 0
    return capsys.readouterr().err


def _tables() -> None:
    with long_work("tables") as progress:
        for step in range(STEPS):
            progress(step + 1, STEPS)


@pytest.mark.parametrize("bare", [True, False])
def test_long_work_shows_on_a_terminal(
    bare: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beneath the command's own bar, where there is one, and only while it lasts."""
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes stderr for a terminal
    drawn = ran(capsys, monkeypatch, bare)
    assert "tables" in drawn
    last = drawn.split(ERASED)[-1]
    assert ("3/3" if bare else "7/7") in last
    assert ("tables" in last) is bare


@pytest.mark.parametrize("bare", [True, False])
def test_nothing_shows_where_there_is_no_terminal(
    bare: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ran(capsys, monkeypatch, bare) == ""


def test_outside_a_command_long_work_shows_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    ran(capsys, monkeypatch, bare=True)
    _tables()
    assert capsys.readouterr() == ("", "")


def test_a_bar_is_opened_anew_after_work_that_failed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(MemoryError), progress_bar("first"), progress_bar("second"):
        raise MemoryError
    monkeypatch.setenv("FORCE_COLOR", "1")
    with progress_bar("third") as progress:
        progress(1, 1)
    assert "third" in capsys.readouterr().err
