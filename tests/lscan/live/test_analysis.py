"""What the live page measures of a picture, against closed forms."""

import struct
from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from planeviews import View, paper_board, read_board
from stripe_pictures import light_of

from lscan.calibration.calibrate import calibrate
from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.live.analysis import (
    BAND_PX,
    band_of_line,
    figures_json,
    jpeg_of,
    measure_line,
    measure_picture,
    picture_answer,
    sharpness,
    slope_of,
)
from lscan.records import PlanePoints, Status, has_value
from lscan.stripe import extract_stripe

HEIGHT, WIDTH = 240, 160
GROUND_DN = 20.0
CENTRES = 120 + np.linspace(-9, 9, WIDTH)
SETTINGS = StripeSection(threshold_dn=30)


def picture(width_px=2.0, height_dn=150.0, read_dn=0.0, seed=1, centres=CENTRES, rows=HEIGHT):
    """(H, W) uint8 of a Gaussian line of standard deviation ``width_px``."""
    rng = np.random.default_rng(seed)
    seen = GROUND_DN + light_of(centres, width_px, height_dn, rows=rows)
    return np.clip(np.rint(seen + rng.normal(0, read_dn, seen.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("width_px", [1.5, 2.5, 4.0])
def test_the_width_is_that_of_the_gaussian(width_px):
    """Integration over a pixel widens the variance by 1/12; the crest's phase, uniform within
    a pixel when columns are laid over each other, by another 1/12."""
    line = measure_line(picture(width_px), SETTINGS, None).line
    full = 2 * np.sqrt(2 * np.log(2))
    low, high = full * width_px, full * np.sqrt(width_px**2 + 2 / 12)
    # Half a grey value of rounding on a flank of 150 DN, on both sides.
    slack = 2 * 0.5 / (150 * 0.3 / width_px)
    assert low - slack < line.width_px < high + slack


@pytest.mark.parametrize("read_dn", [1.0, 3.0])
def test_signal_to_noise_is_the_peak_over_the_dark_noise(read_dn):
    # Of 960 rows the line takes some 20, too few to be taken for noise by a twentieth.
    line = measure_line(picture(3.0, read_dn=read_dn, rows=960), SETTINGS, None).line
    noise = np.sqrt(read_dn**2 + 1 / 12)
    # The highest of the few pixels at the crest lies up to some 2 sigma above it.
    assert 0.95 * 150 / noise < line.snr < 1.05 * (150 + 2 * noise) / noise


@pytest.mark.parametrize("axis", ["columns", "rows"])
@pytest.mark.parametrize("slope", [-0.06, 0.0, 0.004])
def test_the_slope_is_that_of_the_line(slope, axis):
    """To 0.1 px, what a centre is drawn and found to, over the half of the picture."""
    centres = 120 + slope * np.arange(WIDTH)
    image = picture(centres=centres, read_dn=2.0)
    settings = SETTINGS.model_copy(update={"axis": axis})
    line = measure_line(image if axis == "columns" else image.T, settings, None).line
    assert line.slope == pytest.approx(slope, abs=0.1 / (WIDTH / 2))


def test_the_slope_does_not_heed_what_stands_on_the_floor():
    """A sixth of the columns is in a third of the pairs, which the median leaves out."""
    centres = 50 + 0.02 * np.arange(120.0)
    centres[70:90] -= 30.0
    centres[5:15] = np.nan
    assert slope_of(centres) == pytest.approx(0.02, abs=1e-12)
    for nothing in (np.full(120, np.nan), np.zeros(1), np.zeros(0)):
        assert slope_of(nothing) is None


def test_saturation_counts_the_clipped_pixels_of_the_whole_picture():
    image = picture()
    image[:3, :40] = 255
    figures = measure_line(image, SETTINGS, None)
    assert figures.saturated_percent == pytest.approx(100 * 120 / image.size)
    assert measure_picture(image, SETTINGS).saturated_percent == figures.saturated_percent
    colour = np.dstack([picture(), image, image])  # clipped in green, looked at in red
    assert measure_line(colour, SETTINGS, None).saturated_percent == 0


def test_a_clipped_line_is_counted_in_the_page():
    image = picture(height_dn=600.0)
    document = figures_json(measure_line(image, SETTINGS, None))
    assert document["stripe"]["clipped"] == document["stripe"]["status"]["SATURATED"] == WIDTH
    assert document["saturated_percent"] > 0


@pytest.mark.parametrize("width_px", [1.0, 2.0, 4.0])
def test_the_sharpness_of_a_gaussian_is_the_closed_form(width_px):
    """Sum of (I(x+1) - I(x))^2 over sum of I^2 is 2 (1 - exp(-1 / 4 s^2)), averaged over the
    phases that the sloping line passes; a pixel's integration adds 1/12 to s^2."""
    light = light_of(CENTRES, width_px, 1000.0, rows=HEIGHT).T
    expected = 2000 * (1 - np.exp(-1 / (4 * (width_px**2 + 1 / 12))))
    # A box is no Gaussian: their fourth moments differ by 1/120 px^4, which changes the
    # spectrum's second moment by less than 1 part in 100 from s = 1 px on.
    assert sharpness(light, 0.0) == pytest.approx(expected, rel=0.01)


@examples(25)
@given(
    width_px=st.floats(1, 5),
    wider=st.floats(1.1, 2),
    height_dn=st.floats(80, 220),
    read_dn=st.floats(0, 3),
)
def test_focus_falls_with_blur_and_does_not_follow_exposure(width_px, wider, height_dn, read_dn):
    sharp, blurred, dim = (
        measure_line(picture(w, h, read_dn), SETTINGS, None).focus
        for w, h in ((width_px, height_dn), (width_px * wider, height_dn), (width_px, 80.0))
    )
    assert sharp > blurred
    assert dim == pytest.approx(sharp, rel=0.1)  # the wider line differs by 1.1² = 21 % at least


def test_focus_of_a_whole_picture_falls_with_blur_too():
    rng = np.random.default_rng(3)
    dots = np.kron(rng.integers(0, 2, (30, 20)), np.ones((8, 8))) * 150 + 40
    soft = (dots + np.roll(dots, 1, 0) + np.roll(dots, -1, 0)) / 3
    focus = [measure_picture(i.astype(np.uint8), SETTINGS).focus for i in (dots, soft)]
    assert focus[0] > focus[1] > 0


def test_a_picture_without_a_line_has_no_figures_of_one():
    figures = measure_line(np.full((HEIGHT, WIDTH), 20, np.uint8), SETTINGS, None)
    document = figures_json(figures)["stripe"]
    assert figures.focus == 0
    assert (document["found"], document["of"]) == (0, WIDTH)
    assert document["width_px"] is document["snr"] is None
    assert document["status"] == {"NO_PEAK": WIDTH}
    assert document["centre_px"] == [None] * WIDTH


@pytest.mark.parametrize("axis", ["columns", "rows"])
@pytest.mark.parametrize("extractor", ["centroid-relative", "ml"])
def test_the_band_gives_the_line_of_the_whole_picture(axis, extractor):
    image = picture(read_dn=2.0, centres=CENTRES + 60)
    image = image if axis == "columns" else np.ascontiguousarray(image.T)
    section = SETTINGS.model_copy(update={"axis": axis, "extractor": extractor})
    found, whole = measure_line(image, section, None).line.stripe, extract_stripe(image, section)
    assert (found.status == whole.status).all()
    # The band's median may be another by one DN of 150, on a window of 5 px.
    assert found.centre_px == pytest.approx(whole.centre_px, abs=2 * 2 / 150)


def test_the_band_reaches_so_far_beside_the_line():
    band = band_of_line(np.ascontiguousarray(picture().T), 30.0)
    assert band.start <= CENTRES.min() - BAND_PX + 1
    assert band.stop >= CENTRES.max() + BAND_PX - 1
    assert band_of_line(np.full((WIDTH, HEIGHT), 20, np.uint8), 30.0) == slice(0, HEIGHT)


def test_what_is_no_picture_is_refused():
    with pytest.raises(InputError, match="is not a picture"):
        measure_line(np.zeros((4, 4), dtype=np.float64), SETTINGS, None)


# ---- the profile ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["graticule-2", "projective"])
def test_the_profile_is_what_the_map_says_of_the_line(name):
    reading = read_board(paper_board(), View().project)
    plane_map = calibrate(reading, name).plane_map
    centres = 240 + 20 * np.sin(np.arange(640) / 50)
    figures = measure_line(picture(centres=centres, rows=480), SETTINGS, plane_map)
    stripe = figures.line.stripe
    exact = plane_map.to_plane(stripe.image_px, stripe.sigma_px)
    np.testing.assert_array_equal(figures.profile.xz_mm, exact.xz_mm)
    assert np.isfinite(exact.xz_mm[:, 0]).sum() > 500
    document = figures_json(figures)["profile"]
    assert document["sigma_mm"] == pytest.approx(np.nanmedian(exact.sigma_mm[:, 1]), abs=1e-4)


class Parabola:
    """x = u / 2, z = -v / 3 + b u²; calibrated from u = 40 on."""

    bend = 1e-4

    def to_plane(self, image_px, sigma_px=None):
        u, v = image_px.T
        xz = np.column_stack([u / 2, -v / 3 + self.bend * u**2])
        sigma = np.full_like(xz, 0.25)
        xz[u < 40], sigma[u < 40] = np.nan, np.nan
        status = np.where(u < 40, Status.OUT_OF_BOARD, Status.OK)
        return PlanePoints(xz, sigma, status)


# ---- on the wire ------------------------------------------------------------------------


def test_a_frame_is_length_json_and_jpeg():
    import cv2

    image = np.dstack([picture(), picture() // 2, picture() // 4])
    data = picture_answer({"a": 1, "ä": None}, jpeg_of(image))
    (length,) = struct.unpack(">I", data[:4])
    assert data[4 : 4 + length].decode() == '{"a":1,"\\u00e4":null}'
    shown = cv2.imdecode(np.frombuffer(data[4 + length :], np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == image.shape
    # Red stays red: the mean of each colour within a grey value or two of JPEG's rounding.
    assert shown[..., ::-1].mean((0, 1)) == pytest.approx(image.mean((0, 1)), abs=2)


def test_the_profile_has_null_where_the_map_has_no_value():
    figures = measure_line(picture(), SETTINGS, Parabola())
    document = figures_json(figures)["profile"]
    assert document["x_mm"][:40] == document["z_mm"][:40] == [None] * 40
    assert document["x_mm"][100] == pytest.approx(50.0)
    assert document["sigma_mm"] == 0.25
    assert has_value(figures.line.stripe.status).all()


@pytest.mark.parametrize(
    "measure", [lambda p: measure_line(p, SETTINGS, None), lambda p: measure_picture(p, SETTINGS)]
)
def test_a_picture_of_more_bits_has_the_figures_of_eight(measure: Any) -> None:
    """Of the same grey values, in the upper of sixteen bits; sums are of another order."""
    shallow = picture(3.0)
    one, other = measure(shallow), measure(shallow.astype(np.uint16) << 8)
    assert other.saturated_percent == one.saturated_percent
    assert other.focus == pytest.approx(one.focus, rel=1e-4)
    if one.line is not None:
        assert other.line.width_px == pytest.approx(one.line.width_px, rel=1e-4)
        assert other.line.snr == pytest.approx(one.line.snr, rel=1e-4)


def test_a_browser_is_sent_the_eight_upper_bits() -> None:
    shallow = picture(3.0)
    assert jpeg_of(shallow.astype(np.uint16) * 256 + 255) == jpeg_of(shallow)
