"""Shapes files and what is measured by them on surfaces whose shape is known."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shape_surfaces import RADIUS_MM, dome, plan, ridge, surface_of

from lscan.config.targets import ShapesDocument, load_shapes
from lscan.errors import InputError, MeasurementError
from lscan.measure.shapes import measure_shapes
from lscan.records import Floats, Status

ALL = {"x_mm": [-100.0, 100.0], "y_mm": [-100.0, 100.0]}


def wanted(**tables: Any) -> ShapesDocument:
    return ShapesDocument.model_validate(tables)


def test_every_kind_is_measured() -> None:
    """On a dome beside which there is nothing else, plane and step are those of its boxes."""
    x, y = plan(41)
    z = np.where(x > 0, 12.0, 7.0)
    levels = surface_of(x, y, z + np.random.default_rng(1).normal(0, 0.05, z.shape))
    upper, lower = (
        {"x_mm": [a, b], "y_mm": [-20.0, 20.0]} for a, b in ((1.0, 20.0), (-20.0, -1.0))
    )
    found = measure_shapes(
        levels,
        wanted(
            plane=[{"name": "top", **upper}],
            step=[{"name": "ledge", "upper": upper, "lower": lower}],
            height=[{"name": "up", "from_mm": [-10.0, 0.0], "to_mm": [10.0, 0.0]}],
        ),
    )
    assert [(one.kind, one.name) for one in found] == [
        ("plane", "top"), ("step", "ledge"), ("height", "up"),
    ]  # fmt: skip
    plane, step, height = (one.values["height_mm"] for one in found)
    for measured, true in ((plane, 12.0), (step, 5.0), (height, 5.0)):
        assert abs(measured.value - true) < 4 * measured.sigma
    # Some 800 points against some ten, each place known better than a single point.
    assert step.sigma < height.sigma < 0.05 * np.sqrt(2)
    assert found[0].points == 19 * 41 + 41 - found[0].outliers  # x of 1, 2, ..., 20


def test_a_sphere_is_measured_within_heights() -> None:
    x, y = plan(41)
    z = dome(x, y)
    z[:, :10] = 0.0  # something else
    box = {"name": "ball", **ALL, "z_mm": [2.0, 40.0]}
    (ball,) = measure_shapes(surface_of(x, y, z), wanted(sphere=[box]))
    assert ball.values["radius_mm"].value == pytest.approx(RADIUS_MM, abs=1e-6)
    assert (ball.points, ball.outliers) == (41 * 31, 0)
    assert ball.as_json()["values"]["radius_mm"]["sigma"] > 0


def test_points_without_a_value_have_no_part() -> None:
    x, y = plan()
    surface = surface_of(x, y, 0 * x)
    surface.status[0] = Status.OCCLUDED
    surface.xyz_mm[0] = np.nan
    (plane,) = measure_shapes(surface, wanted(plane=[{"name": "all", **ALL}]))
    assert plane.points == 20 * 21


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (
            {"plane": [{"name": "p", "x_mm": [90.0, 91.0], "y_mm": [0.0, 1.0]}]},
            "no point in its box; it has points in x from -20.0 to",
        ),
        ({"sphere": [{"name": "p", "x_mm": [0.0, 4.0], "y_mm": [0.0, 2.0]}]}, "are needed"),
        ({"height": [{"name": "p", "from_mm": [0, 0], "to_mm": [90, 0]}]}, "too few points lie"),
    ],
)
def test_what_is_not_there_is_named(tables: dict[str, Any], words: str) -> None:
    x, y = plan()
    with pytest.raises(MeasurementError, match=f"'p': .*{words}"):
        measure_shapes(surface_of(x, y, dome(x, y)), wanted(**tables))


LINE = np.linspace(-20.0, 20.0, 400)[None]
PAIR = np.vstack([LINE, LINE])
CASES: dict[str, tuple[str, Floats, Floats, Floats]] = {
    "one profile": ("plane", LINE, 0 * LINE, 0.1 * LINE),
    "one profile, turned": ("plane", LINE, 0.05 * LINE, 0.1 * LINE),
    "two within their noise": ("plane", PAIR, PAIR * 0 + [[0.0], [0.01]], 0.1 * PAIR),
    "one column": ("plane", 0 * LINE.T, LINE.T, 0.1 * LINE.T),
    "one point": ("plane", LINE / 1000, LINE[:, ::-1] / 1000, 0 * LINE),
    "two levels of a step, a profile each": ("step", PAIR, PAIR * 0 + [[5.0], [-5.0]], 0 * PAIR),
    "a ball's top": ("sphere", *(axis / 40 for axis in plan(41)), dome(plan(41)[0] / 40, 0.0)),
    "a cylinder's ridge": ("cylinder", 0 * LINE.T, LINE.T, 30.0 + 0 * LINE.T),
    "a cylinder, once": ("cylinder", LINE, 0 * LINE, ridge(LINE, LINE)),
}


@pytest.mark.parametrize("across_mm", [0.0, 0.05])
@pytest.mark.parametrize("case", CASES)
def test_what_the_points_do_not_determine_is_refused(case: str, across_mm: float) -> None:
    """With and without noise of x, which lets points on a line seem to show more than that."""
    kind, x, y, z = CASES[case]
    rng = np.random.default_rng(2)
    x, z = x + rng.normal(0, across_mm, x.shape), z + rng.normal(0, 0.05, z.shape)
    surface = replace(surface_of(x, y, z), sigma_x_mm=np.full(z.shape, across_mm))
    boxes: dict[str, Any] = {"name": "p", **ALL}
    if kind == "step":
        boxes = {"name": "p", "upper": {**ALL, "y_mm": [0, 9]}, "lower": {**ALL, "y_mm": [-9, 0]}}
    with pytest.raises(MeasurementError, match=r"'p': .*determine it"):
        measure_shapes(surface, wanted(**{kind: [boxes]}))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "names nothing"),
        ('[[plane]]\nname = "a"\nx_mm = [1, 0]\ny_mm = [0, 1]', "plane.0.x_mm: must be a lower"),
        ('[[plane]]\nname = "a"\nx_mm = [0, 1]', "plane.0.y_mm: field required"),
        ('[[cone]]\nname = "a"', "cone: unknown key"),
        (2 * '[[height]]\nname = "a"\nfrom_mm = [0, 0]\nto_mm = [1, 1]\n', "names used twice"),
        ('[[step]]\nname = "a"\nupper = {x_mm = [0, 1], y_mm = [0, 1]}', "step.0.lower"),
        ('[[sphere]]\nname = ""\nx_mm = [0, 1]\ny_mm = [0, 1]', "sphere.0.name"),
        ('[[height]]\nname = "a"\nfrom_mm = [0, 0, 0]\nto_mm = [1, 1]', "height.0.from_mm"),
    ],
)
def test_a_bad_shapes_file_is_one_clear_error(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "shapes.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_shapes(path)
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)
