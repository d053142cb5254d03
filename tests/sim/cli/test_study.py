"""``lscan-sim study``: the table of a study, printed and written."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lscan.errors import InputError
from sim.cli.app import app
from sim.studies import concavity
from sim.studies.concavity import ConcavityCase, ConcavityErrors


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The targets that are measured, in place of rendering them."""
    names: list[str] = []

    def errors(case: ConcavityCase) -> ConcavityErrors:
        names.append(case.name)
        return ConcavityErrors(case.name, case.derived, 7, (0.03, 0.02, 0.01), (0.09, 0.06, 0.03))

    monkeypatch.setattr(concavity, "concavity_errors", errors)
    return names


def test_the_table_of_concavity_is_printed_and_written(tmp_path: Path, measured: list[str]) -> None:
    chosen = ["study", "concavity", "--only", "sphere", "-o", str(tmp_path)]
    found = CliRunner().invoke(app, chosen)
    assert found.exit_code == 0, found.output
    assert measured and all("sphere" in name for name in measured)
    for name in measured:
        assert name in found.stdout
    written = json.loads((tmp_path / "concavity.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in written] == measured
    assert written[0]["rms_mm"] == [0.03, 0.02, 0.01]
    assert json.loads(CliRunner().invoke(app, [*chosen, "--json"]).stdout) == written


def test_every_target_is_measured_unless_some_are_named(
    tmp_path: Path, measured: list[str]
) -> None:
    assert CliRunner().invoke(app, ["study", "concavity", "-o", str(tmp_path)]).exit_code == 0
    assert len(measured) == len(set(measured)) == 9


def test_a_target_that_is_none_is_refused(tmp_path: Path, measured: list[str]) -> None:
    found = CliRunner().invoke(app, ["study", "concavity", "--only", "cube", "-o", str(tmp_path)])
    assert isinstance(found.exception, InputError)
    assert "no such target" in str(found.exception) and "sphere of 60 mm" in str(found.exception)
    assert not measured
