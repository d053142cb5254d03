"""The line on lit, textured targets; frames, clipping below 255 DN, and two lasers told apart."""

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from lines_drawn import drawn, speckled
from pydantic import ValidationError
from scipy.ndimage import gaussian_filter

from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Status, Stripe, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.peaks import Spots, doubt_beside_edge
from lscan.stripe.picture import clipping_level, lines_of, strongest_excess
from lscan.stripe.returns import choose_return, paths_of
from tests.validation.surfaces.lit import LitTarget, lit_mean, lit_picture

HEIGHT, WIDTH = 200, 300
COLUMN = np.arange(WIDTH)
CENTRE = 95 + 25 * np.sin(COLUMN / 60)
ONE = np.ones(1)
FEW = examples(8)
PAPERS = "centroid-relative"


def picture(target, seed=1, centres=CENTRE[None], shares=ONE, clips_dn=255):
    mean = lit_mean(target, centres, shares, HEIGHT)
    return lit_picture(mean, np.random.default_rng(seed), clips_dn)


def coded(image, quality):
    """The picture as JPEG gives it back, its colours at half the resolution."""
    ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert ok
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def shares_of(stripe, truth, sigmas=4.0, slack_px=0.5):
    """Shares of the columns that are found, and that are found elsewhere than at the truth.

    Elsewhere is farther off than four stated sigmas and half a pixel.
    """
    found = has_value(stripe.status)
    wrong = np.abs(stripe.centre_px - truth) > sigmas * stripe.sigma_px + slack_px
    return found.mean(), (found & wrong).mean()


def assert_found(stripe, truth, least=0.98):
    """The bars of a lit textured board without a background picture."""
    found, wrong = shares_of(stripe, truth)
    assert found >= least
    assert wrong <= 0.005


# -- texture ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extractor", "channel", "square_px"),
    [
        ("centroid-relative", "auto", 70.0),
        ("centroid-relative", "red-excess", 14.0),
        ("steger", "red-excess", 36.0),
        ("ml", "auto", 14.0),
        ("ml", "red-excess", 70.0),
    ],
)
def test_the_line_is_found_on_a_lit_chessboard(extractor, channel, square_px):
    image = picture(LitTarget(square_px=square_px))
    chosen = StripeSection(extractor=extractor, channel=channel, threshold_dn=20.0)
    assert_found(extract_stripe(image, chosen), CENTRE)


@pytest.mark.parametrize("extractor", ["centroid-relative", "steger", "ml"])
def test_a_line_with_a_broad_white_crest_is_not_found_at_its_rim(extractor):
    """A camera that nears the end of its range slowly: the rim has colour and is not clipped."""
    target = LitTarget(laser_dn=(9_000.0, 900.0, 900.0), line_px=3.0, dark=1.0)
    mean = lit_mean(target, CENTRE[None], ONE, HEIGHT)
    image = lit_picture(255 * (1 - np.exp(-mean / 250)), np.random.default_rng(1))
    chosen = StripeSection(extractor=extractor, channel="red-excess", threshold_dn=20.0)
    stripe = extract_stripe(image, chosen)
    _, wrong = shares_of(stripe, CENTRE)
    assert wrong <= 0.005
    assert not (stripe.status == Status.OK).any()


@pytest.mark.parametrize(
    ("extractor", "square_px"), [("centroid-relative", 70.0), ("steger", 36.0), ("ml", 36.0)]
)
def test_one_channel_gives_the_line_on_a_lit_chessboard_or_nothing(extractor, square_px):
    """White squares of 130 DN, the line 75 DN high on black ones."""
    image = picture(LitTarget(square_px=square_px))
    chosen = StripeSection(extractor=extractor, threshold_dn=20.0)
    # Not found is what edges swallow that the line's width, 4 px, does not clear: with squares
    # of 36 px an eighth of the places, and of those less than half.
    assert_found(extract_stripe(image, chosen), CENTRE, 0.95)


def test_a_lit_chessboard_without_a_line_holds_none():
    image = picture(LitTarget(laser_dn=(0.0, 0.0, 0.0)))
    for channel in ("red", "grey", "red-excess", "auto"):
        stripe = extract_stripe(image, StripeSection(channel=channel, threshold_dn=20.0))
        assert has_value(stripe.status).mean() <= 0.005


