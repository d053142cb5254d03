"""How extractors read lines on waves as fine as the sheet is thick, and the response of a rig."""

from dataclasses import replace

import numpy as np
import pytest

from lscan.config.rig import NoiseSection, SheetSection, StripeSection, load_rig
from lscan.errors import InputError
from lscan.records import Status, Surface
from lscan.roughness import ScannerResponse, instrument, line_reading, response_of
from lscan.roughness.instrument import AMPLITUDE_PX, corrected_blur_px
from lscan.surface.sheetresponse import transfer

SHEET_PX, BLUR_PX, PEAK_DN = 1.2, 0.7, 120.0
WHOLE = StripeSection(extractor="centroid", threshold_dn=0.0, span_px=12)
SPECKLED = StripeSection(
    extractor="ml", noise=NoiseSection(read_dn=1.0, dn_per_electron=0.017, speckle=0.2)
)
SHEET = SheetSection(thickness_mm=1.5, camera_mm=(20.0, -800.0, 300.0), apex_mm=(20.0, 0.0, 250.0))


def test_the_whole_line_s_centroid_is_read_as_its_closed_form() -> None:
    """But for the waves' own size: a line moves in their cosine by the even terms beside it, whose
    first, of steepness s = size AMPLITUDE_PX / SHEET_PX, is s² / 8 of it (Bessel's J1)."""
    found = line_reading(WHOLE, SHEET_PX, BLUR_PX, PEAK_DN)
    closed = transfer(found.size / (2 * np.pi), 1.0)
    off = (found.size.max() * AMPLITUDE_PX / SHEET_PX) ** 2 / 8
    np.testing.assert_allclose(found.gain, closed, atol=off)
    between = np.array([-0.33, 1.27])
    np.testing.assert_allclose(found.at(between), transfer(between / (2 * np.pi), 1.0), atol=off)


@pytest.fixture(autouse=True)
def few_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the lines for each wave: what is compared has as many."""
    monkeypatch.setattr(instrument, "COLUMNS", 12)


@pytest.mark.slow
def test_a_fit_under_speckle_heeds_the_skirts() -> None:
    """Less is passed before the centroid's null, and more turned over, than of a fit that knows
    reading noise alone: its weights fall with the line's slope, those under speckle do not."""
    quiet = SPECKLED.model_copy(
        update={"noise": NoiseSection(read_dn=1.0, dn_per_electron=0.017, speckle=0.0)}
    )
    under, without = (line_reading(one, 0.5, BLUR_PX, PEAK_DN) for one in (SPECKLED, quiet))
    for size in (0.4, 0.6, 0.8, 1.0):
        assert under.at(np.array(size)) < without.at(np.array(size))
    assert under.gain[0] == pytest.approx(1.0, abs=1e-3)  # a line that moves as a whole


def test_no_line_and_no_length_are_refused() -> None:
    with pytest.raises(InputError, match="finds no line"):
        line_reading(StripeSection(), SHEET_PX, BLUR_PX, 5.0)
    for name, values in (("sheet_px", (0.0, 0.7, 99.0)), ("blur_px", (1.0, -1.0, 99.0)),
                         ("peak_dn", (1.0, 0.7, float("nan")))):  # fmt: skip
        with pytest.raises(InputError, match=name):
            line_reading(SPECKLED, *values)


@pytest.fixture
def scanned() -> Surface:
    """Points 0.8 mm apart, 600 mm beneath the camera, which stands 800 mm before the sheet."""
    y, x = np.mgrid[:20, :50].astype(float)
    status = np.full(x.shape, int(Status.OK))
    xyz = np.stack([0.8 * x, y, -300.0 + 0 * x], axis=-1)
    return Surface(xyz, 0 * x, 0 * x + 0.05, status, y[:, 0], "head")


def test_a_rig_says_the_response_at_its_surface(scanned: Surface) -> None:
    """Sines and pixels by hand: sheet 0.75 mm, of which 600 / 1000 across the line of sight."""
    rig = load_rig("paper/board").rig.model_copy(
        update={"stripe": SPECKLED.model_copy(update={"blur_px": BLUR_PX}), "sheet": SHEET}
    )
    found = response_of(rig, scanned, PEAK_DN)
    lengths = (found.sheet_cm, found.blur_cm, found.pixel_cm, found.corrected_px)
    assert lengths == pytest.approx((0.075, 0.056, 0.08, BLUR_PX))
    assert found.reading is not None
    expected = line_reading(rig.stripe, 0.75 * 0.6 / 0.8, BLUR_PX, PEAK_DN)
    np.testing.assert_allclose(found.reading.gain, expected.gain)
    assert found(3.0, 0.0) == pytest.approx(float(expected.at(np.array(0.225))) ** 2)
    # Points from 20 mm beside the camera on its left to 19.2 mm on its right.
    assert found.aside == pytest.approx(
        np.quantile(0.8 * np.arange(50) - 20, (0.1, 0.3, 0.5, 0.7, 0.9)) / 800, abs=1e-3
    )
    with pytest.raises(InputError, match="peak_dn"):
        response_of(rig, scanned)
    done = replace(scanned, corrections=("sheet thickness of 1.5 mm at a yaw of 0.000 deg",))
    assert response_of(rig, done).reading is None
    with pytest.raises(InputError, match="head frame"):
        response_of(rig, replace(scanned, frame="workpiece"), PEAK_DN)


def test_what_was_corrected_for_blur_is_not_divided_out_twice() -> None:
    """Of long waves the correction gives all back: to the fourth order in w = k pixel, of which
    blur and pixel have s^4 w^4 / 4 at most, and the quadratics 0.5 w^4."""
    lengths = {"blur_cm": 0.07, "pixel_cm": 0.1}
    plain = ScannerResponse(**lengths)
    given_back = ScannerResponse(**lengths, corrected_px=0.7)
    for k in (1.0, 2.0):
        w = k * 0.1
        assert abs(float(given_back(0.0, k)) - 1) < w**4
        assert float(plain(0.0, k)) == pytest.approx(1 - (0.49 + 1 / 12) * w**2, abs=w**4)
    with pytest.raises(InputError, match="pixel_cm"):
        ScannerResponse(corrected_px=0.7)


def test_a_surface_says_the_blur_it_was_corrected_for(scanned: Surface) -> None:
    assert corrected_blur_px(scanned) == 0.0
    assert corrected_blur_px(replace(scanned, corrections=("x", "blur of 0.7 px"))) == 0.7
