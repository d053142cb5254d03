"""What an extractor shows of waves that are as fine as the laser's sheet is thick.

Light before and behind the sheet's middle plane meets the seabed at other heights, and an extractor
weighs it by rules of its own: a threshold cuts a line's skirts off, and a fit by likelihood under
speckle, whose deviation grows with the light, heeds the skirts more than a centroid does.  So the
extractor itself is shown lines on waves, one a column, and what it says of them is the gain.

Light at the distance y from the middle plane appears in the picture at tau y + h(y) across the
line, h being the wave, and as bright as the irradiance g(y): a surface is as bright from wherever
it is seen (lscan/surface/sheetresponse.py, of which the whole line's centroid is the closed form).
The lens and the pixels blur that.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Floats
from lscan.stripe import find_extractor

FARTHEST = 5.0  # 2 pi k sigma, up to which the gain is found
STEPS = 101
COLUMNS = 48  # lines for each wavenumber, of as many phases and places in the pixel
AMPLITUDE_PX = 0.05  # of the waves: of small slope
OFFSETS = np.arange(-4.5, 4.55, 0.1)  # from the middle plane, in sigmas
ASIDE_PX = 12.0  # of the ground, on either side of the line
SEED = 1


@dataclass(frozen=True)
class LineReading:
    """Gain with which an extractor shows waves across the sheet.

    Attributes
    ----------
    size : (K,) array, rising from 0: 2 pi k sigma, of the wavenumber k and the standard deviation
        sigma of the sheet's light
    gain : (K,) array, of the waves' amplitude; beyond the last it is that of the last
    """

    size: Floats
    gain: Floats

    def at(self, size: Floats) -> Floats:
        """The gain at 2 pi k sigma, of either sign.

        Parameters
        ----------
        size : array
        """
        return np.asarray(np.interp(np.abs(size), self.size, self.gain))


def line_reading(
    settings: StripeSection, sheet_px: float, blur_px: float, peak_dn: float
) -> LineReading:
    """The gain of the extractor that a rig names, on lines as its camera sees them.

    Parameters
    ----------
    settings : StripeSection, of which extractor, threshold, span and noise count; an extractor
        that weighs pixels by their noise needs it stated, for these lines have none to estimate
    sheet_px : float, px, standard deviation of the sheet's light, as seen across the line
    blur_px : float, px, of the lens's blur
    peak_dn : float, DN, brightest grey value of the line above the ground

    Raises
    ------
    InputError
        A length or the brightness is not above 0, the blur negative; there is no such extractor,
        or it finds no line.
    """
    for name, value in (("sheet_px", sheet_px), ("peak_dn", peak_dn)):
        if not value > 0:
            raise InputError(name, value=value, allowed="above 0")
    if not blur_px >= 0:
        raise InputError("blur_px", value=blur_px, allowed="0 px or more")
    generator = np.random.default_rng(SEED)
    size = np.linspace(0.0, FARTHEST, STEPS)
    # In any order: an extractor may hold a line to its neighbours', which are those of a scan.
    each = generator.permutation(np.repeat(np.arange(STEPS), COLUMNS))
    phase = generator.uniform(0.0, 2 * np.pi, each.shape)
    place = generator.uniform(-0.5, 0.5, each.shape)
    waves = size[each][:, np.newaxis] * OFFSETS + phase[:, np.newaxis]
    extractor, height = find_extractor(settings.extractor), _height(sheet_px, blur_px)
    shown = []
    for amplitude in (AMPLITUDE_PX, -AMPLITUDE_PX):
        away = sheet_px * OFFSETS + amplitude * np.cos(waves)
        light = _columns(place[:, np.newaxis] + away, sheet_px, blur_px, height)
        picture = np.ascontiguousarray(peak_dn * light.T)
        shown.append(extractor(picture, settings, np.zeros(picture.shape, dtype=bool)).centre_px)
    moved = (shown[0] - shown[1]) / (2 * AMPLITUDE_PX)
    gain = np.array([_gain(moved[each == k], phase[each == k]) for k in range(STEPS)])
    if not np.isfinite(gain).all():
        raise InputError(
            "finds no line", where=f"extractor {settings.extractor}", value=f"{peak_dn:g} DN"
        )
    return LineReading(size, gain)


def _height(sheet_px: float, blur_px: float) -> int:
    """Pixels across the line, an odd number."""
    reach = OFFSETS[-1] * np.hypot(sheet_px, blur_px) + ASIDE_PX
    return 2 * int(np.ceil(reach)) + 1


def _columns(away_px: Floats, sheet_px: float, blur_px: float, height: int) -> Floats:
    """(N, H) lines whose light at OFFSETS is seen at (N, K) ``away_px`` from the middle pixel.

    They are as bright as 1 at the crest of an undisturbed line amid a pixel.
    """
    step_px = sheet_px * float(OFFSETS[1] - OFFSETS[0])
    light = np.exp(-(OFFSETS**2) / 2) * np.gradient(away_px, axis=-1)
    spread = max(blur_px, step_px)  # of light at single places, a smooth line
    edges = np.arange(height + 1) - height / 2
    found = np.zeros((len(away_px), height))
    for one, at in zip(light.T, away_px.T, strict=True):
        below = ndtr((edges - at[:, np.newaxis]) / spread)
        found += one[:, np.newaxis] * np.diff(below, axis=1)
    middle = ndtr((0.5 - sheet_px * OFFSETS) / spread) - ndtr((-0.5 - sheet_px * OFFSETS) / spread)
    return found / float(np.exp(-(OFFSETS**2) / 2) @ middle * step_px)


def _gain(moved: Floats, phase: Floats) -> float:
    """Share of a wave's cosine in what lines moved by, NaN where half of them are not found."""
    found = np.isfinite(moved)
    if found.mean() < 0.5:
        return float("nan")
    design = np.column_stack([np.cos(phase), np.sin(phase)])[found]
    return float(np.linalg.lstsq(design, moved[found], rcond=None)[0][0])
