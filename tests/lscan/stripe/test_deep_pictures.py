"""Pictures of more than 8 bits: the line of 8, or a finer one where they hold more."""

import numpy as np
import pytest
from stripe_pictures import HEIGHT, centres_of, light_of

from lscan.config.plugins import installed
from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.files.pictures import STEPS_PER_DN
from lscan.records import Bytes, Floats, Picture, Status, Stripe, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.extract import draw_stripe, extract_within
from lscan.stripe.fit import centre_bound_px
from lscan.stripe.picture import Noise, constant_variance, lines_of

BITS, READ_DN, GAIN = 12, 0.06, 0.01


def electronic(seed: int, height_dn: float) -> tuple[Floats, Floats]:
    """(H, W) DN, not rounded yet, of a line of a quiet camera, and its centres."""
    rng = np.random.default_rng(seed)
    centre = centres_of(rng)
    light = light_of(centre, 1.2, height_dn) + 5.0
    return GAIN * rng.poisson(light / GAIN) + rng.normal(0, READ_DN, light.shape), centre


def picture_of(seen: Floats, bits: int) -> Picture:
    """The picture of a camera with so many bits, the uppermost of a deep one's 16."""
    steps = np.clip(np.rint(seen * 2 ** (bits - 8)), 0, 2**bits - 1)
    if bits == 8:
        return steps.astype(np.uint8)
    return steps.astype(np.uint16) * np.uint16(2 ** (16 - bits))


def line_in(picture: Picture, name: str = "ml", **settings: object) -> Stripe:
    return extract_stripe(
        picture,
        StripeSection.model_validate(
            {"extractor": name, "channel": "grey", "threshold_dn": 6.0, **settings}
        ),
    )


@pytest.mark.parametrize("name", installed("lscan.extractors"))
def test_eight_bits_stored_as_sixteen_are_the_same_line(name: str) -> None:
    """What a float of single precision makes of whole DN is exact; sums are of another order."""
    seen, _ = electronic(1, 60.0)
    shallow = picture_of(seen, 8)
    one, other = (line_in(each, name) for each in (shallow, shallow.astype(np.uint16) << 8))
    assert np.array_equal(one.status, other.status)
    np.testing.assert_allclose(other.centre_px, one.centre_px, atol=1e-5)
    np.testing.assert_allclose(other.sigma_px, one.sigma_px, rtol=1e-3)
    np.testing.assert_allclose(other.peak, one.peak)


def test_a_faint_line_gains_what_finer_steps_take_off_its_noise() -> None:
    """Against the bound for each: rounding to s DN adds s²/12, as the Widrow theorem has it.

    Of 640 columns an rms is known to 2.8 %, a ratio of two to 4 %: three of these.
    """
    rms, bound = {}, {}
    seen, centre = electronic(2, 9.0)
    for bits in (8, BITS):
        stripe = line_in(picture_of(seen, bits))
        ok = stripe.status == Status.OK
        assert ok.mean() > 0.99
        off = (stripe.centre_px - centre)[ok]
        rms[bits] = float(np.sqrt(np.mean(off**2)))
        assert np.sqrt(np.mean((off / stripe.sigma_px[ok]) ** 2)) == pytest.approx(1, abs=0.12)
        rounding = 4.0 ** (8 - bits) / 12
        noise = Noise(READ_DN**2 + 5.0 * GAIN + rounding, GAIN)
        phases = np.linspace(-0.5, 0.5, 16, endpoint=False)
        bound[bits] = float(np.sqrt(np.mean(centre_bound_px(1.2, 9.0, noise, phases) ** 2)))
    assert rms[BITS] / rms[8] == pytest.approx(bound[BITS] / bound[8], rel=0.12)
    assert rms[BITS] < 0.8 * rms[8]


@pytest.mark.parametrize("bits", [12, 14, 16])
def test_a_noise_below_one_dn_is_found(bits: int) -> None:
    """120 pixels of 64 columns at least: a variance to 2 %, five times that."""
    seen = np.random.default_rng(3).normal(20.0, 0.1, (HEIGHT, 640))
    grey = lines_of(picture_of(seen, bits), "grey", "columns").grey
    assert constant_variance(grey) == pytest.approx(0.01 + 4.0 ** (8 - bits) / 12, rel=0.1)


def test_where_the_range_ends_pixels_are_clipped() -> None:
    seen, _ = electronic(4, 600.0)
    shallow, deep = (line_in(picture_of(np.minimum(seen, 255.0), bits)) for bits in (8, BITS))
    assert (deep.status == Status.SATURATED).all()
    assert np.array_equal(shallow.status, deep.status)


def coloured(seen: Floats, bits: int, most: float = 255.0) -> Picture:
    """A red line on a grey ground, with a little of it in green."""
    ground = np.full_like(seen, 20.0)
    colours = np.stack([seen + 15.0, ground + 0.1 * seen, ground], axis=-1)
    return picture_of(np.minimum(colours, most), bits)


@pytest.mark.parametrize("channel", ["red", "grey", "red-excess", "auto"])
def test_colours_are_those_of_eight_bits(channel: str) -> None:
    """Rounding differs: by three standard uncertainties at most in one of 640 columns, or five."""
    seen, _ = electronic(5, 90.0)
    shallow, deep = (line_in(coloured(seen, bits), channel=channel) for bits in (8, BITS))
    both = has_value(shallow.status) & has_value(deep.status)
    assert both.mean() > 0.99
    apart = (deep.centre_px - shallow.centre_px)[both] / shallow.sigma_px[both]
    assert np.sqrt(np.mean(apart**2)) < 1 and np.abs(apart).max() < 5


def test_a_background_and_a_tone_curve_are_taken_off() -> None:
    seen, centre = electronic(6, 60.0)
    rows = np.arange(HEIGHT)[:, np.newaxis]
    lamp = 30.0 + 0.1 * rows
    lit, dark = picture_of(seen + lamp, BITS), picture_of(lamp + 0 * seen, BITS)
    settings = StripeSection(channel="grey", threshold_dn=6.0)
    found = extract_stripe(lit, settings, dark)
    assert np.sqrt(np.mean((found.centre_px - centre) ** 2)) < 0.03
    curved = picture_of(255 * (np.clip(seen, 0, 255) / 255) ** (1 / 2.2), BITS)
    straight, undone = line_in(picture_of(seen, BITS)), line_in(curved, gamma=2.2)
    apart = (undone.centre_px - straight.centre_px) / straight.sigma_px
    assert np.sqrt(np.mean(apart**2)) < 0.35


def test_a_part_of_a_picture_and_its_drawing() -> None:
    seen, _ = electronic(7, 60.0)
    deep = picture_of(seen, BITS)
    keep = np.ones(deep.shape, bool)
    keep[:, :100] = False
    whole, part = line_in(deep), extract_within(deep, StripeSection(threshold_dn=6.0), keep)
    assert (part.status[:100] == Status.NO_DATA).all()
    np.testing.assert_allclose(part.centre_px[100:], whole.centre_px[100:], atol=0.02)
    drawn = draw_stripe(deep, whole)
    assert drawn.dtype == np.uint8
    assert np.array_equal(drawn[-1, :, 0], deep[-1] // STEPS_PER_DN)


def test_two_depths_are_no_pair() -> None:
    seen, _ = electronic(8, 60.0)
    pictures: list[Bytes | Picture] = [picture_of(seen, bits) for bits in (BITS, 8)]
    with pytest.raises(InputError, match=r"background: .*type \(got dtype\('uint8'\); .* uint16"):
        extract_stripe(pictures[0], StripeSection(), pictures[1])
