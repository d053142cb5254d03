"""Calibrations: residuals, the file's round trip, solving again, refusals."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrations import BOARD, OPTICS, drawn_calibration
from planeviews import View, board_points, read_board

from lscan.calibration.calibrate import Calibration, calibrate, resolve
from lscan.calibration.calibrationfile import load_calibration, save_calibration
from lscan.errors import InputError
from lscan.records import Mark, Marks, PlanePoints, RingPoints, Status

MAPS = ["graticule-2", "graticule-bspline-norulers", "projective", "polynomial-4", "spline"]


def _answer(calibration: Calibration) -> PlanePoints:
    image = View().project(board_points(200, seed=2))
    return calibration.plane_map.to_plane(image, np.full(200, 0.1))


def _same_points(one: PlanePoints, other: PlanePoints) -> None:
    np.testing.assert_array_equal(one.xz_mm, other.xz_mm)
    np.testing.assert_array_equal(one.sigma_mm, other.sigma_mm)
    np.testing.assert_array_equal(one.status, other.status)
    assert (one.modes_mm is None) == (other.modes_mm is None)
    if one.modes_mm is not None:
        np.testing.assert_array_equal(one.modes_mm, other.modes_mm)


def _same_marks(one: Marks, other: Marks) -> None:
    for key in ("board_mm", "image_px", "sigma_px", "status"):
        np.testing.assert_array_equal(getattr(one, key), getattr(other, key))


@pytest.mark.parametrize("name", MAPS)
def test_round_trip_is_exact(name: str, tmp_path: Path) -> None:
    saved = drawn_calibration(name)
    save_calibration(tmp_path / "c.json", saved)
    loaded = load_calibration(tmp_path / "c.json")
    _same_points(_answer(saved), _answer(loaded))
    _same_marks(saved.reading.grid, loaded.reading.grid)
    for one, other in zip(saved.reading.rulers, loaded.reading.rulers, strict=True):
        assert (one.direction, one.at_mm) == (other.direction, other.at_mm)
        _same_marks(one.marks, other.marks)
    np.testing.assert_array_equal(saved.residuals_mm, loaded.residuals_mm)
    np.testing.assert_array_equal(saved.residuals_px, loaded.residuals_px)
    assert (saved.name, saved.software) == (loaded.name, loaded.software)
    assert loaded.optics == OPTICS
    assert saved.plane_map.parameters() == loaded.plane_map.parameters()
    assert loaded.reading.image_size == (640, 480)
    for group in ("dots", "rings"):
        before, after = getattr(saved.reading, group), getattr(loaded.reading, group)
        assert before.keys() == after.keys()
        for key in before:
            np.testing.assert_array_equal(before[key].image_px, after[key].image_px)
            np.testing.assert_array_equal(before[key].sigma_px, after[key].sigma_px)


@pytest.mark.parametrize("name", MAPS)
def test_solved_again_from_its_own_file(name: str, tmp_path: Path) -> None:
    save_calibration(tmp_path / "c.json", drawn_calibration(name))
    loaded = load_calibration(tmp_path / "c.json")
    again = resolve(loaded)
    _same_points(_answer(loaded), _answer(again))
    assert again.optics == OPTICS
    assert again.plane_map.parameters() == loaded.plane_map.parameters()


def test_residuals_in_mm_and_px() -> None:
    """A pixel residual is the shift that takes the mark to where the map sees its nominal."""
    calibration = drawn_calibration("projective")
    found = calibration.reading.grid.found
    assert np.isnan(calibration.residuals_mm[~found]).all()
    image = calibration.reading.grid.image_px[found] - calibration.residuals_px[found]
    back = calibration.plane_map.to_plane(image).xz_mm
    np.testing.assert_allclose(back, calibration.reading.grid.board_mm[found], atol=1e-3)
    lengths = np.hypot(*calibration.residuals_mm[found].T)
    assert calibration.rms_mm == pytest.approx(np.sqrt(np.mean(lengths**2)))
    assert calibration.max_mm == pytest.approx(lengths.max())


def test_missing_dots_stay_missing(tmp_path: Path) -> None:
    reading = read_board(BOARD, View().project)
    reading.dots["A1"] = Mark(np.full(2, np.nan), np.nan, Status.NOT_FOUND)
    reading.rings["E"] = RingPoints(np.empty((0, 2)), np.empty(0))
    save_calibration(tmp_path / "c.json", calibrate(reading, "projective"))
    loaded = load_calibration(tmp_path / "c.json").reading
    assert np.isnan(loaded.dots["A1"].image_px).all()
    assert loaded.dots["A1"].status is Status.NOT_FOUND
    assert loaded.rings["E"].image_px.shape == (0, 2)


def _set(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        *steps, last = [int(key) if key.isdigit() else key for key in path.split(".")]
        for key in steps:
            document = document[key]  # type: ignore[index]
        document[last] = value  # type: ignore[index]

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_set("format", "other"), "no calibration file"),
        (_set("version", 1), "version: is not the one .* calibrate again .* allowed: 2"),
        (_set("version", 3), "version"),
        (_set("version", True), "version"),
        (_set("optics.gap_mm", [10.0, -1.0]), "optics.gap_mm"),
        (_set("optics.gaps", 1.0), "optics.gaps: unknown key"),
        (_set("colour", "red"), "colour: unknown key"),
        (_set("plane_map", "graticule-9"), "graticule-9"),
        (_set("plane_map", "nothing"), "no such family of plane maps"),
        (_set("plane_map", "projective"), "parameters"),
        (_set("parameters.latitudes.lines.0.curve.degree", "2"), "latitudes.lines.0.curve.degree"),
        (_set("parameters.latitudes.lines.0.curve.knots", [1.0, 2.0]), "latitudes.lines.0.curve"),
        (_set("parameters.latitudes.lines.0.curve.coefficients.1", None), "coefficients"),
        (_set("parameters.latitudes.lines.0.curve.extra", 1.0), "curve.extra: unknown key"),
        (_set("parameters.latitudes.lines.0.curve.covariance.0.0", -1.0), "negative variance"),
        (_set("parameters.latitudes.lines", []), "latitudes.lines"),
        (_set("parameters.region.outline_px", [[0.0, 0.0], [1.0, 0.0]]), "region"),
        (_set("parameters.region.margin_px", -1.0), "region.margin_px"),
        (_set("parameters.lack_of_fit_mm", [0.1]), "lack_of_fit_mm"),
        (_set("parameters.latitudes.lines.3.curve.coefficients.1", 170.0), "residuals.mm"),
        (_set("reading.shape", [10, 9]), "reading"),
        (_set("reading.grid.status.5", "FINE"), "reading.grid.status.5"),
        (_set("reading.grid.status.5", "NOT_FOUND"), "reading.grid"),
        (_set("reading.grid.sigma_px.5", -0.1), "reading.grid"),
        (_set("reading.grid.image_px.5", [1.0]), "reading.grid.image_px"),
        (_set("reading.grid.image_px.5", [1.0, "2"]), "reading.grid.image_px"),
        (_set("reading.rulers.0.direction", "slanted"), "reading.rulers.0.direction"),
        (_set("reading.dots.A1.sigma_px", None), "reading.dots.A1"),
        (_set("reading.dots.A1.image_px", [1.0]), "reading.dots.A1"),
        (_set("reading.dots.A1.image_px", [[1.0, 2.0]]), "reading.dots.A1"),
        (_set("reading.rings.E", {"image_px": [1.0, 2.0], "sigma_px": [0.1]}), "reading.rings.E"),
        (_set("reading.rings.E.sigma_px", [0.1]), "reading.rings.E"),
        (_set("reading.rings.E.sigma_px.3", -0.1), "reading.rings.E"),
        (_set("reading.image_size", [640, 0]), "reading.image_size"),
        (_set("residuals.px", [[0.0, 0.0]]), "residuals"),
        (lambda d: d["parameters"].pop("lack_of_fit_mm"), "lack_of_fit_mm"),
    ],
)
def test_refuses_what_it_did_not_write(
    change: Callable[[dict[str, Any]], None], said: str, tmp_path: Path, document: dict[str, Any]
) -> None:
    change(document)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=said) as caught:
        load_calibration(path)
    assert "bad.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture
def document(tmp_path: Path) -> dict[str, Any]:
    save_calibration(tmp_path / "good.json", drawn_calibration())
    return json.loads((tmp_path / "good.json").read_text())


@pytest.mark.parametrize("name", ["polynomial-4", "projective", "spline"])
def test_refuses_parameters_of_wrong_size(name: str, tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    save_calibration(path, drawn_calibration(name))
    document = json.loads(path.read_text())
    key = "h" if name == "projective" else "coefficients"
    document["parameters"][key] = document["parameters"][key][:-1]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="parameters"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "JSON"),
        (b"[1, 2]", "no calibration file"),
        (b"\xff\xfe", "UTF-8"),
        (b'{"format": "lscan-calibration", "version": NaN}', "NaN"),
        (b"[" * 100_000, "JSON"),
    ],
)
def test_refuses_what_is_no_json_document(content: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        load_calibration(path)


def test_a_file_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_calibration(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be written"):
        save_calibration(tmp_path / "no" / "such" / "c.json", drawn_calibration("projective"))
    assert list(tmp_path.iterdir()) == []


def test_writing_replaces_whole_and_leaves_no_draft(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c.json"
    save_calibration(path, drawn_calibration("projective"))
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(InputError, match="No space left"):
        save_calibration(path, drawn_calibration("polynomial-2"))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
