"""What the instrument does to a spectrum: what it passes, what it adds, and where that ends.

A scanner averages the seabed over the laser sheet's thickness along the track, over the lens's blur
and a pixel along the line, and over a cell of the grid both ways; its points scatter.  The share of
the power that is passed is divided out where the signal is above the noise; beyond the cutoff it is
the instrument that is measured.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.special import ndtr

from lscan.config.rig import Rig, SheetSection, StripeSection
from lscan.errors import InputError
from lscan.records import Floats, Mask, Surface, has_value
from lscan.roughness.patch import MM_PER_CM, Patch
from lscan.roughness.spectra import PatchSpectrum, PowerLaw
from lscan.stripe import find_extractor
from lscan.stripe.corrections import correction_gain
from lscan.surface.sheetresponse import transfer
from lscan.surface.surface import require_head_frame

# What an extractor shows of waves that are as fine as the laser's sheet is thick.
#
# Light before and behind the sheet's middle plane meets the seabed at other heights, and an
# extractor weighs it by rules of its own: a threshold cuts a line's skirts off, and a fit by
# likelihood under speckle, whose deviation grows with the light, heeds the skirts more than a
# centroid does.  So the extractor itself is shown lines on waves, one a column, and what it says of
# them is the gain.
#
# Light at the distance y from the middle plane appears in the picture at tau y + h(y) across the
# line, h being the wave, and as bright as the irradiance g(y): a surface is as bright from wherever
# it is seen (lscan/surface/sheetresponse.py, of which the whole line's centroid is the closed
# form).  The lens and the pixels blur that.


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
        what = "finds no line"
        raise InputError(what, where=f"extractor {settings.extractor}", value=f"{peak_dn:g} DN")
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


# What the instrument does to a spectrum: what it passes, what it adds, and where that ends.


FARTHEST_DB = 1.0  # that a spectrum may be off at its cutoff
LENGTHS_KNOWN = 0.05  # relative standard uncertainty that the response's lengths are taken to have
LENGTHS = ("sheet_cm", "blur_cm", "pixel_cm", "cell_cm")
LEAST_PASSED = 0.05  # share of the power that is divided by


@dataclass(frozen=True)
class ScannerResponse:
    """What a scanner averages over, and what of that its extractor has given back.

    Attributes
    ----------
    sheet_cm : float, cm, along y: standard deviation of the light across the sheet, where it meets
        the seabed, of heights that are not corrected for its thickness
    blur_cm : float, cm, along x: standard deviation of the lens's blur on the seabed
    pixel_cm : float, cm, along x: width of a pixel on the seabed
    cell_cm : float, cm, side of the grid's cells, both ways
    corrected_px : float, px, the blur that lines were corrected for along themselves, as
        ``[stripe] blur_px`` has it; 0: not corrected
    aside : tuple of float, x for each mm of y along lines of sight in plan, of parts of the patch
        that are alike in size: that way a sheet averages, as ``lscan.surface.sheetresponse`` has it
    reading : LineReading or None, how the extractor reads a line on waves as fine as the sheet is
        thick; by default as the centroid of all of its light
    """

    sheet_cm: float = 0.0
    blur_cm: float = 0.0
    pixel_cm: float = 0.0
    cell_cm: float = 0.0
    corrected_px: float = 0.0
    aside: tuple[float, ...] = (0.0,)
    reading: LineReading | None = None

    def __post_init__(self) -> None:
        """Raise InputError where a length is negative, or a correction's pixels have none."""
        for name in LENGTHS:
            if not (length := getattr(self, name)) >= 0:
                raise InputError(name, value=length, allowed="0 cm or more")
        if not self.corrected_px >= 0:
            raise InputError("corrected_px", value=self.corrected_px, allowed="0 px or more")
        if self.corrected_px and not self.pixel_cm:
            raise InputError("pixel_cm", value=0.0, allowed="above 0 cm with corrected_px")

    def __call__(self, along_y: Floats | float, along_x: Floats | float) -> Floats:
        """Share of the power at wavenumbers that is passed.

        A sheet as ``lscan.surface.sheetresponse`` or the extractor's reading has it, a Gaussian for
        the blur, a box for a pixel, what the extractor's correction for blur gives back, and for a
        cell the middle of the quadratic that grid_cells fits to it.

        Parameters
        ----------
        along_y, along_x : array or float, rad/cm
        """
        along_y, along_x = np.asarray(along_y), np.asarray(along_x)
        passed = np.mean([self._sheet_gain(along_y + k * along_x) ** 2 for k in self.aside], axis=0)
        passed = passed * np.exp(-((along_x * self.blur_cm) ** 2))
        passed = passed * np.sinc(along_x * self.pixel_cm / (2 * np.pi)) ** 2
        if self.corrected_px:
            passed = passed * correction_gain(along_x * self.pixel_cm, self.corrected_px) ** 2
        halves = (along * self.cell_cm / 2 for along in (along_y, along_x))
        return np.asarray(passed * _gain_of_quadratic(*halves) ** 2)

    def _sheet_gain(self, across: Floats) -> Floats:
        """Gain of the amplitude of waves of so many rad/cm across the sheet, along a sight."""
        if self.reading is not None:
            return self.reading.at(across * self.sheet_cm)
        return transfer(across / MM_PER_CM / (2 * np.pi), self.sheet_cm * MM_PER_CM)

    def known(self, along_y: Floats | float, along_x: Floats | float) -> Mask:
        """Where enough is passed, and how much is known to 1 dB though lengths be 5 % longer.

        Parameters
        ----------
        along_y, along_x : array or float, rad/cm
        """
        lengths = {name: (1 + LENGTHS_KNOWN) * getattr(self, name) for name in LENGTHS}
        longer = replace(self, **lengths)
        passed, less = self(along_y, along_x), longer(along_y, along_x)
        return np.asarray((passed >= LEAST_PASSED) & (less >= passed * 10 ** (-FARTHEST_DB / 10)))


