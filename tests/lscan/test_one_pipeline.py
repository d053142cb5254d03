"""What is saved is what is measured: every command's surface is the one ``lscan measure`` cuts."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import xarray as xr
from drawn_runs import SHEET, board_run, flat_run, sandwave_run
from typer.testing import CliRunner

import lscan.paper.report
from lscan.acquisition.run import Run, open_run
from lscan.calibration.calibrationfile import load_plane_map
from lscan.cli.app import app
from lscan.config.targets import Sandwave
from lscan.measure import compare_slice
from lscan.pipeline import SandwaveMeasures, measure_sandwave
from lscan.records import has_value
from lscan.surface import load_surface, resample

# One worker: they share a fixture.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("pipeline")]

PIECE = Sandwave()
BLOCK = {"workpiece": {"kind": "sandwave"}}


def called(*arguments: object, code: int = 0) -> Any:
    """What ``lscan ARGUMENTS`` printed, after it ended with this exit code."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of the board and of the sandwave under a sheet of known thickness, a calibration."""
    folder = tmp_path_factory.mktemp("pipeline")
    board_run(folder / "board")
    sandwave_run(folder / "sandwave", sheet=SHEET, stripe={"threshold_dn": 15.0}, **BLOCK)
    called("calibrate", folder / "board", "-o", folder / "c.json", "--map", "polynomial-5")
    return folder


@pytest.fixture(scope="module")
def measured(folder: Path) -> SandwaveMeasures:
    plane_map, _ = load_plane_map(folder / "c.json")
    return measure_sandwave(open_run(folder / "sandwave"), plane_map)


@pytest.fixture(scope="module")
def saved(folder: Path) -> Path:
    called(
        "reconstruct", folder / "sandwave", "-c", folder / "c.json", "-o", folder / "s.nc",
        "--points", folder / "s.ply", "--save-alignment", folder / "a.json",
    )  # fmt: skip
    return folder / "s.nc"


@pytest.mark.parametrize("name", ["S1", "S2", "S3", "SD"])
def test_slices_of_the_saved_surface_are_those_measured(
    measured: SandwaveMeasures, saved: Path, name: str
) -> None:
    """The file holds double precision, its modes single: as the surface in memory."""
    cut = resample(load_surface(saved), PIECE.slices_mm()[name])
    expected = measured.slices[name]
    np.testing.assert_array_equal(cut.status, expected.status)
    np.testing.assert_array_equal(cut.z_mm, expected.z_mm)
    np.testing.assert_allclose(cut.sigma_z_mm, expected.sigma_z_mm, rtol=1e-12)
    within = [
        np.abs(compare_slice(one, PIECE).error_mm) <= 2 * one.sigma_z_mm for one in (cut, expected)
    ]
    np.testing.assert_array_equal(*within)


def test_measure_prints_the_errors_of_the_saved_surface(folder: Path, saved: Path) -> None:
    printed = json.loads(
        called("measure", folder / "sandwave", "-c", folder / "c.json", "--json").stdout
    )["sandwave"]["slices"]
    surface = load_surface(saved)
    for name, ends in PIECE.slices_mm().items():
        assert compare_slice(resample(surface, ends), PIECE).as_json() == printed[name]


def test_the_point_cloud_is_the_saved_surface(saved: Path) -> None:
    """PLY holds single precision: half a unit in the last place of 512 mm is 3e-5 mm."""
    surface = load_surface(saved)
    points = np.asarray(trimesh.load(saved.with_suffix(".ply")).vertices)
    np.testing.assert_allclose(points, surface.xyz_mm[has_value(surface.status)], atol=3.1e-5)


def test_the_file_says_what_was_corrected_for(measured: SandwaveMeasures, saved: Path) -> None:
    with xr.open_dataset(saved, engine="h5netcdf") as data:
        assert data.attrs["corrections"].startswith("sheet thickness of 1.5 mm at a yaw of 2.")
    assert load_surface(saved).corrections == measured.aligned.corrections
    assert measured.raw.corrections == ()


def test_the_file_says_where_its_points_are_and_what_they_are_made_from(
    measured: SandwaveMeasures, saved: Path
) -> None:
    with xr.open_dataset(saved, engine="h5netcdf") as data:
        assert set(data.coords) == {"x", "y", "position"}
        assert set(data["z"].encoding["coordinates"].split()) == {"x", "y", "position"}
        known = {name: data.attrs[name] for name in ("rig", "pictures", "extractor", "plane_map")}
        assert known == {
            "rig": "drawn", "pictures": 100, "extractor": "ml", "plane_map": "polynomial-5",
        }  # fmt: skip
        assert len(data.attrs["calibration_sha256"]) == 64
        yaw = np.radians([data.attrs["yaw_deg"], data.attrs["yaw_sigma_deg"]])
    alignment = measured.alignment
    np.testing.assert_allclose(yaw, [alignment.yaw_rad, alignment.yaw_sigma_rad], rtol=1e-12)
    surface = load_surface(saved)
    assert surface.provenance == measured.aligned.provenance
    np.testing.assert_allclose(yaw, [surface.yaw_rad, surface.yaw_sigma_rad], rtol=1e-15)