def test_texture_in_a_gap_of_the_line_is_no_line():
    gap = np.where(np.abs(COLUMN - 150) < 40, -1000.0, CENTRE)
    image = picture(LitTarget(), centres=gap[None])
    stripe = extract_stripe(image, StripeSection(threshold_dn=20.0))
    inside = np.abs(COLUMN - 150) < 38  # two columns of blur at either end
    assert not has_value(stripe.status[inside]).any()


def test_noise_in_a_gap_of_the_line_is_no_line():
    """Specks of smoothed noise in their crowd reach the threshold, three standard deviations."""
    gap = np.where(np.abs(COLUMN - 150) < 40, -1000.0, CENTRE)
    mean = lit_mean(LitTarget(laser_dn=(200.0, 20.0, 15.0)), gap[None], ONE, HEIGHT)
    inside, held = np.abs(COLUMN - 150) < 38, []
    for seed in range(3):
        noise = gaussian_filter(
            np.random.default_rng(seed).standard_normal(mean.shape), (0.8, 0.8, 0)
        )
        image = np.clip(np.rint(mean + 12.0 * noise / noise.std()), 0, 255).astype(np.uint8)
        stripe = extract_stripe(image, StripeSection(channel="auto"))
        held.append(has_value(stripe.status[inside]).mean())
        assert has_value(stripe.status[~inside]).mean() >= 0.5
    assert np.mean(held) <= 0.05  # a third of the gap if paths may bend at will


def test_beside_white_crests_the_long_line_counts_and_not_the_brighter_spot():
    """A white gap between coloured bars, twice as high and bright as the line, for 60 columns."""
    image = drawn(CENTRE, 3.4, HEIGHT, 100.0)
    image[160:176, 180:240] = 200.0
    clear = np.zeros(image.shape, dtype=bool)
    for white, line_left in ((False, False), (True, True)):
        chosen = choose_return(image, StripeSection(threshold_dn=20.0), clear, white)
        crest = chosen.image.argmax(axis=0)[185:235]
        assert (np.abs(crest - CENTRE[185:235]) <= 2).all() == line_left


def test_a_line_width_that_is_stated_is_used():
    """A broad line on fine squares: what is narrowest in the picture is not the line."""
    target = LitTarget(square_px=14.0, line_px=8.0)
    image = picture(target)
    found = []
    for width_px in (None, 19.0):
        chosen = StripeSection(threshold_dn=20.0, line_width_px=width_px)
        found.append(shares_of(extract_stripe(image, chosen), CENTRE)[0])
    assert found[1] > found[0]
    with pytest.raises(ValidationError, match="line_width_px"):
        StripeSection(line_width_px=0.9)  # no camera shows a line narrower than a pixel


@pytest.mark.parametrize("extractor", [PAPERS, "ml", "gaussian"])
def test_a_background_picture_goes_with_a_lit_target(extractor):
    """Edges that the difference no longer shows count: a crest on one is 0.9 px off."""
    lit = picture(LitTarget())
    dark = picture(LitTarget(laser_dn=(0.0, 0.0, 0.0)), seed=2)
    for channel in ("red", "red-excess", "auto"):
        chosen = StripeSection(extractor=extractor, channel=channel, threshold_dn=20.0)
        assert_found(extract_stripe(lit, chosen, background=dark), CENTRE)


def test_every_spot_may_be_of_the_line():
    column = np.arange(40)
    light = np.full(40, 100.0)
    spots = Spots(column, np.full(40, 9), np.full(40, 11), light, light)
    np.testing.assert_array_equal(paths_of(spots, (40, 20), 3.0), 0)


def test_without_a_threshold_sigma_stays_finite():
    """A ground of 0 DN beside the line is no edge of infinite contrast."""
    line = drawn(np.full(WIDTH, 100.0), 1.5, HEIGHT, 150.0).T
    ok = np.zeros(WIDTH, dtype=np.int64)
    seen = Stripe("columns", np.full(WIDTH, 100.0), np.full(WIDTH, 0.05), np.full(WIDTH, 150.0), ok)
    for above, below in ((0.0, 0.0), (0.0, 3.0)):
        ground = np.where(np.arange(HEIGHT) < 100, above, below) * np.ones_like(line)
        assert np.isfinite(doubt_beside_edge(seen, line, ground, 0.0).sigma_px).all()


