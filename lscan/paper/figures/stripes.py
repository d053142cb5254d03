"""Figures of the laser line: snapshots with the stripe found, and one column's intensities."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from lscan.config.plugins import find_plugin
from lscan.config.rig import StripeSection
from lscan.figures import style
from lscan.figures.style import ReportFigure
from lscan.paper import published as paper
from lscan.paper.experiment import LinePictures
from lscan.paper.figures.words import drawn, photographed
from lscan.records import Bytes, Floats, Status, Stripe, has_value

_FOUND, _COLUMN = "#35e0ff", "#ffd54a"
_ZOOM_PX = 8
_COLOURS = (style.FIRST, style.SECOND, style.THIRD)


def groove_snapshot(pictures: LinePictures) -> ReportFigure:
    """The laser line on the grooved block (Fig. 21)."""
    stripe = pictures.stripe
    return photographed("groove", pictures.images[0], _traced(stripe), line=_describe(stripe))


def sandwave_snapshot(pictures: LinePictures, column: int) -> ReportFigure:
    """The laser line on the sandwave, and the column of Fig. 35 (Fig. 24).

    column: u of the column that is marked.
    """
    image, stripe = pictures.images[0], pictures.stripe
    dashes = f'd="M{column},0V{image.shape[0]}" stroke-width="0.8" stroke-dasharray="4 4"'
    overlay = f'{_traced(stripe)}<path {dashes} stroke="{_COLUMN}"/>'
    return photographed("sandwave", image, overlay, line=_describe(stripe), column=column)


def _traced(stripe: Stripe) -> str:
    return style.spots(stripe.image_px, _FOUND, 1.1)


def _describe(stripe: Stripe) -> str:
    valued = has_value(stripe.status)
    clipped = int((stripe.status == Status.SATURATED).sum())
    parts = [f"{int(valued.sum())} of {len(valued)} {stripe.axis} hold a line (pale dots)"]
    if clipped:
        parts.append(f"{clipped} of them clipped")
    if valued.any():
        parts.append(f"median standard uncertainty {np.median(stripe.sigma_px[valued]):.3f} px")
    return f"{', '.join(parts)}."


def lit_column(pictures: LinePictures) -> int:
    """The column for Fig. 35: the paper's 320th, or the nearest one that holds a line."""
    stripe = pictures.stripe
    wanted = min(paper.COLUMN, pictures.images[0].shape[1] - 1)
    if stripe.axis != "columns":
        return wanted
    lit = np.flatnonzero(has_value(stripe.status))
    return int(lit[np.abs(lit - wanted).argmin()]) if len(lit) else wanted


@style.styled
def column_intensities(images: Sequence[Bytes], column: int) -> ReportFigure:
    """Intensities of one column over consecutive frames, with eq. (8)'s centres (Fig. 35).

    images: at most three frames, each (H, W) grey or (H, W, 3) RGB, whose red is shown.
    """
    reds = [np.asarray(image if image.ndim == 2 else image[:, :, 0], float) for image in images]
    relative = [_centre("centroid-relative", red, column) for red in reds]
    raw = [_centre("centroid", red, column) for red in reds]
    figure, (whole, close) = style.panels(2, (style.WIDTH_IN, 4.4), share_x=False)
    for axes in (whole, close):
        for k, (red, colour) in enumerate(zip(reds, _COLOURS, strict=False), start=1):
            axes.plot(red[:, column], color=colour, linewidth=1.0, label=f"frame {k}")
        axes.set_ylabel("red / DN")
    _draw_centres(close, relative, raw)
    peak = int(reds[0][:, column].argmax())
    close.set_xlim(peak - _ZOOM_PX, peak + _ZOOM_PX)
    close.set_xlabel("v / px")
    whole.set_title("(a) the whole column")
    close.set_title("(b) near the peak")
    style.legend(whole)
    whole.set_xlim(0, len(reds[0]) - 1)
    return drawn(
        "intensities",
        figure,
        column=column,
        frames=len(reds),
        relative=_spread("relative", relative, paper.CENTRES_RELATIVE_PX),
        raw=_spread("raw", raw, paper.CENTRES_RAW_PX),
    )


def _centre(extractor: str, red: Floats, column: int) -> float:
    """Centre of the line in one column by a paper's extractor, px; NaN where there is none."""
    stripe: Stripe = find_plugin("lscan.extractors", extractor)(red, StripeSection(), red >= 255)
    return float(stripe.centre_px[column])


def _draw_centres(axes: Axes, relative: Sequence[float], raw: Sequence[float]) -> None:
    for centres, dash in ((relative, "--"), (raw, ":")):
        for centre, colour in zip(centres, _COLOURS, strict=False):
            if np.isfinite(centre):
                axes.axvline(centre, color=colour, linewidth=0.9, linestyle=dash)


def _spread(kind: str, centres: Sequence[float], printed: Sequence[float]) -> str:
    """One sentence on the centres by one kind of intensity, and on the paper's."""
    theirs = f"{max(printed) - min(printed):.4f} px in the paper"
    if not np.isfinite(centres).all():
        return f"Eq. (8) on {kind} intensities finds no line in some frame."
    listed = ", ".join(f"{centre:.4f}" for centre in centres)
    return (
        f"Eq. (8) on {kind} intensities puts the line at v = {listed} px: a spread of "
        f"{max(centres) - min(centres):.4f} px, {theirs}."
    )
