"""The bench's table and picture, printed and on disk."""

import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lscan.benchmark.extractors import ExtractorRow
from lscan.benchmark.limits import failed_of_extractor, failed_of_map
from lscan.benchmark.maps import MapRow
from lscan.benchmark.pictures import LineCase
from lscan.config.rig import NoiseSection
from lscan.figures import style
from lscan.files.disk import make_folder, write_atomically
from lscan.records import Floats

EXTRACTOR_HEADINGS = (
    "extractor", "water", "width px", "peak DN", "bias px", "scatter px",
    "to bound", "outliers %", "3 sigma %", "found %", "us a frame", "out of limits",
)  # fmt: skip
MAP_HEADINGS = (
    "plane map", "board", "noise px", "rms mm", "largest mm", "3 sigma %", "covered %",
    "ms solve", "ms profile", "out of limits",
)  # fmt: skip
DPI = 90
LEAST_PX, MOST_PX = 0.003, 1.0  # of the picture's colours
LEAST_MM, MOST_MM = 0.001, 1.0


def extractor_cells(rows: Sequence[ExtractorRow]) -> list[list[str]]:
    """Cells of the printed table, a list for each row, under EXTRACTOR_HEADINGS."""
    return [
        [
            row.extractor,
            row.case.water,
            f"{row.case.sigma_px:g}",
            _peak(row.case),
            f"{row.bias_px:+.4f}",
            f"{row.scatter_px:.4f}",
            "" if row.bound_ratio is None else f"{row.bound_ratio:.2f}",
            f"{100 * row.outliers:.1f}",
            f"{100 * row.within_3_sigma:.1f}",
            f"{100 * row.found:.1f}",
            f"{row.us_a_frame:.0f}",
            ", ".join(failed_of_extractor(row)),
        ]
        for row in rows
    ]


def _peak(case: LineCase) -> str:
    """Such as "200 speckled"."""
    words = [f"{case.peak_dn:g}"]
    words += ["clipped"] if case.saturated else []
    words += ["speckled"] if case.noise.speckle else []
    return " ".join(words)


def map_cells(rows: Sequence[MapRow]) -> list[list[str]]:
    """Cells of the printed table, a list for each row, under MAP_HEADINGS."""
    return [
        [
            row.plane_map,
            row.board,
            f"{row.noise_px:g}",
            *(["refused", *[""] * 5] if row.refused else _figures(row)),
            ", ".join(failed_of_map(row)),
        ]
        for row in rows
    ]


def _figures(row: MapRow) -> list[str]:
    return [
        f"{row.rms_mm:.4f}",
        f"{row.max_mm:.3f}",
        f"{100 * row.within_3_sigma:.1f}",
        f"{100 * row.covered:.1f}",
        f"{row.ms_solve:.1f}",
        f"{row.ms_profile:.2f}",
    ]


def write_bench(
    folder: Path, extractors: Sequence[ExtractorRow], maps: Sequence[MapRow]
) -> dict[str, Any]:
    """What bench.json holds, written to ``folder`` with bench.png; InputError from the disk."""
    content = {
        "extractors": [_judged(row, failed_of_extractor(row)) for row in extractors],
        "maps": [_judged(row, failed_of_map(row)) for row in maps],
    }
    make_folder(folder)
    text = json.dumps(content, indent=2, allow_nan=False)
    write_atomically(folder / "bench.json", f"{text}\n".encode())
    write_atomically(folder / "bench.png", draw_bench(extractors, maps))
    return content


def _judged(row: ExtractorRow | MapRow, failed: list[str]) -> dict[str, Any]:
    """The row in plain JSON types, and which of its figures are out of their limits."""
    return {**_plain(asdict(row)), "failed": failed, "passed": not failed}


def _plain(value: Any) -> Any:
    """The value in plain JSON types, null for what is no number."""
    if isinstance(value, NoiseSection):
        return value.model_dump()
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and not isfinite(value) else value


@style.styled
def draw_bench(extractors: Sequence[ExtractorRow], maps: Sequence[MapRow]) -> bytes:
    """The picture, PNG: how far each extractor and each map is off, everywhere."""
    cases = list(dict.fromkeys(row.case for row in extractors))
    readers = list(dict.fromkeys(row.extractor for row in extractors))
    sights = list(dict.fromkeys((row.board, row.noise_px) for row in maps))
    names = list(dict.fromkeys(row.plane_map for row in maps))
    off = {(r.extractor, r.case): float(np.hypot(r.bias_px, r.scatter_px)) for r in extractors}
    miss = {(r.plane_map, (r.board, r.noise_px)): r.rms_mm for r in maps}
    height = 2.6 + 0.24 * (len(readers) + len(names))
    figure = Figure(figsize=(19.0, height), layout="constrained", facecolor=style.PAPER)
    sizes = {"height_ratios": [max(len(readers), 1), max(len(names), 1)]}
    above, below = figure.subplots(2, 1, gridspec_kw=sizes)
    errors = np.array([[off.get((name, case), np.nan) for case in cases] for name in readers])
    _heat(above, errors, readers, [_title(case) for case in cases], (LEAST_PX, MOST_PX))
    above.set_title("Stripe extractors: rms error in px (colour: its logarithm)")
    errors = np.array([[miss.get((name, sight), np.nan) for sight in sights] for name in names])
    labels = [f"{board}\n{noise:g} px" for board, noise in sights]
    _heat(below, errors, names, labels, (LEAST_MM, MOST_MM))
    below.set_title("Plane maps: rms error in mm, by board and noise of its marks")
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


def _title(case: LineCase) -> str:
    speckled = "\nspeckle" if case.noise.speckle else ""
    return f"{case.water}\n{case.sigma_px:g} px\n{case.peak_dn:g} DN{speckled}"


def _heat(
    axes: Axes,
    values: Floats,
    rows: Sequence[str],
    columns: Sequence[str],
    limits: tuple[float, float],
) -> None:
    """A table of numbers with a colour each; empty where there is no number."""
    axes.grid(False)
    if values.size == 0:
        axes.set_axis_off()
        return
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
