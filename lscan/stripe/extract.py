"""From a picture to the stripe in it: the one function that everybody calls."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from lscan.config.plugins import find_plugin_or_function, foreign_error, frames_of_others
from lscan.config.rig import StripeSection
from lscan.errors import InputError, LscanError
from lscan.files.disk import write_atomically
from lscan.files.pictures import eight_bit, linear_dn, linear_picture
from lscan.records import (
    Axis,
    Bytes,
    Floats,
    GreyValues,
    Mask,
    Picture,
    PlanePoints,
    Status,
    Stripe,
    has_value,
)
from lscan.stripe import peaks
from lscan.stripe.api import Extractor, require_stripe, smooths_along, takes_integers
from lscan.stripe.corrections import correct_blur, smooth
from lscan.stripe.picture import (
    PictureLines,
    check_pair,
    check_picture,
    difference_noise,
    faint_threshold,
    is_coded,
    less,
    lines_of,
)
from lscan.stripe.returns import OneReturn, choose_return, withhold
from lscan.stripe.scatter import at_least_seen

_Value = TypeVar("_Value", bound=np.generic)


def extract_stripe(
    image: Picture, settings: StripeSection, background: Picture | None = None
) -> Stripe:
    """The laser line in ``image``: one entry per column, or per row with ``axis="rows"``.

    The highest value of a column must exceed the column's median by more than
    ``threshold_dn``, after the subtraction; NO_PEAK otherwise.  AT_BORDER: the picture's
    edge cuts the window.  SATURATED: a pixel within ``span_px`` of the centre is clipped in
    ``image`` itself (but not in ``background``); sigma_px grows with the clipped width, unless
    the extractor says SATURATED itself, having allowed for it.  AMBIGUOUS: the column holds
    several lines, and it is not known which is meant.  On a lit target sigma_px grows with the
    contrast of the texture beside the line (peaks.py).

    Where the settings do not state the noise, sigma_px is at least what the centres are seen to
    scatter about their neighbours along the line.  Where they do, it grows if the light scatters
    more than that noise makes it.  What they state does not hold in a picture that was compressed
    as JPEG is, and is left out there (picture.py).

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB
    settings : StripeSection, channel, axis, extractor, threshold and span; which of several lines
        is meant (``returns``); the camera's blur to be corrected for and the smoothing along the
        line, neither of which is done by default
    background : array, optional, same shape, the same view with the laser off, to be subtracted

    Returns
    -------
    Stripe
        Of W entries (or H), px and DN.

    Raises
    ------
    InputError
        For pictures of another shape or type, for an unknown extractor, and for one that fails or
        gives no stripe of the picture.

    Examples
    --------
    >>> import lscan, numpy as np
    >>> image = np.zeros((9, 3), dtype=np.uint8)
    >>> image[3:6] = [[90], [200], [90]]
    >>> lscan.extract_stripe(image, lscan.StripeSection()).centre_px
    array([4., 4., 4.])
    """
    extractor = find_extractor(settings.extractor)
    seen = _seen_picture(image, settings, background)
    known, light, clipped = seen.known, seen.chosen.image.T, seen.chosen.clipped
    stripe = _call_extractor(extractor, seen.chosen.image, known, clipped)
    stripe = _mark_saturated(stripe, clipped.T, seen.light.white, known.span_px)
    stripe = withhold(stripe, seen.chosen.ambiguous)
    stripe = _doubt_by_target(stripe, seen)
    along = at_least_seen((stripe, light, seen.chosen.crest), known, smooths_along(extractor))
    stripe = correct_blur(along.stripe, known, light)
    stripe = smooth(stripe, known.smooth_px, along.shared_columns)
    # Anywhere up to that on either side: a rectangular distribution (GUM 4.3.7).
    doubt_px = np.hypot(along.doubt_px, seen.light.shift_px / np.sqrt(3))
    stripe = replace(stripe, sigma_px=np.hypot(stripe.sigma_px, doubt_px))
    return replace(stripe, flux=peaks.core_flux(stripe, light))


def compile_lines() -> None:
    """Find lines in pictures of each kind, so that the loops are compiled for what follows."""
    rows, columns = np.mgrid[:96, :128]
    light = 150 * np.exp(-((rows - 40 - 0.1 * columns) ** 2) / 8)
    light += np.random.default_rng(0).uniform(5, 10, rows.shape)
    for square_px, contrast_dn in ((12, 0), (12, 80), (16, 80)):  # a lit target's, told from lines
        board = contrast_dn * ((rows // square_px + columns // square_px) % 2)
        picture = np.minimum(light + board, 255).astype(np.uint8)
        for name in ("centroid", "gaussian", "ml", "steger"):
            for dark in (None, np.zeros_like(picture)):
                extract_stripe(picture, StripeSection(extractor=name, smooth_px=1.0), dark)
            deep = np.minimum(16 * (light + board), 4095).astype(np.uint16) * 16  # of 12 bits
            extract_stripe(deep, StripeSection(extractor=name))


class _SeenPicture(NamedTuple):
    """The picture with one line in each column, that with all, and the settings for both."""

    chosen: OneReturn
    light: PictureLines
    known: StripeSection


def _seen_picture(
    image: Picture, settings: StripeSection, background: Picture | None
) -> _SeenPicture:
    light, known = _light(image, settings, background)
    white = light.white is not None and bool(light.white.any())
    return _SeenPicture(choose_return(light.grey.T, known, light.clipped.T, white), light, known)


def _doubt_by_target(stripe: Stripe, seen: _SeenPicture) -> Stripe:
    """The stripe with what the target about the line makes doubtful."""
    light, threshold_dn = seen.chosen.image.T, seen.known.threshold_dn
    if seen.chosen.textured:
        stripe = peaks.doubt_beside_edge(stripe, light, seen.light.grey, threshold_dn)
    if seen.light.others is not None:
        stripe = peaks.doubt_beside_edge(stripe, light, seen.light.others, threshold_dn)
    return stripe


def _light(
    image: Picture, settings: StripeSection, background: Picture | None
) -> tuple[PictureLines, StripeSection]:
    """The picture's lines less those of the background, and the settings with noise and threshold.

    Clipped are the pixels at the end of the range by the laser's doing.
    """
    check_pair(image, background)
    if settings.line_width_px and peaks.smoothing_px(settings.line_width_px):
        # A window of the paper's span would see no more of a wide line than its speckle.
        span_px = max(settings.span_px, int(settings.line_width_px))
        settings = settings.model_copy(update={"span_px": span_px})
    lit = taken = lines_of(image, settings.channel, settings.axis, where="image")
    if settings.gamma != 1:
        # Coding, half colours and the range's end show in the grey values as the camera gave them.
        image, end = (
            linear_picture(image, settings.gamma),
            linear_dn(settings.gamma)[lit.clipping_dn],
        )
        lit = lines_of(image, settings.channel, settings.axis, "image", int(end))
        lit = replace(lit, shift_px=taken.shift_px)
    if settings.channel == "auto" and lit.others is not None:
        coloured = lit.grey if lit.white is None else np.where(lit.white, 0, lit.grey)
        threshold_dn = min(settings.threshold_dn, faint_threshold(coloured))
        settings = settings.model_copy(update={"threshold_dn": threshold_dn})
    if settings.noise is not None and is_coded(taken.grey):
        settings = settings.model_copy(update={"noise": None})
    taken_off: list[GreyValues] = [] if lit.others is None else [lit.others]
    if background is not None:
        background = linear_picture(background, settings.gamma)
        dark = lines_of(background, lit.channel, settings.axis, "background", lit.clipping_dn)
        taken_off.append(dark.grey)
        grey, clipped = less(lit.grey, dark.grey), lit.clipped & ~dark.clipped
        # The target's edges, which shift the laser's light too, show in the background alone.
        others = dark.grey if lit.others is None else lit.others
        lit = replace(lit, grey=grey, clipped=clipped, others=others)
    for other in taken_off:
        if settings.noise is not None:
            both = difference_noise(settings.noise, float(other.mean()))
            settings = settings.model_copy(update={"noise": both})
    return lit, settings


def _call_extractor(
    extractor: Extractor, image: GreyValues, settings: StripeSection, clipped: Mask
) -> Stripe:
    """What the extractor says, with the axis set; InputError where it is no extractor.

    An extractor may come from another package: it cannot write into the picture, and its result
    is validated.
    """
    where = f"extractor {settings.extractor}"
    given: NDArray[Any] = image if takes_integers(extractor) else image.astype(np.float64)
    try:
        stripe = extractor(_read_only(given), settings, _read_only(clipped))
    except LscanError:
        raise
    except Exception as error:
        if isinstance(error, TypeError) and not frames_of_others(error):
            raise InputError(f"cannot be called as an extractor: {error}", where=where) from error
        raise InputError(f"failed: {foreign_error(error)}", where=where) from error
    require_stripe(stripe, image.shape, where)
    return replace(stripe, axis=settings.axis)


def _read_only(picture: NDArray[_Value]) -> NDArray[_Value]:
    view = picture.view()
    view.flags.writeable = False
    return view


@lru_cache(maxsize=32)
def find_extractor(name: str) -> Extractor:
    """The extractor of a name.

    Parameters
    ----------
    name : str, as registered under ``lscan.extractors``, or ``package.module:function``

    Raises
    ------
    InputError
        Where there is none.
    """
    where = "stripe.extractor"
    return cast(Extractor, find_plugin_or_function("lscan.extractors", name, where))


def _mark_saturated(stripe: Stripe, clipped: Mask, white: Mask | None, span_px: int) -> Stripe:
    """The stripe with its clipped entries SATURATED and their sigma_px enlarged.

    clipped: (N, L) pixels that the laser drove to the end of the camera's range.  Where
    several are, the crest lies somewhere between the first and the last: a uniform
    distribution as wide as they are apart, the whole column considered.  An extractor that
    gave an entry as SATURATED has allowed for that itself, but not for white crests (N, L), whose
    light is made up.
    """
    at = peaks.clipped_near(stripe, clipped, span_px)
    if len(at) == 0:
        return stripe
    made_up = at[:0] if white is None else peaks.clipped_near(stripe, white, span_px)
    at = at[(stripe.status[at] == Status.OK) | np.isin(at, made_up)]
    status, sigma_px = stripe.status.copy(), stripe.sigma_px.copy()
    status[at] = Status.SATURATED
    sigma_px[at] = np.hypot(sigma_px[at], _extent(clipped[at]) / np.sqrt(12))
    return replace(stripe, status=status, sigma_px=sigma_px)


def _extent(clipped: Mask) -> Floats:
    """Distance in px between the first and the last pixel set in each row of (K, L)."""
    last = clipped.shape[1] - 1 - clipped[:, ::-1].argmax(axis=1)
    return (last - clipped.argmax(axis=1)).astype(float)


# The line in a part of the picture, and the two lines of a scanner with two lasers.


SAME_PX = 1.0  # two lines nearer to each other are one, found twice


def extract_within(
    image: Picture, settings: StripeSection, keep: Mask, background: Picture | None = None
) -> Stripe:
    """The laser line in a part of the picture; elsewhere the entries say NO_DATA.

    The picture is cropped to the part.  Within the crop, what does not belong to the part is cut
    off at the median of its column (or row) in the part, so that nothing stands out there.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB
    settings : StripeSection, as for ``extract_stripe``
    keep : (H, W) mask, of the pixels in which the line may lie
    background : array, optional, same shape as the image, the same view with the laser off

    Returns
    -------
    Stripe
        Of the whole picture's W entries (or H), px and DN.

    Raises
    ------
    InputError
        Where no pixel is kept, for a mask of another shape or type, or as ``extract_stripe``.

    Examples
    --------
    >>> import lscan, numpy as np
    >>> image = np.zeros((20, 4), dtype=np.uint8)
    >>> image[3:6], image[12:15] = 250, 90
    >>> keep = np.zeros((20, 4), dtype=bool)
    >>> keep[8:, 1:] = True
    >>> extract_within(image, lscan.StripeSection(), keep).centre_px.round(3)
    array([nan, 13., 13., 13.])
    """
    check_pair(image, background)
    where = "part of the picture"
    if keep.dtype != np.bool_ or keep.shape != image.shape[:2]:
        mask, allowed = f"{keep.dtype} {keep.shape}", f"bool {image.shape[:2]}"
        raise InputError("is no mask of the picture", where=where, value=mask, allowed=allowed)
    if not keep.any():
        raise InputError("leaves no pixel of the picture", where=where)
    rows, columns = (np.flatnonzero(keep.any(axis=axis)) for axis in (1, 0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    inside, axis = keep[box], settings.axis
    dark = None if background is None else _cut_off(background[box], inside, axis)
    found = extract_stripe(_cut_off(image[box], inside, axis), settings, dark)
    across, along = (rows[0], columns[0]) if axis == "columns" else (columns[0], rows[0])
    whole = image.shape[1] if axis == "columns" else image.shape[0]
    return _stripe_in_picture(_only(found, inside), int(along), float(across), whole)


def told_apart(first: Stripe, last: Stripe) -> tuple[Stripe, Stripe]:
    """The two lines of a scanner with two lasers, from the first and the last line of each column.

    Where they are the same line, nothing tells which of the two it is: AMBIGUOUS.

    Parameters
    ----------
    first, last : Stripe, px, of one picture, with ``returns`` "first" and "last"

    Returns
    -------
    tuple of Stripe
        The upper line and the lower (for rows: the left and the right).
    """
    same = np.abs(first.centre_px - last.centre_px) <= SAME_PX  # False where either is NaN
    return withhold(first, same), withhold(last, same)


def _cut_off(image: Picture, keep: Mask, axis: Axis) -> Picture:
    """The picture, at most as bright beyond the part as each column's median within it."""
    if keep.all():
        return image
    across = 0 if axis == "columns" else 1
    inside = keep if image.ndim == 2 else np.repeat(keep[:, :, None], 3, axis=2)
    # Of a masked array: a column of which nothing is kept has the median 0.
    level = np.ma.median(np.ma.array(image, mask=~inside), axis=across, keepdims=True).filled(0)
    cut = np.minimum(image, level.astype(image.dtype))
    return np.where(inside, image, cut)