def test_an_edge_along_the_line_is_in_its_sigma():
    """White above and black below: the line seems displaced, by less than sigma says."""
    rows = np.arange(HEIGHT, dtype=float)[:, None]
    light = drawn(np.full(WIDTH, 100.0), 1.5, HEIGHT, 150.0)
    albedo = np.where(rows < 100, 1.0, 0.2)
    sigma = np.full(WIDTH, 0.05)
    ok = np.zeros(WIDTH, dtype=np.int64)
    seen = Stripe("columns", np.full(WIDTH, 100.0), sigma, np.full(WIDTH, 150.0), ok)
    even = doubt_beside_edge(seen, light.T, np.full_like(light.T, 90.0), 20.0)
    edged = doubt_beside_edge(seen, light.T, (100 * np.broadcast_to(albedo, light.shape)).T, 20.0)
    np.testing.assert_array_equal(even.sigma_px, sigma)
    # The mean of the light on white and black, from its own rows.
    mean = (rows * light * albedo).sum(axis=0) / (light * albedo).sum(axis=0)
    assert (np.abs(mean - 100.0) > 10 * sigma).all()
    assert (np.abs(mean - 100.0) < 4 * edged.sigma_px).all()


# -- colours ----------------------------------------------------------------------------


@pytest.mark.parametrize("extractor", ["centroid-relative", "ml"])
def test_auto_lowers_the_threshold_to_a_faint_line(extractor):
    """An excess of 33 DN on white and 25 DN on grey, below the usual threshold of 40 DN."""
    image = picture(LitTarget(laser_dn=(42.0, 5.0, 4.0), dark=0.75))
    stripe = extract_stripe(image, StripeSection(channel="auto", extractor=extractor))
    assert_found(stripe, CENTRE)
    named = StripeSection(channel="red-excess", extractor=extractor)
    assert has_value(extract_stripe(image, named).status).mean() < 0.1


@pytest.mark.parametrize(
    ("laser_dn", "name"),
    [
        ((300.0, 15.0, 15.0), "red-excess"),
        ((15.0, 300.0, 15.0), "green-excess"),
        ((15.0, 15.0, 300.0), "blue-excess"),
        ((10.0, 160.0, 130.0), "cyan-excess"),  # green, as many cameras show it
        ((150.0, 10.0, 200.0), "magenta-excess"),  # violet
    ],
)
def test_auto_reads_the_excess_of_the_lasers_colour(laser_dn, name):
    image = picture(LitTarget(laser_dn=laser_dn))
    assert strongest_excess(image, "columns") == name
    auto = extract_stripe(image, StripeSection(channel="auto"))
    named = extract_stripe(image, StripeSection(channel=name))
    np.testing.assert_array_equal(auto.centre_px, named.centre_px)


@pytest.mark.parametrize(
    ("laser_dn", "colour", "extractor"),
    [((10.0, 180.0, 160.0), "green", "ml"), ((150.0, 10.0, 180.0), "blue", "centroid-relative")],
)
def test_a_laser_that_shows_in_two_colours_is_read_by_both(laser_dn, colour, extractor):
    """Each of the two leaves a tenth of its light above the other, as much as the target has."""
    image = coded(picture(LitTarget(laser_dn=laser_dn)), 90)
    chosen = StripeSection(channel="auto", extractor=extractor, threshold_dn=20.0)
    assert_found(extract_stripe(image, chosen), CENTRE)
    alone = chosen.model_copy(update={"channel": f"{colour}-excess"})
    found, _ = shares_of(extract_stripe(image, alone), CENTRE)
    assert found < 0.7


def faded(pale_dn, last):
    """A line on a grey wall, clipped in red and pale, in a red glow; from ``last`` on faint red."""
    across = np.arange(HEIGHT)[:, None, None] - CENTRE[:, None]
    crest, glow = np.exp(-0.5 * across**2), np.exp(-0.5 * (across / 6) ** 2)
    pale = crest * (125.0, pale_dn, pale_dn) + glow * (50.0, 0.0, 0.0)
    faint = crest * (35.0, 0.0, 0.0)
    light = 90.0 + np.where((last > COLUMN)[:, None], pale, faint)
    noise = np.random.default_rng(1).normal(0, 1, light.shape)
    return np.clip(np.rint(light + noise), 0, 255).astype(np.uint8)


