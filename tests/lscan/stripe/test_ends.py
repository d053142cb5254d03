"""Ends of lines to a fraction of a column, against lines that end where they were drawn to."""

from dataclasses import replace

import numpy as np
import pytest
from lines_drawn import drawn, lit_share, speckled

from lscan.config.rig import NoiseSection, StripeSection
from lscan.errors import InputError
from lscan.records import Status
from lscan.stripe import extract_stripe
from lscan.stripe.corrections.ends import line_ends

HEIGHT, WIDTH = 80, 120
PLAIN = StripeSection(threshold_dn=15.0)
KNOWN = PLAIN.model_copy(update={"blur_px": 0.7, "noise": NoiseSection(read_dn=1.5, speckle=0.2)})


def picture(start, end, width_px=1.2, blur_px=0.7, slope=0.0, contrast=0.0, rng=None):
    """A uint8 picture of a line of about 110 DN from column ``start`` to ``end``."""
    centre = HEIGHT / 2 + slope * (np.arange(WIDTH) - WIDTH / 2)
    light = drawn(centre, width_px, HEIGHT, 110 * lit_share(WIDTH, start, end, blur_px))
    if rng is None:
        return np.rint(light + 10).astype(np.uint8)
    return np.clip(speckled(light, contrast, rng), 0, 255).astype(np.uint8)


def ends_in(image, section):
    return line_ends(extract_stripe(image, section), image, section)


def two_ends(image, section):
    found = ends_in(image, section)
    assert [end.side for end in found] == ["start", "end"]
    return found


@pytest.mark.parametrize("slope", [0.0, 0.3])
@pytest.mark.parametrize(("width_px", "blur_px"), [(0.8, 0.5), (1.2, 0.7), (1.2, 1.2), (2.0, 0.7)])
def test_without_noise_the_ends_are_where_they_were_drawn(width_px, blur_px, slope):
    errors = []
    for phase in np.arange(0, 1, 0.125):
        truth = 30.2 + phase, 90.6 - 0.7 * phase
        start, end = two_ends(picture(*truth, width_px, blur_px, slope), PLAIN)
        errors += [start.at_px - truth[0], end.at_px - truth[1]]
        middle = HEIGHT / 2 + slope * (end.at_px - WIDTH / 2)
        # Ten columns of straight line drawn on by three, each good to a fifth of its window.
        assert end.centre_px == pytest.approx(middle, abs=0.2)
    # Of the dim columns the rounding to whole DN takes the tails below half a DN, about 1 DN on
    # either side of 330: 0.6 %, where the blur's density is 0.3 a px, is 0.02 px more for one.
    assert np.abs(np.mean(errors)) <= 0.02
    assert np.abs(errors).max() <= 0.04


@pytest.fixture(scope="module")
def errors_and_sigmas():
    """(error, sigma) of both ends of 60 lines with speckle of contrast 0.2."""
    rng = np.random.default_rng(7)
    errors, sigmas = [], []
    for _ in range(60):
        truth = 30 + rng.uniform(), 90 + rng.uniform()
        found = two_ends(picture(*truth, contrast=0.2, rng=rng), KNOWN)
        errors.append([end.at_px - at for end, at in zip(found, truth, strict=True)])
        sigmas.append([end.sigma_px for end in found])
    return np.array(errors), np.array(sigmas)


def test_with_speckle_sigma_is_the_scatter(errors_and_sigmas):
    errors, sigmas = errors_and_sigmas
    pull = errors / sigmas
    # 99.9 % of chi-square/N lies within 3.3 deviations; the priors on blur, slope and pedestal
    # are part of sigma though nothing is wrong with these here: up to 40 % of its square.
    chance = 3.3 * np.sqrt(2 / pull.size)
    assert 0.6 - chance <= np.mean(pull**2) <= 1 + chance
    assert np.abs(np.mean(errors)) <= 3.3 * np.sqrt(np.mean(sigmas**2) / errors.size)


