"""``lscan measure --shapes`` and ``lscan compare`` on a surface file, and their refusals."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from command_line import call, refused
from shape_surfaces import RADIUS_MM, dome, plan, surface_of

from lscan.surface import save_surface

SHAPES = """
[[sphere]]
name = "ball"
x_mm = [-30.0, 30.0]
y_mm = [-30.0, 30.0]

[[height]]
name = "fall"
from_mm = [0.0, 0.0]
to_mm = [15.0, 0.0]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A dome as a surface file, what to measure of it, and its mesh in cm."""
    x, y = plan(41)
    save_surface(tmp_path / "dome.nc", surface_of(x, y, dome(x, y)))
    (tmp_path / "shapes.toml").write_text(SHAPES)
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM / 10)
    (tmp_path / "ball.stl").write_bytes(ball.export(file_type="stl"))
    return tmp_path


def test_shapes_of_a_surface_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("measure", folder / "dome.nc", "--shapes", folder / "shapes.toml")
    code, out, err = call(capsys, *arguments, "--json", "-o", folder / "m.json")
    assert (code, err) == (0, "")
    content = json.loads(out)
    assert content == json.loads((folder / "m.json").read_text())
    assert content["frame"] == "workpiece"
    ball, fall = content["shapes"]["ball"], content["shapes"]["fall"]
    assert ball["values"]["radius_mm"]["value"] == pytest.approx(RADIUS_MM, abs=1e-6)
    # Quadratics over circles of 2 mm: the fourth order of a sphere of 30 mm is below 1e-4 mm.
    assert fall["values"]["height_mm"]["value"] == pytest.approx(
        np.sqrt(RADIUS_MM**2 - 15**2) - RADIUS_MM, abs=1e-3
    )
    code, out, _ = call(capsys, *arguments)
    assert code == 0
    assert "sphere ball" in out and "radius_mm" in out and "0 left out" in out


def test_a_surface_is_compared_with_a_mesh(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {"-o": "c.json", "--points": "p.ply", "--histogram": "h.png"}
    more = [part for option, name in files.items() for part in (option, folder / name)]
    code, out, err = call(
        capsys, "compare", folder / "dome.nc", folder / "ball.stl", "--unit", "cm", *more, "--json"
    )
    assert (code, err) == (0, "")
    content = json.loads(out)
    assert content == json.loads((folder / "c.json").read_text())
    # The chords of an icosphere of 5 subdivisions lie up to 1 - cos(1 degree) of 30 mm beneath.
    assert 0 <= content["mean_mm"]["value"] < RADIUS_MM * (1 - np.cos(np.radians(1.2)))
    assert content["points"] == 41 * 41
    assert all((folder / name).stat().st_size > 0 for name in files.values())
    shifted = ("compare", folder / "dome.nc", folder / "ball.stl", "--unit", "cm", "--at", "1,1,1")
    code, out, _ = call(capsys, *shifted, "--fit")
    assert code == 0 and "within 2 sigma" in out
    # The ball's own place, by the points of a mesh whose chords lie up to 0.006 mm beneath it.
    where = next(line for line in out.splitlines() if "mesh at x, y, z mm" in line)
    assert [float(mm) for mm in re.findall(r"-?\d+\.\d+", where)] == pytest.approx(
        [0, 0, 0], abs=0.01
    )
    double = trimesh.util.concatenate([trimesh.load_mesh(folder / "ball.stl")] * 2)
    double.export(folder / "double.stl")
    code, out, err = call(
        capsys, "compare", folder / "dome.nc", folder / "double.stl", "--unit", "cm", "--json"
    )
    assert (code, json.loads(out)) == (0, content)
    said = f"{folder / 'double.stl'} repeats triangles, which count once: {20 * 4**5}"
    assert err == f"lscan: note: {said}\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("measure", "dome.nc"), "--calibration: is missing"),
        (("measure", "dome.nc", "--alignment", "a.json"), "--alignment: goes with --shapes"),
        (("measure", "dome.nc", "--shapes", "shapes.toml", "-c", "c.json"), "--calibration: goes"),
        (("measure", "dome.nc", "--shapes", "none.toml"), "none.toml: cannot be read"),
        (("measure", "nowhere", "--shapes", "shapes.toml"), "--calibration: is missing"),
        (
            ("reconstruct", "r", "-c", "c", "-o", "s", "--alignment", "a", "--save-alignment", "b"),
            "--save-alignment: goes without --alignment",
        ),
        (("compare", "dome.nc", "ball.stl", "--unit", "ft"), "--unit: no such unit"),
        (("compare", "dome.nc", "ball.stl", "--at", "1,2"), "--at: not a point"),
        (("compare", "dome.nc", "ball.stl", "--at", "1,2,nan"), "--at: not a point"),
        (("compare", "dome.nc", "ball.stl", "--within", "0"), "--within: is not a distance"),
        (("compare", "dome.nc", "ball.stl", "--turn", "inf"), "--turn: is not an angle"),
        (("compare", "dome.nc", "shapes.toml"), "is no kind of mesh file"),
        (("compare", "shapes.toml", "ball.stl"), "cannot be read as NetCDF"),
        (("compare", "dome.nc", "ball.stl", "--points", "no/p.ply"), "the folder to write to"),
    ],
)
def test_what_cannot_be_done_is_one_clear_line(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[Any, ...],
    words: str,
) -> None:
    monkeypatch.chdir(folder)
    refused(call(capsys, *arguments), words)
