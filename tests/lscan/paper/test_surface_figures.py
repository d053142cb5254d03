"""Figures of the surface: scaled to the waves, every label legible, the whole of it in view."""

import json
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
import report_examples as examples
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

from lscan.config.targets import Sandwave
from lscan.figures import style
from lscan.paper import picturefigures
from lscan.paper.experiment import Experiment
from lscan.paper.report import render_report
from lscan.paper.surfacefigures import contours_before

pytestmark = pytest.mark.xdist_group("report")
FLOOR_MM = -42.0
SURFACES = ("raw", "levelled", "contours-before", "contours-after")


def on_a_floor() -> Experiment:
    """The sandwave alone, its block on a floor that lies as deep as the demo's."""
    sandwave = examples.sandwave_measures(
        np.random.default_rng(20), _with_floor(examples.workpiece_mm())
    )
    return replace(examples.board_alone(), sandwave=sandwave)


def _with_floor(xyz_mm: np.ndarray) -> np.ndarray:
    """The points (F, N, 3) with a strip of floor, as wide as half the block, at either side."""
    step = np.array([1.0, 0.0, 0.0])
    across = np.arange(1.0, 106.0, 2.0)[:, None]
    depth = np.array([0.0, 0.0, FLOOR_MM])
    left = xyz_mm[:, :1] - across[::-1] * step + depth
    right = xyz_mm[:, -1:] + across * step + depth
    return np.concatenate([left, xyz_mm, right], axis=1)


@pytest.fixture(scope="module")
def rendered() -> tuple[dict[str, Figure], str]:
    """The figures of the report of ``on_a_floor`` by key, laid out as they are saved; its page."""
    figures: dict[str, Figure] = {}
    write = style.svg

    def keep(figure: Figure, key: str, alt: str) -> str:
        figures[key] = figure
        return write(figure, key, alt) if key in SURFACES else "<svg></svg>"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "svg", keep)
        patch.setattr(picturefigures, "board_figures", lambda board: ([], []))
        return figures, render_report(on_a_floor())


@pytest.fixture
def drawn(rendered: tuple[dict[str, Figure], str]) -> dict[str, Figure]:
    return rendered[0]