def test_a_crest_whose_colour_fades_near_the_end_of_the_range_is_raised():
    """It has as much excess as the glow beside it: that does not dip, nor say where it is."""
    lines = lines_of(faded(120.0, WIDTH), "red-excess", "columns")
    middle = np.rint(CENTRE).astype(int)
    crest, beside = (lines.grey[COLUMN, middle + k] for k in (0, 5))
    # Between two pixels the crest may stay below the end of the range.
    assert (lines.white[COLUMN, middle] & (crest > 2 * beside)).mean() >= 0.9


def test_auto_takes_the_threshold_from_light_that_is_not_made_up():
    """It is half of the glow's 50 DN; half of the raised crest's is more than the faint line."""
    stripe = extract_stripe(faded(150.0, 200), StripeSection(channel="auto"))
    assert_found(stripe, CENTRE)


@pytest.mark.parametrize(
    ("lacks", "name", "axis"), [(0, "cyan-excess", "rows"), (1, "magenta-excess", "columns")]
)
def test_a_mixed_colours_excess_is_what_both_have_above_the_third(lacks, name, axis):
    """Below what nears the end of the range, where white crests are raised."""
    image = np.random.default_rng(1).integers(0, 220, (40, 30, 3)).astype(np.uint8)
    both = np.delete(image, lacks, axis=2).min(axis=2).astype(int) - image[..., lacks]
    read = lines_of(image, name, axis)
    np.testing.assert_array_equal(read.grey, both.T if axis == "columns" else both)
    assert not read.clipped.any()


def test_auto_reads_a_picture_without_colour_as_grey():
    image = np.repeat(drawn(CENTRE, 1.3, HEIGHT, 150.0).astype(np.uint8)[..., None], 3, axis=2)
    assert strongest_excess(image, "columns") == "grey"
    assert strongest_excess(image[..., 0], "columns") == "grey"
    auto = extract_stripe(image, StripeSection(channel="auto"))
    grey = extract_stripe(image, StripeSection(channel="grey"))
    np.testing.assert_array_equal(auto.centre_px, grey.centre_px)


def test_the_excess_of_grey_is_nothing():
    image = np.repeat(np.random.default_rng(1).integers(0, 256, (40, 30, 1)), 3, axis=2)
    lines = lines_of(image.astype(np.uint8), "green-excess", "rows")
    assert not lines.grey.any()


def test_a_crest_that_is_white_in_the_middle_has_the_excess_of_its_rim():
    """Clipped in all colours, the crest has no colour: it must not fall into two lines."""
    target = LitTarget(laser_dn=(3000.0, 700.0, 700.0))
    image = picture(target)
    lines = lines_of(image, "red-excess", "columns")
    white = (image == 255).all(axis=2).T
    assert white.any(axis=1).mean() > 0.4  # on the white squares at least
    assert lines.clipped[white].all()
    for grey, crest in zip(lines.grey, white, strict=True):
        if crest.any():
            first, last = np.flatnonzero(crest)[[0, -1]]
            rim = min(grey[:first].max(), grey[last + 1 :].max())
            assert grey[first : last + 1].min() >= rim
    stripe = extract_stripe(image, StripeSection(extractor=PAPERS, channel="red-excess"))
    assert_found(stripe, CENTRE)
    assert (stripe.status[white.any(axis=1)] == Status.SATURATED).all()