def test_an_alignment_that_is_kept_aligns_as_the_one_that_was_found(
    folder: Path, saved: Path, tmp_path: Path
) -> None:
    kept, run = folder / "a.json", (folder / "sandwave", "-c", folder / "c.json")
    called("reconstruct", *run, "-o", tmp_path / "again.nc", "--alignment", kept)
    one, other = load_surface(saved), load_surface(tmp_path / "again.nc")
    np.testing.assert_allclose(one.xyz_mm, other.xyz_mm, atol=1e-9)
    np.testing.assert_allclose(one.sigma_z_mm, other.sigma_z_mm, rtol=1e-5)
    assert other.corrections == (
        *one.corrections,
        "yaw and level by the block scanned with 'drawn'",
    )


def test_a_target_without_a_workpiece_is_corrected_with_the_yaw_that_was_kept(
    folder: Path, saved: Path, tmp_path: Path
) -> None:
    kept = folder / "a.json"
    flat_run(tmp_path / "flat", 5, sheet=SHEET)
    flat = (tmp_path / "flat", "-c", folder / "c.json", "--alignment", kept)
    done = called("reconstruct", *flat, "-o", tmp_path / "f.nc", "--json")
    assert done.stderr == ""
    surface = load_surface(tmp_path / "f.nc")
    assert surface.frame == "workpiece"
    assert surface.yaw_rad == pytest.approx(np.radians(json.loads(done.stdout)["yaw_deg"]))
    assert np.degrees(surface.yaw_rad) == pytest.approx(2.2, abs=0.1)
    thickness, level = surface.corrections
    assert thickness.startswith("sheet thickness of 1.5 mm at a yaw of 2.")
    assert level.startswith("yaw and level by the block")
    everything = "x_mm = [-900.0, 900.0]\ny_mm = [-900.0, 900.0]"
    (tmp_path / "shapes.toml").write_text(f'[[plane]]\nname = "all"\n{everything}\n')
    done = called("measure", *flat, "--shapes", tmp_path / "shapes.toml", "--json")
    plane = json.loads(done.stdout)["shapes"]["all"]
    assert plane["points"] + plane["outliers"] == has_value(surface.status).sum()
    assert plane["values"]["height_mm"]["sigma"] > 0


def test_report_saves_the_surface_that_reconstruct_does(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lscan.paper.report, "write_report", lambda *_: None)  # the page's figures
    called(
        "report", "-o", folder / "report", "--board", folder / "board",
        "--sandwave", folder / "sandwave",
    )  # fmt: skip
    again = folder / "again"
    called(
        "reconstruct", folder / "sandwave", "-c", folder / "report/calibration-graticule-2.json",
        "-o", f"{again}.nc", "--points", f"{again}.ply",
    )  # fmt: skip
    for kind in ("nc", "ply"):
        one, other = (folder / "report" / f"sandwave.{kind}", folder / f"again.{kind}")
        assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize(
    ("make", "sections", "note"),
    [
        (lambda at, **more: sandwave_run(at, frames=5, **more), BLOCK, "not aligned"),
        (lambda at, **more: flat_run(at, 5, **more), {}, "square to the track"),
    ],
)
def test_without_an_alignment_the_sheet_is_taken_for_square_to_the_track(
    make: Callable[..., Run], sections: dict[str, Any], note: str, folder: Path, tmp_path: Path
) -> None:
    make(tmp_path / "run", sheet=SHEET, **sections)
    done = called("reconstruct", tmp_path / "run", "-c", folder / "c.json", "-o", tmp_path / "s.nc")
    assert note in done.stderr
    assert "without an alignment its yaw is not known" in done.stderr
    surface = load_surface(tmp_path / "s.nc")
    assert surface.frame == "head"
    assert surface.corrections == ("sheet thickness of 1.5 mm at a yaw of 0.000 deg",)
    make(tmp_path / "plain", **sections)
    called("reconstruct", tmp_path / "plain", "-c", folder / "c.json", "-o", tmp_path / "p.nc")
    plain = load_surface(tmp_path / "p.nc")
    assert plain.corrections == ()
    assert not np.array_equal(plain.xyz_mm, surface.xyz_mm, equal_nan=True)