@pytest.fixture
def turned(rendered: tuple[dict[str, Figure], str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Trace and layout that the page hands to Plotly."""
    page = rendered[1]
    arguments = page[page.rindex('Plotly.newPlot("surface", ') :].split('"surface", ', 1)[1]
    decoder = json.JSONDecoder()
    (trace,), end = decoder.raw_decode(arguments)
    layout, _ = decoder.raw_decode(arguments[end + 2 :])
    return trace, layout


def _shades(figure: Figure) -> QuadMesh:
    return next(c for c in figure.axes[0].collections if isinstance(c, QuadMesh))


def _contours(figure: Figure) -> ContourSet:
    return next(c for c in figure.axes[0].collections if isinstance(c, ContourSet))


def test_colours_and_contours_are_those_of_the_waves(drawn) -> None:
    """Colours end within the waves' crests, 1.5 + 0.043 * 150 = 7.95 mm, not at the floor.

    The half percent left out at either end keeps them above 7 mm: the crests of the last
    fifth of the block, which holds more than a half percent, are higher than that.
    """
    piece = Sandwave()
    crest_mm = piece.a_mm + piece.b * piece.side_mm
    noise_mm = 5 * 0.08  # of the example's points
    for key in ("contours-before", "contours-after"):
        low, high = _shades(drawn[key]).get_clim()
        assert -crest_mm - noise_mm <= low <= -7.0 and 7.0 <= high <= crest_mm + noise_mm, key
        levels = np.asarray(_contours(drawn[key]).levels)
        np.testing.assert_array_equal(np.diff(levels), 1.0)
        np.testing.assert_array_equal(levels, np.round(levels))
        assert low <= levels[0] < low + 1 and high - 1 < levels[-1] <= high


def test_every_fifth_contour_is_thicker_and_labelled(drawn) -> None:
    contours = _contours(drawn["contours-after"])
    widths = dict(zip(np.asarray(contours.levels), contours.get_linewidths(), strict=True))
    index = [level for level, width in widths.items() if width == max(widths.values())]
    assert index == [-5.0, 0.0, 5.0]
    assert {text.get_text() for text in contours.labelTexts} <= {"-5", "0", "5"}
    assert contours.labelTexts


def test_flat_parts_beside_the_waves_have_no_contours(drawn) -> None:
    """The rim lies at 0, a contour's height, where noise would draw speckle."""
    contours = _contours(drawn["contours-after"])
    for path in contours.get_paths():
        assert (path.vertices >= -2.0).all() and (path.vertices <= 152.0).all()  # a cell beyond


def test_a_surface_of_another_shape_has_few_enough_contours() -> None:
    x, y = np.meshgrid(np.linspace(0, 100, 60), np.linspace(0, 100, 60))
    for height, step_mm in ((3 * x, 10.0), (0.3 + 0.001 * x, 1.0)):
        # 300 mm high: every 10 mm; the other has no whole millimetre among its heights.
        points = examples.alignment().to_raw(np.stack([x, y, height], axis=2))
        sandwave = replace(examples.experiment().sandwave, raw=examples.surface(points, "head"))
        figure = contours_before(sandwave, np.ones(x.shape, dtype=bool))
        assert f"Contours every {step_mm:g} mm" in figure.caption


def test_slices_differ_in_their_dashes(drawn) -> None:
    figure = drawn["contours-after"]
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 2]
    assert len(lines) == 4
    assert len({str(line._unscaled_dash_pattern) for line in lines}) == 4
    # The longest, SD, lies under the three that cross it.
    lengths = [np.hypot(*np.ptp(line.get_xydata(), axis=0)) for line in lines]
    assert lengths[0] == max(lengths)


@pytest.mark.parametrize("key", SURFACES)
def test_no_label_lies_on_another(drawn, key) -> None:
    boxes = _labels(drawn[key])
    assert len(boxes) >= 3
    overlapping = [
        (one, two)
        for (one, a), (two, b) in combinations(boxes, 2)
        if Bbox.intersection(a, b) is not None
    ]
    assert overlapping == []


def _labels(figure: Figure) -> list[tuple[str, Bbox]]:
    """Every text of the figure but the contours' heights, with the box it is drawn in."""
    FigureCanvasAgg(figure).draw()
    heights = {
        text
        for axes in figure.axes
        for drawn in axes.collections
        if isinstance(drawn, ContourSet)
        for text in drawn.labelTexts
    }
    texts = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    return [(t.get_text(), _extent(t)) for t in texts if t not in heights]


def _extent(text: Text) -> Bbox:
    plate = text.get_bbox_patch() if isinstance(text, Annotation) else None
    return Bbox.frozen((plate or text).get_window_extent())


def test_the_start_view_sees_every_corner_of_the_surface(turned) -> None:
    """By Plotly's camera: 45° from edge to edge, the surface's box about the origin, z up."""
    trace, layout = turned
    heights = [z for row in trace["z"] for z in row if z is not None]
    assert min(heights) < FLOOR_MM + 5
    spans = np.array([np.ptp(trace["x"]), np.ptp(trace["y"]), np.ptp(heights)])
    scene = layout["scene"]
    eye = np.array([scene["camera"]["eye"][axis] for axis in "xyz"])
    if scene["aspectmode"] == "data":  # Plotly's own: true to scale, the box's volume 1
        sides = spans / np.prod(spans) ** (1 / 3)
    else:
        sides = np.array([scene["aspectratio"][axis] for axis in "xyz"])
    np.testing.assert_allclose(sides / sides.max(), spans / spans.max(), atol=0.01)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1]) / np.hypot(*forward[:2])
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * sides - eye
    ahead = (corners @ forward) * np.tan(np.radians(45) / 2)
    low, high = scene.get("domain", {}).get("y", (0, 1))
    aspect = 4 / 3 / (high - low)  # the box on the page is 4 to 3
    assert np.abs(corners @ right / ahead).max() < aspect
    assert np.abs(corners @ np.cross(right, forward) / ahead).max() < 1


def test_the_turned_surface_has_the_colours_of_the_waves(turned) -> None:
    trace, _ = turned
    assert -8.5 < trace["cmin"] < -7 and 7 < trace["cmax"] < 8.5