@pytest.mark.parametrize("extractor", ["centroid-relative", "steger", "ml"])
def test_a_white_crest_in_a_coloured_halo_is_the_line(extractor):
    """The halo, 8 px wide, has more of the line's colour than what is left of it in the crest."""
    halo = LitTarget(laser_dn=(400.0, 60.0, 60.0), line_px=8.0)
    crest = LitTarget(lamp_dn=(0.0, 0.0, 0.0), laser_dn=(2000.0, 1500.0, 1500.0), line_px=2.0)
    mean = sum(lit_mean(target, CENTRE[None], ONE, HEIGHT) for target in (halo, crest))
    chosen = StripeSection(extractor=extractor, channel="red-excess", threshold_dn=20.0)
    stripe = extract_stripe(lit_picture(mean, np.random.default_rng(1)), chosen)
    assert_found(stripe, CENTRE)
    # Half the width at which the crest, blurred to 2.1 px, ends the range of the other colours:
    # 2.1 sqrt(2 ln(1500 / (255 - 125 - 20))); the halo's would be 7 px.
    assert np.nanquantile(np.abs(stripe.centre_px - CENTRE), 0.98) <= 4.8


def test_a_stated_noise_is_that_of_both_colours():
    """sigma of the excess is stated from twice the reading noise and both shot noises."""
    target = LitTarget(dark=1.0, laser_dn=(120.0, 0.0, 0.0))
    noise = NoiseSection(read_dn=1.53, dn_per_electron=255 / 15_000)
    chosen = StripeSection(extractor="ml", channel="red-excess", threshold_dn=20.0, noise=noise)
    errors, sigmas = [], []
    for seed in range(4):
        stripe = extract_stripe(picture(target, seed), chosen)
        errors.append(stripe.centre_px - CENTRE)
        sigmas.append(stripe.sigma_px)
    ratio = np.std(np.concatenate(errors)) / np.median(np.concatenate(sigmas))
    # 1200 errors determine a standard deviation to 2 %; with the noise of one colour it is 1.4.
    assert 0.85 < ratio < 1.15


# -- frames -----------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "thick"), [("columns", 1), ("rows", 3), ("columns", 8)])
def test_a_frame_along_the_border_is_not_a_line(axis, thick):
    rng = np.random.default_rng(3)
    light = speckled(drawn(CENTRE, 1.3, HEIGHT, 90.0), 0.1, rng)
    plain = np.clip(light, 0, 255).astype(np.uint8)
    framed = np.full_like(plain, 129)
    inside = (slice(thick, -thick),) * 2
    framed[inside] = plain[inside]
    plain, framed = (plain.T, framed.T) if axis == "rows" else (plain, framed)
    chosen = StripeSection(extractor=PAPERS, axis=axis)
    bare, seen = extract_stripe(plain, chosen), extract_stripe(framed, chosen)
    assert not (seen.status == Status.AT_BORDER).any()
    kept = slice(thick, -thick)
    np.testing.assert_array_equal(seen.centre_px[kept], bare.centre_px[kept])


def test_a_bar_beside_one_edge_is_not_a_line():
    """As cameras leave it that read a few columns more than they have: bright, dark at the rim."""
    rng = np.random.default_rng(3)
    plain = np.clip(speckled(drawn(CENTRE, 1.3, HEIGHT, 90.0), 0.1, rng), 0, 255).astype(np.uint8)
    barred = plain.copy()
    barred[-6:] = np.array([132, 252, 255, 249, 7, 127])[:, None]
    chosen = StripeSection(extractor=PAPERS)
    bare, seen = (extract_stripe(image, chosen) for image in (plain, barred))
    np.testing.assert_array_equal(seen.centre_px, bare.centre_px)


def test_a_line_that_leaves_the_picture_is_at_the_border():
    leaving = np.linspace(-5.0, 60.0, WIDTH)
    rng = np.random.default_rng(4)
    image = np.clip(speckled(drawn(leaving, 1.3, HEIGHT), 0.1, rng), 0, 255).astype(np.uint8)
    stripe = extract_stripe(image, StripeSection())
    cut = (leaving > -0.5) & (leaving < 1.5)
    assert (stripe.status[cut] == Status.AT_BORDER).all()


# -- clipping ---------------------------------------------------------------------------


@FEW
@given(level=st.integers(100, 240), seed=st.integers(0, 2**31), width_px=st.floats(1.0, 4.0))
def test_a_range_that_ends_early_is_found_from_its_plateau(level, seed, width_px):
    rng = np.random.default_rng(seed)
    light = speckled(drawn(CENTRE, width_px, HEIGHT, 4.0 * level), 0.15, rng)
    image = np.clip(light, 0, level).astype(np.uint8)
    assert clipping_level(image.T) == level
    stripe = extract_stripe(image, StripeSection())
    assert (stripe.status == Status.SATURATED).all()


