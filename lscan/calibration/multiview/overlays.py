"""Pictures of what was seen of each view: its marks, its line, and what became of them."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from lscan.calibration.multiview.views import FittedView
from lscan.calibration.multiview.viewsfile import SAME, ViewsFile
from lscan.files.disk import make_folder
from lscan.files.pictures import read_picture, write_picture
from lscan.records import Bytes

USED, LEFT_OUT = (0, 230, 0), (255, 40, 40)
LINE_USED = (255, 200, 0)
BAND_PX = 18  # at the top, for the words
ARM_PX = 9  # of a cross


def write_overlays(views: ViewsFile, fitted: Sequence[FittedView], folder: Path) -> list[Path]:
    """Write a picture for each view: what ``draw_view`` draws on the picture with its line.

    Parameters
    ----------
    views : ViewsFile, as loaded
    fitted : sequence of FittedView, of the file's views in their order
    folder : Path, to write to; it is made

    Returns
    -------
    list of Path
        The pictures, ``0-NAME.png`` and so on.

    Raises
    ------
    InputError
        Where a picture cannot be read or written.
    """
    make_folder(folder)
    written = []
    for number, (entry, view) in enumerate(zip(views.document.view, fitted, strict=True)):
        shown = entry.picture if entry.laser in (None, SAME) else entry.laser
        assert shown is not None  # a picture is always named
        drawn = draw_view(read_picture(views.path.parent / shown), view)
        written.append(folder / f"{number}-{Path(entry.picture).stem}.png")
        write_picture(written[-1], drawn)
    return written


def draw_view(image: Bytes, view: FittedView) -> Bytes:
    """(H, W, 3) RGB: the picture with the marks and the line that were found in it.

    Marks of a view that was used are green crosses, a line that was used is amber; what was left
    out is red.  The words at the top say why.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8, grey or RGB, where the view was found
    view : FittedView, px
    """
    canvas = np.ascontiguousarray(np.dstack([image] * 3) if image.ndim == 2 else image.copy())
    if view.marks is not None:
        colour = USED if view.used else LEFT_OUT
        for u, v in np.rint(view.marks.image_px[view.marks.found]).astype(int).tolist():
            cv2.drawMarker(canvas, (u, v), colour, cv2.MARKER_TILTED_CROSS, ARM_PX)
    if view.line is not None:
        colour = LINE_USED if view.line_used else LEFT_OUT
        u, v = np.rint(view.line.image_px).astype(int).T
        canvas[np.clip(v, 0, canvas.shape[0] - 1), np.clip(u, 0, canvas.shape[1] - 1)] = colour
    canvas[:BAND_PX] //= 4
    words = f"{view.name}: {view.outcome}".encode("ascii", "replace").decode()
    font, white = cv2.FONT_HERSHEY_SIMPLEX, (255, 255, 255)
    cv2.putText(canvas, words, (4, BAND_PX - 5), font, 0.42, white, 1, cv2.LINE_AA)
    return canvas
