"""Every stripe extractor on every kind of line: bias, scatter, bound, share found, speed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from lscan.benchmark.pictures import BACKGROUND_DN, SHAPE, SKIRTS, LineCase, centres, draw
from lscan.benchmark.timing import median_seconds
from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Floats, Stripe, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.noise import stated_noise
from lscan.stripe.scatter import centre_bound_px

WIDTHS_PX = (0.8, 1.5, 3.0)
PEAKS_DN = (20.0, 200.0, 500.0)  # dim, bright, and twice what the range holds
SENSOR = NoiseSection(read_dn=1.0, dn_per_electron=255 / 15_000)
SPECKLED = NoiseSection(read_dn=1.0, dn_per_electron=255 / 15_000, speckle=0.25)
THRESHOLD_DN = 8.0  # eight times the reading noise
PHASES = 16
REPEATS = 7  # of the extraction that is timed


@dataclass(frozen=True)
class ExtractorRow:
    """One extractor on one kind of line.

    bias_px: mean error.  scatter_px: standard deviation of the error.  bound_ratio: scatter
    over the Cramér-Rao bound; None for a clipped line.
    outliers: share of the errors beyond three standard deviations of the line's width.
    within_3_sigma: share of them within three of the sigmas stated; worst_z: the largest in
    units of its sigma.  found: share of the columns that got a value.
    us_a_frame: median microseconds for one picture of 640 by 480.
    Where nothing was found, the figures of the errors are NaN.
    """

    extractor: str
    case: LineCase
    bias_px: float
    scatter_px: float
    bound_ratio: float | None
    outliers: float
    within_3_sigma: float
    worst_z: float
    found: float
    us_a_frame: float


def cases(quick: bool = False) -> Iterator[LineCase]:
    """Every water, width and peak; without speckle, and the bright line with it."""
    waters = ("tap", "harbor") if quick else tuple(SKIRTS)
    widths = WIDTHS_PX[1:2] if quick else WIDTHS_PX
    for water, width, peak in product(waters, widths, PEAKS_DN):
        yield LineCase(water, width, peak, SENSOR)
    for width in widths:
        yield LineCase("tap", width, PEAKS_DN[1], SPECKLED)


def bench_extractors(
    names: Sequence[str],
    seed: int = 1,
    pictures: int = 6,
    quick: bool = False,
    progress: Callable[[int], None] | None = None,
) -> list[ExtractorRow]:
    """A row for each extractor and case, all extractors on the same pictures.

    Parameters
    ----------
    names : sequence of str
        As in ``stripe.extractor`` of a rig file, ``package.module:function`` too.
    seed : int
        Of the pictures' noise.
    pictures : int
        Of each case.
    quick : bool
        Two waters and one width of the line alone.
    progress : callable, optional
        Called with how many of the cases are done.

    Returns
    -------
    list of ExtractorRow

    Raises
    ------
    InputError
        For an unknown extractor or one that fails.
    """
    times = {name: _time_us(name, seed) for name in names}
    rows = []
    for number, case in enumerate(cases(quick)):
        generator = np.random.default_rng([seed, number])
        phases = generator.random(pictures)
        shown = [(centres(phase), draw(case, centres(phase), generator)) for phase in phases]
        for name in names:
            settings = _settings(name, case)
            read = [(true, extract_stripe(image, settings)) for true, image in shown]
            rows.append(_row(name, case, read, times[name]))
        if progress is not None:
            progress(number + 1)
    return rows


def _settings(name: str, case: LineCase) -> StripeSection:
    return StripeSection(extractor=name, threshold_dn=THRESHOLD_DN, noise=case.noise)


def _row(
    name: str, case: LineCase, read: Sequence[tuple[Floats, Stripe]], us_a_frame: float
) -> ExtractorRow:
    valued = has_value(np.concatenate([stripe.status for _, stripe in read]))
    error = np.concatenate([stripe.centre_px - true for true, stripe in read])[valued]
    sigma = np.concatenate([stripe.sigma_px for _, stripe in read])[valued]
    if len(error) == 0:
        error, sigma = np.array([np.nan]), np.array([np.nan])
    scatter, z = float(error.std()), np.abs(error) / sigma
    known = not case.saturated and np.isfinite(scatter)
    return ExtractorRow(
        extractor=name,
        case=case,
        bias_px=float(error.mean()),
        scatter_px=scatter,
        bound_ratio=scatter / bound_px(case) if known else None,
        outliers=1 - share_within(3.0, np.abs(error) / case.sigma_px),
        within_3_sigma=share_within(3.0, z),
        worst_z=float(z.max()),
        found=float(valued.mean()),
        us_a_frame=us_a_frame,
    )


def share_within(limit: float, errors: Floats) -> float:
    """Share of the errors, magnitudes of any shape, up to ``limit``; NaN where one is NaN."""
    return float(np.mean(np.where(np.isnan(errors), np.nan, errors <= limit)))


def bound_px(case: LineCase) -> float:
    """The Cramér-Rao bound of a line's centre, rms over the sub-pixel phases.

    Parameters
    ----------
    case : LineCase
        A line that is not clipped.  The skirt's own shot noise is left out; for speckle the
        bound is that of normal noise of the same variance, and speckle's gamma law lets an
        extractor come a little below.

    Returns
    -------
    float
        Standard deviation, px.

    Examples
    --------
    >>> round(bound_px(LineCase("tap", 1.5, 200.0, NoiseSection(read_dn=1.0))), 4)
    0.0067
    """
    phases = (np.arange(PHASES) + 0.5) / PHASES - 0.5
    noise = stated_noise(case.noise, BACKGROUND_DN)
    return float(np.sqrt(np.mean(centre_bound_px(case.sigma_px, case.peak_dn, noise, phases) ** 2)))


def _time_us(name: str, seed: int) -> float:
    """Median microseconds for a picture of 640 by 480 with a bright line."""
    case = LineCase("tap", 1.5, 200.0, SENSOR)
    rows, columns = SHAPE
    image = np.full((480, 640), 4, dtype=np.uint8)
    line = draw(case, centres(0.3), np.random.default_rng(seed))
    image[:rows] = np.tile(line, image.shape[1] // columns)
    settings = _settings(name, case)
    return 1e6 * median_seconds(lambda: extract_stripe(image, settings), REPEATS)