def _only(stripe: Stripe, keep: Mask) -> Stripe:
    """The stripe with NO_PEAK where its centre lies beyond the part."""
    at = np.flatnonzero(has_value(stripe.status))
    u, v = np.rint(stripe.image_px[at]).astype(int).T
    height, width = keep.shape
    outside = np.zeros(len(stripe.status), dtype=bool)
    outside[at] = ~keep[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    return withhold(stripe, outside, Status.NO_PEAK)


def _stripe_in_picture(stripe: Stripe, along: int, across: float, whole: int) -> Stripe:
    """The stripe of a crop as one of the whole picture.

    along, across: px, where the crop begins.  whole: entries of the whole picture.
    """

    placed: dict[str, Any] = {}
    for name, values in vars(replace(stripe, centre_px=stripe.centre_px + across)).items():
        if isinstance(values, np.ndarray):
            nothing = int(Status.NO_DATA) if name == "status" else np.nan
            placed[name] = np.full(whole, nothing)
            placed[name][along : along + len(values)] = values
    return replace(stripe, **placed)


# The line of one picture as a table.


def save_stripe(path: Path, stripe: Stripe, points: PlanePoints | None = None) -> None:
    """Write the stripe as CSV: one row a column (or row), empty fields where there is no line.

    Parameters
    ----------
    path : Path, of the file
    stripe : Stripe, px and DN, of N entries
    points : PlanePoints, optional, mm, the N points in the laser sheet: five columns more

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    along = "column" if stripe.axis == "columns" else "row"
    heading = f"{along},centre_px,sigma_px,peak_dn,status"
    numbers = np.column_stack([stripe.centre_px, stripe.sigma_px, stripe.peak])
    table = [
        f"{index},{_fields(row)},{Status(status).name}"
        for index, (row, status) in enumerate(zip(numbers, stripe.status, strict=True))
    ]
    if points is not None:
        heading += ",x_mm,z_mm,sigma_x_mm,sigma_z_mm,status_mm"
        in_mm = np.hstack([points.xz_mm, points.sigma_mm])
        table = [
            f"{line},{_fields(row)},{Status(status).name}"
            for line, row, status in zip(table, in_mm, points.status, strict=True)
        ]
    write_atomically(path, ("\n".join([heading, *table]) + "\n").encode())


def _fields(values: np.ndarray) -> str:
    return ",".join("" if np.isnan(value) else repr(float(value)) for value in values)


# Pictures of what an extractor found.


_COLOUR = {
    Status.OK: (0, 255, 0),
    Status.SATURATED: (255, 200, 0),
    Status.AT_BORDER: (255, 0, 255),
    Status.NO_PEAK: (90, 90, 90),
}
_OTHER_COLOUR = (0, 160, 255)
_COLOURS = np.array([_COLOUR.get(code, _OTHER_COLOUR) for code in Status], dtype=np.uint8)
_EDGE_PX = 4


def draw_stripe(image: Picture, stripe: Stripe) -> Bytes:
    """A copy of ``image`` as (H, W, 3) RGB with the stripe drawn over it.

    The pixel nearest each centre is green, or amber where the line is clipped.  A band of 4
    pixels along the top (for rows: left) edge shows the status of every entry: grey for
    NO_PEAK, magenta for AT_BORDER, blue for any other.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB, in which the stripe was found
    stripe : Stripe, px

    Raises
    ------
    InputError
        Where the picture is none or the stripe is not of its size.
    """
    check_picture(image, where="image")
    seen = eight_bit(image)
    canvas = np.dstack([seen] * 3) if seen.ndim == 2 else seen.copy()
    # A view with one row per entry of the stripe: what is painted there is in the picture.
    lines = canvas.transpose(1, 0, 2) if stripe.axis == "columns" else canvas
    if len(stripe.status) != len(lines):
        what, allowed = "stripe is not of the picture's size", f"{len(lines)} {stripe.axis}"
        raise InputError(what, where="draw_stripe", value=len(stripe.status), allowed=allowed)
    colours = _COLOURS[stripe.status]
    lines[:, :_EDGE_PX] = colours[:, None]
    valued = np.flatnonzero(has_value(stripe.status))
    nearest = np.rint(stripe.centre_px[valued]).astype(int)
    lines[valued, np.clip(nearest, 0, lines.shape[1] - 1)] = colours[valued]
    return canvas
