"""The command ``lscan-sim accuracy``: a thin face that passes options on and judges the rows."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

import sim.validation.accuracy.run
from sim.cli.app import app
from sim.validation.rows import Row


def _row(figure: float) -> Row:
    return Row("length", "nominal", figure, 0.1, "mm", "required")


@pytest.mark.parametrize(("figures", "code"), [((0.05, 0.1), 0), ((0.05, 0.2), 1)])
def test_exit_code_says_whether_all_rows_pass(
    monkeypatch: pytest.MonkeyPatch, figures: tuple[float, ...], code: int
) -> None:
    rows = [_row(figure) for figure in figures]
    given = []
    monkeypatch.setattr(
        sim.validation.accuracy.run, "run_accuracy", lambda *args: given.append(args[:4]) or rows
    )
    options = ["--scenes", "s", "--photographs", "p", "--output", "o.json"]
    printed = CliRunner().invoke(app, ["accuracy", *options, "--json"])
    assert printed.exit_code == code
    assert json.loads(printed.stdout) == [row.as_json() for row in rows]
    assert given == [(Path("s"), Path("p"), Path("o.json"), False)]
    table = CliRunner().invoke(app, ["accuracy", *options])
    assert table.exit_code == code
    assert "skipped" not in table.stdout
    assert ("NO" in table.stdout) == bool(code)


def test_the_photographs_folder_is_named_by_option_or_variable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = []
    monkeypatch.setattr(
        sim.validation.accuracy.run, "run_accuracy", lambda *args: given.append(args[1]) or []
    )
    monkeypatch.delenv("LSCAN_PHOTOGRAPHS", raising=False)
    without = CliRunner().invoke(app, ["accuracy"])
    assert "skipped: the rows of real photographs" in without.stdout
    CliRunner().invoke(app, ["accuracy"], env={"LSCAN_PHOTOGRAPHS": "named"})
    assert given == [None, Path("named")]


def test_a_missing_scene_folder_is_refused_before_minutes_of_work(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["accuracy", "--scenes", str(tmp_path / "none")])
    assert result.exit_code != 0
    assert "none" in str(result.exception)