def _gain_of_quadratic(half_y: Floats, half_x: Floats) -> Floats:
    """What the middle of a quadratic through cos(h_y s + h_x t), over a square, keeps of it.

    It is 7/2 <f> - 15/4 (<s² f> + <t² f>), means over -1 to 1, by least squares.
    """
    (mean_y, second_y), (mean_x, second_x) = (_means_of_cosine(half) for half in (half_y, half_x))
    return 7 / 2 * mean_y * mean_x - 15 / 4 * (second_y * mean_x + mean_y * second_x)


def _means_of_cosine(half: Floats) -> tuple[Floats, Floats]:
    """Means of cos(h t) and of t² cos(h t) over -1 to 1; series where the closed form cancels."""
    small = np.abs(half) < 0.05
    h = np.where(small, 1.0, half)
    mean = np.where(small, 1 - half**2 / 6 + half**4 / 120, np.sin(h) / h)
    closed = np.sin(h) / h + 2 * np.cos(h) / h**2 - 2 * np.sin(h) / h**3
    return mean, np.where(small, 1 / 3 - half**2 / 10 + half**4 / 168, closed)


def noise_density(patch: Patch) -> float:
    """cm^4, the spectrum of the cells' own noise, which is white.

    Parameters
    ----------
    patch : Patch
    """
    return patch.noise_cm2 * patch.cell_cm**2 / (2 * np.pi) ** 2


def corrected_spectrum(
    spectrum: PatchSpectrum, patch: Patch, response: ScannerResponse
) -> PatchSpectrum:
    """A spectrum less the cells' noise, over what the response passes; NaN where that is not known.

    Parameters
    ----------
    spectrum : PatchSpectrum, as measured
    patch : Patch, it was measured on
    response : ScannerResponse
    """
    plane = spectrum.along_y_per_cm, spectrum.along_x_per_cm
    signal = spectrum.density_cm4 - noise_density(patch)
    passed = np.maximum(response(*plane), LEAST_PASSED)
    density = np.where(response.known(*plane), signal / passed, np.nan)
    return replace(spectrum, density_cm4=density)


def cutoff_per_cm(law: PowerLaw, patch: Patch, response: ScannerResponse) -> float:
    """rad/cm, the wavenumber beyond which the instrument is measured, not the seabed.

    Where noise is a quarter of what is passed, so that it alone would lift the spectrum by 1 dB,
    in the mean over the directions in which the response is known, or where it is known in none;
    up to Nyquist's wavenumber.

    Parameters
    ----------
    law : PowerLaw, of the seabed
    patch : Patch, its noise and its cells
    response : ScannerResponse
    """
    size = np.geomspace(1e-3, 1.0, 1000)[:, np.newaxis] * patch.nyquist_per_cm
    way = np.linspace(0.0, np.pi, 72, endpoint=False)
    plane = size * np.sin(way), size * np.cos(way)
    weight = np.where(response.known(*plane), law.density(*plane), 0.0)
    noise = noise_density(patch) / np.maximum(response(*plane), LEAST_PASSED)
    total = weight.sum(axis=1)
    lifted = np.where(weight > 0, noise, 0.0).sum(axis=1) > (10 ** (FARTHEST_DB / 10) - 1) * total
    beyond = np.flatnonzero(lifted | (total == 0))
    return float(size[beyond[0], 0]) if len(beyond) else patch.nyquist_per_cm


