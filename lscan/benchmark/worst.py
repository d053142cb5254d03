"""The columns that an extractor errs in most, as one picture."""

import numpy as np
from matplotlib.figure import Figure

from lscan.benchmark.judging import WORST, JudgedExtractor
from lscan.figures import style

DPI = 90


@style.styled
def draw_worst(judged: JudgedExtractor) -> bytes:
    """The picture, PNG: the part about each of the worst columns, truth and what was found.

    Parameters
    ----------
    judged : JudgedExtractor, with at least one such column
    """
    figure = Figure(figsize=(15.0, 6.5), layout="constrained")
    figure.suptitle(f"{judged.extractor}: true +, found ×; grey values as their square roots")
    panels = np.ravel(figure.subplots(2, WORST // 2))
    for axes in panels:
        axes.set_axis_off()
        axes.set(xticks=[], yticks=[])  # else labels are laid out, not drawn
    for axes, one in zip(panels, judged.worst, strict=False):
        axes.imshow(np.sqrt(one.part), cmap="gray", aspect="auto")
        axes.plot(*one.true, "+", color="tab:green", markersize=12)
        axes.plot(*one.found, "x", color="tab:red", markersize=9)
        axes.set_title(
            f"{one.case}, column {one.column}\n{one.error_px:+.2f} px, sigma {one.sigma_px:.2g}",
            fontsize=8,
        )
        axes.grid(False)
    return style.png(figure, DPI)
