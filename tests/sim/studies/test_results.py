"""The files of a study: read back as written, and readable by others."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from netcdf_forms import stumbling_blocks
from study_examples import OUTPUTS, strange_results, study_results

from lscan.errors import InputError
from sim.studies.problem import columns
from sim.studies.results import load_results, runs_netcdf, write_results

UDUNITS = {"deg": "degree", "psu": "1", "": "1"}
"""Units that it does not know under the name that they have here."""


def test_results_come_back_as_they_were_and_the_same_bytes_again(tmp_path: Path) -> None:
    results, runs = study_results()
    write_results(tmp_path / "one", results, runs)
    assert load_results(tmp_path / "one") == results
    write_results(tmp_path / "two", load_results(tmp_path / "one"), runs)
    for name in ("results.json", "runs.nc", "report.html", "against.txt"):
        first, second = ((tmp_path / n / name).read_bytes() for n in ("one", "two"))
        assert first == second, name
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == [
        "against.txt",
        "report.html",
        "results.json",
        "runs.nc",
    ]


def test_figures_in_json_are_named_with_their_units(tmp_path: Path) -> None:
    results, runs = study_results()
    write_results(tmp_path, results, runs)
    height, yaw = json.loads((tmp_path / "results.json").read_text())["outputs"]
    budget = results.outputs[0]
    assert budget.rms is not None
    assert height["rms_mm"]["value"] == budget.rms.value
    assert "rms_mm" in height["after"] and "standard_uncertainty_deg" in yaw
    tilt = next(cause for cause in height["causes"] if cause["cause"] == "tilt")
    assert {"alone_rms_mm", "sensitivity_mm_per_deg", "first", "total"} <= set(tilt)


def test_names_and_units_that_are_odd_come_back_too(tmp_path: Path) -> None:
    strange = strange_results()
    write_results(tmp_path, strange, study_results()[1])
    assert load_results(tmp_path) == strange


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"causes": 3}', '{"causes": [], "outputs": []}'])
def test_a_file_that_holds_no_results_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(InputError) as refused:
        load_results(tmp_path)
    assert "results.json" in str(refused.value) and "\n" not in str(refused.value)


def test_a_number_that_is_missing_is_refused_by_its_place(tmp_path: Path) -> None:
    results, runs = study_results()
    write_results(tmp_path, results, runs)
    document = json.loads((tmp_path / "results.json").read_text())
    document["outputs"][0]["rms_mm"]["low"] = None
    (tmp_path / "results.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"outputs\.0\.rms\.low"):
        load_results(tmp_path)


def test_every_run_is_in_the_netcdf_to_the_last_bit(tmp_path: Path) -> None:
    _, runs = study_results()
    (tmp_path / "runs.nc").write_bytes(runs_netcdf(runs, "seasons"))
    assert stumbling_blocks(tmp_path / "runs.nc") == []
    with xr.open_dataset(tmp_path / "runs.nc", engine="h5netcdf") as data:
        assert data.attrs["Conventions"] == "CF-1.11"
        np.testing.assert_array_equal(data["number"], runs.rows)
        assert list(data["cause"].values) == [cause.name for cause in runs.causes]
        assert tuple(data["block"].values) == runs.blocks
        assert tuple(data["status"].values) == runs.statuses
        for k, cause in enumerate(runs.causes):
            if cause.unit is None:
                assert f"value: {cause.name}" not in data
                continue
            value = data[f"value: {cause.name}"]
            np.testing.assert_array_equal(value, runs.physical[:, k])
            assert value.attrs["units"] == UDUNITS.get(cause.unit, cause.unit)
        for output, where in zip(OUTPUTS, columns(OUTPUTS).values(), strict=True):
            error = data[f"error: {output.name}"]
            np.testing.assert_array_equal(
                error.values.reshape(-1, output.size), runs.values[:, where]
            )
            assert error.attrs["units"] == UDUNITS.get(output.unit, output.unit)


def test_a_unit_per_length_is_no_area_to_udunits(tmp_path: Path) -> None:
    """It reads "mm per 300 mm" as (mm / 300) mm, the brackets as 1/300 (cf-units 3.3.1)."""
    _, runs = study_results()
    first, *others = runs.outputs
    changed = replace(runs, outputs=(replace(first, unit="mm per 300 mm"), *others))
    (tmp_path / "runs.nc").write_bytes(runs_netcdf(changed, "seasons"))
    with xr.open_dataset(tmp_path / "runs.nc", engine="h5netcdf") as data:
        assert data[f"error: {first.name}"].attrs["units"] == "mm/(300 mm)"