def test_with_speckle_widths_come_out_to_a_tenth_of_a_pixel(errors_and_sigmas):
    errors, _ = errors_and_sigmas
    width_error = errors[:, 1] - errors[:, 0]
    # The bar of the task, with the chance of a root mean square of 60 (99.9 %).
    assert np.sqrt(np.mean(width_error**2)) <= 0.1 * (1 + 3.3 / np.sqrt(2 * len(width_error)))


def test_sigma_grows_with_speckle():
    image = picture(30.3, 90.4)
    sigmas = []
    for speckle in (0.0, 0.1, 0.2, 0.3):
        noise = NoiseSection(read_dn=1.5, speckle=speckle)
        sigmas.append(two_ends(image, KNOWN.model_copy(update={"noise": noise}))[0].sigma_px)
    assert (np.diff(sigmas) > 0).all()


def test_a_mirrored_picture_has_the_mirrored_ends():
    image = picture(30.3, 90.4, slope=0.2, contrast=0.2, rng=np.random.default_rng(5))
    here, there = two_ends(image, KNOWN), two_ends(np.ascontiguousarray(image[:, ::-1]), KNOWN)
    for end, mirrored in zip(here, there[::-1], strict=True):
        assert mirrored.at_px == pytest.approx(WIDTH - 1 - end.at_px, abs=1e-6)
        assert mirrored.sigma_px == pytest.approx(end.sigma_px, rel=1e-6)


def test_rows_have_the_ends_of_the_columns_of_the_transposed_picture():
    image = picture(30.3, 90.4)
    rows = KNOWN.model_copy(update={"axis": "rows"})
    assert ends_in(np.ascontiguousarray(image.T), rows) == ends_in(image, KNOWN)


def test_a_background_is_taken_off():
    image = picture(30.3, 90.4)
    lamp = np.tile(np.linspace(0, 60, WIDTH).astype(np.uint8), (HEIGHT, 1))
    stripe = extract_stripe(image, KNOWN)
    assert line_ends(stripe, image + lamp, KNOWN, lamp) == line_ends(stripe, image, KNOWN)


def test_the_edge_of_the_picture_is_no_end_and_a_gap_makes_two():
    light = drawn(np.full(WIDTH, 40.0), 1.2, HEIGHT, 110.0)
    assert ends_in(np.rint(light).astype(np.uint8), KNOWN) == ()
    gap = 1 - lit_share(WIDTH, 50.3, 60.8, 0.7)
    found = ends_in(np.rint(light * gap).astype(np.uint8), KNOWN)
    assert [end.side for end in found] == ["end", "start"]
    assert [end.at_px for end in found] == pytest.approx([50.3, 60.8], abs=0.02)


def test_a_step_down_ends_one_line_and_begins_another():
    rng = np.random.default_rng(8)
    upper = drawn(np.full(WIDTH, 30.0), 1.2, HEIGHT, 110 * lit_share(WIDTH, -9, 60.4, 0.7))
    lower = drawn(np.full(WIDTH, 45.0), 1.2, HEIGHT, 110 * lit_share(WIDTH, 60.4, 200, 0.7))
    image = np.clip(speckled(upper + lower, 0.0, rng), 0, 255).astype(np.uint8)
    found = ends_in(image, KNOWN)
    assert [end.side for end in found] == ["end", "start"]
    for end in found:
        assert end.at_px == pytest.approx(60.4, abs=4 * end.sigma_px)


def test_nothing_and_a_short_piece_have_no_ends():
    image = np.full((HEIGHT, WIDTH), 10, np.uint8)
    assert ends_in(image, PLAIN) == ()
    assert ends_in(picture(50.0, 55.0), PLAIN) == ()


def test_a_stripe_of_another_picture_is_refused():
    image = picture(30.0, 90.0)
    with pytest.raises(InputError, match=r"line_ends: stripe is not of the picture's size"):
        line_ends(extract_stripe(image, PLAIN), image[:, 1:], PLAIN)


def test_columns_without_value_are_no_part_of_a_piece():
    image = picture(30.0, 90.0)
    stripe = extract_stripe(image, PLAIN)
    centre, status = stripe.centre_px.copy(), stripe.status.copy()
    centre[:], status[:] = np.nan, Status.NO_PEAK
    assert line_ends(replace(stripe, centre_px=centre, status=status), image, PLAIN) == ()