# What a grid folds in: power of waves that are shorter than it can show.
#
# A seabed's law goes on beyond the grid.  Heights sampled every cell have the spectrum summed over
# all wavenumbers that the cells cannot tell apart, which are 2 pi / cell from one another; of each
# the instrument has passed its share before (Bracewell, The Fourier Transform and Its Applications,
# 3rd ed. 2000, ch. 10).  The nearest are summed one by one, at few nodes, for their sum is smooth;
# those beyond change so little from one wavenumber of the grid to another that they are white.
# Points in a cell count as many: of a cell that averages few, what they fold in themselves is left
# out.


ZONES = 3  # of wavenumbers, to either side, that are summed one by one
NODES = 33  # from one Nyquist wavenumber to the other, of a cubic spline
LAW_ENDS = 16.0
"""Nyquist's wavenumbers that a law is taken to go on to.  Where it ends, with the grains at last,
cells cannot tell: that is known to a factor of two, and part of a fit's uncertainty."""
LAW_ENDS_SIGMA = float(np.log(2))  # of its logarithm
RAYS, RADII = 48, 24  # that white power is summed on


class FoldedPower:
    """Spectrum that sampling adds to a law's own.

    Parameters
    ----------
    cell_cm : float, cm, distance of the samples, both ways
    response : callable, optional, of rad/cm along y and x: share of the power that is passed
    """

    def __init__(
        self, cell_cm: float, response: Callable[[Floats, Floats], Floats] | None = None
    ) -> None:
        nyquist, zones = np.pi / cell_cm, np.arange(-ZONES, ZONES + 1)
        self._nodes = np.linspace(-nyquist, nyquist, NODES)
        away = np.array([(y, x) for y in zones for x in zones if y or x]) * 2 * nyquist
        self._near = (
            self._nodes[:, np.newaxis] + away[:, 0, np.newaxis, np.newaxis],
            self._nodes + away[:, 1, np.newaxis, np.newaxis],
        )
        way = np.pi * (np.arange(RAYS)[:, np.newaxis] + 0.5) / RAYS
        least = (2 * ZONES + 1) * nyquist / np.maximum(np.abs(np.cos(way)), np.sin(way))
        decades = np.log(LAW_ENDS * nyquist / least)
        size = least * np.exp(decades * (np.arange(RADII) + 0.5) / RADII)
        self._far = size * np.sin(way), size * np.cos(way)
        end = LAW_ENDS * nyquist
        self._end = end * np.sin(way), end * np.cos(way)
        # An area in polar coordinates, of both halves, for each of the zones' own.
        self._area = size**2 * decades / RADII * 2 * np.pi / RAYS / (2 * nyquist) ** 2
        self._area_at_end = end**2 * 2 * np.pi / RAYS / (2 * nyquist) ** 2
        self._passed = [
            np.ones(()) if response is None else response(*plane)
            for plane in (self._near, self._far, self._end)
        ]

    def of(self, law: PowerLaw, along_y: Floats, along_x: Floats) -> Floats:
        """(P, Q) cm^4, at wavenumbers that the cells can tell apart.

        Parameters
        ----------
        law : PowerLaw
        along_y, along_x : (P, 1) and (1, Q) array, rad/cm, in any order
        """
        near = (law.density(*self._near) * self._passed[0]).sum(axis=0)
        white = (law.density(*self._far) * self._passed[1] * self._area).sum()
        # No finite power, as of a step of a search, is one that the search judges.
        spline = partial(make_interp_spline, self._nodes, check_finite=False)
        return np.asarray(spline(spline(near)(along_y.ravel()), axis=1)(along_x.ravel()) + white)

    def by_end(self, law: PowerLaw) -> float:
        """cm^4, derivative by the logarithm of the wavenumber that the law goes on to: white.

        Parameters
        ----------
        law : PowerLaw
        """
        return float((law.density(*self._end) * self._passed[2] * self._area_at_end).sum())


# The response of the scanner that a rig file describes, at a surface that it scanned.


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
        blur_cm=blur_px * pixel_mm / MM_PER_CM, pixel_cm=pixel_mm / MM_PER_CM, corrected_px=blur_px
    )
    if rig.sheet is None or is_thickness_corrected(surface):
        return along
    if peak_dn is None:
        raise InputError("is needed where the rig has a [sheet]", where="peak_dn")
    sigma_mm = rig.sheet.thickness_mm / 2
    points = surface.xyz_mm[good]
    # mm across the line of sight for each mm from the sheet's middle plane
    down = rig.sheet.camera_mm[2] - float(points[:, 2].mean())
    across = abs(down) / float(np.hypot(down, rig.sheet.camera_mm[1]))
    sheet_px = sigma_mm * across / pixel_mm
    sheet_cm, reading = sigma_mm / MM_PER_CM, line_reading(rig.stripe, sheet_px, blur_px, peak_dn)
    return replace(along, sheet_cm=sheet_cm, aside=_aside(rig.sheet, points), reading=reading)


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
