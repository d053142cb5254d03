"""The response of the scanner that a rig file describes, at a surface that it scanned."""

import re
from dataclasses import replace

import numpy as np

from lscan.config.rig import Rig, SheetSection
from lscan.errors import InputError
from lscan.records import Floats, Surface, has_value
from lscan.roughness.instrument import ScannerResponse
from lscan.roughness.linereading import line_reading
from lscan.roughness.patch import MM_PER_CM
from lscan.surface.surface import require_head_frame

BLUR = re.compile(r"blur of (\S+) px")
THICKNESS = re.compile(r"sheet thickness of \S+ mm")
"""How a surface's corrections say it (lscan/pipeline.py, lscan/surface/thickness.py)."""

PARTS = 5  # of the points, from one side to the other, that the lines of sight differ between


def response_of(rig: Rig, surface: Surface, peak_dn: float | None = None) -> ScannerResponse:
    """What a rig's sheet, blur and pixels average over, and how its extractor reads such lines.

    Parameters
    ----------
    rig : Rig, that the surface was reconstructed with; its ``[stripe]`` and ``[sheet]`` count
    surface : Surface, mm, frame of the head; its points lie a pixel apart
    peak_dn : float, optional, DN, brightest grey value of a usual line above the ground; needed
        where there is a ``[sheet]`` whose thickness the surface is not corrected for

    Raises
    ------
    InputError
        The surface is not in the head frame; the brightness is needed and not given.
    """
    require_head_frame(surface)
    good = has_value(surface.status)
    apart = np.linalg.norm(np.diff(surface.xyz_mm[..., :2], axis=1), axis=-1)
    pixel_mm = float(np.median(apart[good[:, 1:] & good[:, :-1]]))
    blur_px = rig.stripe.blur_px or 0.0
    along = ScannerResponse(
        blur_cm=blur_px * pixel_mm / MM_PER_CM,
        pixel_cm=pixel_mm / MM_PER_CM,
        corrected_px=blur_px,
    )
    if rig.sheet is None or is_thickness_corrected(surface):
        return along
    if peak_dn is None:
        raise InputError("is needed where the rig has a [sheet]", where="peak_dn")
    sigma_mm = rig.sheet.thickness_mm / 2
    points = surface.xyz_mm[good]
    sheet_px = sigma_mm * _seen_across(rig.sheet, points) / pixel_mm
    return replace(
        along,
        sheet_cm=sigma_mm / MM_PER_CM,
        aside=_aside(rig.sheet, points),
        reading=line_reading(rig.stripe, sheet_px, blur_px, peak_dn),
    )


def _aside(sheet: SheetSection, points_mm: Floats) -> tuple[float, ...]:
    """x for each mm of y along the lines of sight in plan to (N, 3) points, of fifths of them."""
    kappa = (points_mm[:, 0] - sheet.camera_mm[0]) / -sheet.camera_mm[1]
    middles = (np.arange(PARTS) + 0.5) / PARTS
    return tuple(float(one) for one in np.quantile(kappa, middles))


def is_thickness_corrected(surface: Surface) -> bool:
    """Whether a surface's heights are corrected for the sheet's thickness.

    Parameters
    ----------
    surface : Surface
    """
    return any(THICKNESS.match(done) for done in surface.corrections)


def corrected_blur_px(surface: Surface) -> float:
    """px, the blur that a surface's lines were corrected for; 0 where they were not.

    Parameters
    ----------
    surface : Surface
    """
    told = [BLUR.fullmatch(done) for done in surface.corrections]
    return next((float(one[1]) for one in told if one), 0.0)


def _seen_across(sheet: SheetSection, points_mm: Floats) -> float:
    """mm across the line of sight for each mm from the sheet's middle plane, amid (N, 3) points."""
    down = sheet.camera_mm[2] - float(points_mm[:, 2].mean())
    return abs(down) / float(np.hypot(down, sheet.camera_mm[1]))
