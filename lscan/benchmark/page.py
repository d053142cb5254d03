"""The bench's table and picture, printed and on disk."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from pydantic_core import to_jsonable_python

from lscan.benchmark.extractors import ExtractorRow
from lscan.benchmark.limits import failed_of_extractor, failed_of_map
from lscan.benchmark.maps import MapRow
from lscan.benchmark.pictures import LineCase
from lscan.figures import style
from lscan.files.disk import make_folder, write_atomically, write_json

AnyRow = TypeVar("AnyRow", ExtractorRow, MapRow)

DPI = 90
LIMITS_PX, LIMITS_MM = (0.003, 1.0), (0.001, 1.0)  # of the picture's colours


def _peak(case: LineCase) -> str:
    """Such as "200 speckled"."""
    words = [f"{case.peak_dn:g}"]
    words += ["clipped"] if case.saturated else []
    words += ["speckled"] if case.noise.speckle else []
    return " ".join(words)


def _if_solved(figure: Callable[[MapRow], str]) -> Callable[[MapRow], str]:
    """The figure of a row, empty where the map was refused."""
    return lambda row: "" if row.refused else figure(row)


EXTRACTOR_COLUMNS: Mapping[str, Callable[[ExtractorRow], str]] = {
    "extractor": lambda row: row.extractor,
    "water": lambda row: row.case.water,
    "width px": lambda row: f"{row.case.sigma_px:g}",
    "peak DN": lambda row: _peak(row.case),
    "bias px": lambda row: f"{row.bias_px:+.4f}",
    "scatter px": lambda row: f"{row.scatter_px:.4f}",
    "to bound": lambda row: "" if row.bound_ratio is None else f"{row.bound_ratio:.2f}",
    "outliers %": lambda row: f"{100 * row.outliers:.1f}",
    "3 sigma %": lambda row: f"{100 * row.within_3_sigma:.1f}",
    "found %": lambda row: f"{100 * row.found:.1f}",
    "us a frame": lambda row: f"{row.us_a_frame:.0f}",
    "out of limits": lambda row: ", ".join(failed_of_extractor(row)),
}
"""The printed table of the extractors: heading to cell."""

MAP_COLUMNS: Mapping[str, Callable[[MapRow], str]] = {
    "plane map": lambda row: row.plane_map,
    "board": lambda row: row.board,
    "noise px": lambda row: f"{row.noise_px:g}",
    "rms mm": lambda row: "refused" if row.refused else f"{row.rms_mm:.4f}",
    "largest mm": _if_solved(lambda row: f"{row.max_mm:.3f}"),
    "3 sigma %": _if_solved(lambda row: f"{100 * row.within_3_sigma:.1f}"),
    "covered %": _if_solved(lambda row: f"{100 * row.covered:.1f}"),
    "ms solve": _if_solved(lambda row: f"{row.ms_solve:.1f}"),
    "ms profile": _if_solved(lambda row: f"{row.ms_profile:.2f}"),
    "out of limits": lambda row: ", ".join(failed_of_map(row)),
}
"""The printed table of the maps: heading to cell."""


def table_cells(
    rows: Iterable[AnyRow], columns: Mapping[str, Callable[[AnyRow], str]]
) -> list[list[str]]:
    """Cells of the printed table of the rows, a list for each row, under the columns' headings.

    Parameters
    ----------
    rows : iterable, of the extractors or of the plane maps
    columns : mapping, the text of a row's cell by the column's heading
    """
    return [[cell(row) for cell in columns.values()] for row in rows]


def write_bench(
    folder: Path, extractors: Sequence[ExtractorRow], maps: Sequence[MapRow]
) -> dict[str, Any]:
    """What bench.json holds, written to ``folder`` with bench.png; InputError from the disk."""
    content = {
        "extractors": [_judged(row, failed_of_extractor(row)) for row in extractors],
        "maps": [_judged(row, failed_of_map(row)) for row in maps],
    }
    make_folder(folder)
    write_json(folder / "bench.json", content)
    write_atomically(folder / "bench.png", draw_bench(extractors, maps))
    return content


def _judged(row: ExtractorRow | MapRow, failed: list[str]) -> dict[str, Any]:
    """The row in JSON types, null for what is no number, and which figures are out of limits."""
    written: dict[str, Any] = to_jsonable_python(row, inf_nan_mode="null")
    return {**written, "failed": failed, "passed": not failed}


@style.styled
def draw_bench(extractors: Sequence[ExtractorRow], maps: Sequence[MapRow]) -> bytes:
    """The picture, PNG: how far each extractor and each map is off, everywhere."""
    errors_px = {
        (row.extractor, _title(row.case)): float(np.hypot(row.bias_px, row.scatter_px))
        for row in extractors
    }
    errors_mm = {(row.plane_map, f"{row.board}\n{row.noise_px:g} px"): row.rms_mm for row in maps}
    parts = (
        ("Stripe extractors: rms error in px (colour: its logarithm)", errors_px, LIMITS_PX),
        ("Plane maps: rms error in mm, by board and noise of its marks", errors_mm, LIMITS_MM),
    )
    counts = [len({name for name, _ in errors}) for _, errors, _ in parts]
    size = (19.0, 2.6 + 0.24 * sum(counts))
    heights = tuple(float(max(count, 1)) for count in counts)
    figure, panels = style.panels(2, size, heights, share_x=False)
    figure.set_facecolor(style.PAPER)
    for axes, (title, errors, limits) in zip(panels, parts, strict=True):
        _heat(axes, errors, limits)
        axes.set_title(title)
    return style.png(figure, DPI)


def _title(case: LineCase) -> str:
    speckled = "\nspeckle" if case.noise.speckle else ""
    return f"{case.water}\n{case.sigma_px:g} px\n{case.peak_dn:g} DN{speckled}"


def _heat(axes: Axes, errors: Mapping[tuple[str, str], float], limits: tuple[float, float]) -> None:
    """A table of numbers with a colour each, by (row, column); empty where there is no number."""
    axes.grid(False)
    if not errors:
        axes.set_axis_off()
        return
    rows, columns = (list(dict.fromkeys(names)) for names in zip(*errors, strict=True))
    values = np.array([[errors.get((row, column), np.nan) for column in columns] for row in rows])
    low, high = np.log10(limits)
    shade = np.clip(np.log10(np.where(values > 0, values, limits[0])), low, high)
    shade = np.where(np.isfinite(values), shade, np.nan)
    axes.imshow(shade, cmap="RdYlGn_r", vmin=low, vmax=high, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            text = f"{value:.3f}" if value < 1 else f"{value:.1f}"
            axes.text(j, i, text.lstrip("0"), ha="center", va="center", fontsize=6.5)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xticks(range(len(columns)), columns, fontsize=6)