@FEW
@given(
    peak=st.floats(60, 240),
    seed=st.integers(0, 2**31),
    width_px=st.floats(0.8, 10.0),
    noisy=st.booleans(),
)
def test_a_line_within_the_range_shows_no_plateau(peak, seed, width_px, noisy):
    light = drawn(CENTRE, width_px, HEIGHT, peak)
    if noisy:
        light = speckled(light, 0.1, np.random.default_rng(seed))
    image = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    assert clipping_level(image.T) == 255


@pytest.mark.parametrize("width_px", [0.7, 1.0, 1.5])
@pytest.mark.parametrize("noise_dn", [0.5, 1.0, 3.0])
def test_a_level_line_between_two_rows_of_a_mosaic_is_not_clipped(width_px, noise_dn):
    """Its two highest red rows are equal, and so is the one between them, filled in from both."""
    light = drawn(np.full(WIDTH, 61.0), width_px, HEIGHT, 184.0)
    noisy = light + np.random.default_rng(2).normal(8, noise_dn, light.shape)
    image = cv2.cvtColor(np.rint(noisy).clip(0, 255).astype(np.uint8), cv2.COLOR_BayerRGGB2RGB)
    settings = StripeSection(extractor="centroid-relative", threshold_dn=20.0)
    assert (extract_stripe(image, settings).status == Status.OK).all()


def test_a_dark_picture_and_one_that_is_clipped_at_the_end_keep_the_end():
    rng = np.random.default_rng(5)
    dark = rng.normal(4, 1.5, (HEIGHT, WIDTH)).clip(0).astype(np.uint8)
    assert clipping_level(dark) == 255
    bright = np.clip(drawn(CENTRE, 2.0, HEIGHT, 900.0), 0, 255).astype(np.uint8)
    assert clipping_level(bright.T) == 255


# -- two lasers -------------------------------------------------------------------------

UPPER = 60 + 15 * np.sin(COLUMN / 50)
APART = 45.0


@pytest.mark.parametrize(
    ("shares", "lit"), [((0.5, 0.5), True), ((0.7, 0.3), False), ((0.3, 0.7), True)]
)
def test_two_lasers_are_told_apart(shares, lit):
    lamp = (100.0, 95.0, 90.0) if lit else (3.0, 3.0, 3.0)
    # In the dark nothing shows where the texture's edges displace the line.
    target = LitTarget(lamp_dn=lamp, laser_dn=(360.0, 20.0, 10.0), dark=0.25 if lit else 1.0)
    image = picture(target, centres=np.array([UPPER, UPPER + APART]), shares=np.array(shares))
    channel = "red-excess" if lit else "red"
    for returns, truth in (("first", UPPER), ("last", UPPER + APART)):
        chosen = StripeSection(returns=returns, channel=channel, threshold_dn=12.0)
        assert_found(extract_stripe(image, chosen), truth, 0.95)


@FEW
@given(
    seed=st.integers(0, 2**31),
    hidden=st.sampled_from(["upper", "lower"]),
    returns=st.sampled_from(["first", "last"]),
)
def test_where_one_laser_is_hidden_the_other_is_not_taken_for_it(seed, hidden, returns):
    gap = np.abs(COLUMN - 150) < 30
    upper = drawn(UPPER, 1.3, HEIGHT, np.where(gap & (hidden == "upper"), 0.0, 120.0))
    lower = drawn(UPPER + APART, 1.3, HEIGHT, np.where(gap & (hidden == "lower"), 0.0, 100.0))
    rng = np.random.default_rng(seed)
    image = np.clip(speckled(upper + lower, 0.15, rng), 0, 255).astype(np.uint8)
    stripe = extract_stripe(image, StripeSection(returns=returns, threshold_dn=20.0))
    truth = UPPER if returns == "first" else UPPER + APART
    found = has_value(stripe.status)
    assert (np.abs(stripe.centre_px - truth)[found] < 2).all()
    seen = ~gap if hidden == ("upper" if returns == "first" else "lower") else gap | ~gap
    assert found[seen].mean() >= 0.98
