"""The nine dimensions of the grooved block from ideal and noisy profiles of it."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.special import ndtr

from lscan.config.targets import Groove, GroovedBlock
from lscan.errors import InputError, MeasurementError
from lscan.measure import groove_dimensions
from lscan.records import PlanePoints, Profile, Status

PIECE = GroovedBlock()
PITCH_MM = 0.9
WIDTHS, HEIGHTS = ("W1", "W2", "W3", "S1", "S2"), ("H1", "H2", "H3", "H4")


def profile(
    tilt_deg: float = 0.0,
    x_mm: float = 0.0,
    z_mm: float = -400.0,
    noise_mm: float = 0.0,
    dropout: float = 0.0,
    dimming: bool = False,
    piece: GroovedBlock = PIECE,
    pitch_mm: float = PITCH_MM,
    seed: int = 0,
    blur_mm: float | None = None,
    gamma: float = 1.0,
) -> Profile:
    """What a laser 900 mm above the block's middle draws on it, seen column by column.

    dimming: columns at a top's ends are as bright as the part of them that is lit.
    blur_mm: by which light ends everywhere; seen is a twentieth of it behind a curve of ``gamma``.
    """
    rng = np.random.default_rng(seed)
    tilt, edges, height = np.radians(tilt_deg), piece.edges_mm(), piece.height_mm
    along, up = np.array([np.cos(tilt), np.sin(tilt)]), np.array([-np.sin(tilt), np.cos(tilt)])
    middle = edges[-1] / 2
    columns = (np.arange(int(480 / pitch_mm)) - 240 / pitch_mm) * pitch_mm
    z, peak = np.full(len(columns), np.nan), np.zeros(len(columns))
    apex = 900.0

    def draw(start: float, stop: float, level: float) -> None:
        left, right = (x_mm + (e - middle) * along[0] + level * up[0] for e in (start, stop))
        lit = np.minimum(columns + pitch_mm / 2, right) - np.maximum(columns - pitch_mm / 2, left)
        part = np.clip(lit / pitch_mm, 0, 1)
        seen = part >= 0.5
        if blur_mm:
            part = ndtr((columns - left) / blur_mm) * ndtr((right - columns) / blur_mm)
            part = part ** (1 / gamma)
            seen = part > 0.05
        from_middle = (columns - x_mm - level * up[0]) / along[0]
        z[seen] = (z_mm + from_middle * along[1] + level * up[1])[seen]
        peak[seen] = (part if dimming or blur_mm else np.ones(len(part)))[seen] * 180

    for k, groove in enumerate(piece.grooves):
        low = height - groove.depth_mm
        # The upper edge nearer to the laser throws its shadow on the bottom.
        shadow = [groove.depth_mm * (edges[1 + 2 * k + i] - middle) / apex for i in (0, 1)]
        start, stop = edges[1 + 2 * k] + max(shadow[0], 0), edges[2 + 2 * k] + min(shadow[1], 0)
        draw(start, stop, low)
    draw(-110.0, -height * middle / apex, 0.0)
    draw(edges[-1] + height * middle / apex, edges[-1] + 110.0, 0.0)
    for k in range(4):
        draw(edges[2 * k], edges[2 * k + 1], height)
    z += rng.normal(0, 1, len(z)) * noise_mm
    seen = np.isfinite(z) & (rng.random(len(z)) >= dropout)
    points = PlanePoints(
        np.where(seen[:, None], np.column_stack([columns, z]), np.nan),
        np.where(seen[:, None], np.full((len(z), 2), max(noise_mm, 0.01)), np.nan),
        np.where(seen, int(Status.OK), int(Status.NO_PEAK)),
    )
    return Profile(12.5, points, np.where(seen, peak, np.nan))


poses = {
    "tilt_deg": st.floats(-3, 3),
    "x_mm": st.floats(-15, 15),
    "z_mm": st.floats(-500, -100),
}


def test_an_ideal_profile_is_exact() -> None:
    """Edges that fall midway between two columns lie half a column beyond the last point."""
    even = replace_widths()
    measured = groove_dimensions(profile(piece=even, pitch_mm=1.0, x_mm=0.5), even)
    assert list(measured) == ["W1", "W2", "W3", "H1", "H2", "H3", "H4", "S1", "S2"]
    for name, length in measured.items():
        assert length.nominal_mm == even.dimensions_mm()[name]
        assert abs(length.error_mm) < 1e-9, name


def replace_widths() -> GroovedBlock:
    """The block with all widths in whole millimetres, 214 in all."""
    grooves = tuple(
        Groove(ridge_mm=ridge, width_mm=width, depth_mm=groove.depth_mm)
        for (ridge, width), groove in zip(
            ((34.0, 20.0), (35.0, 30.0), (35.0, 30.0)), PIECE.grooves, strict=True
        )
    )
    return PIECE.model_copy(update={"grooves": grooves})


@given(**poses)
@examples(40)
def test_heights_are_exact_and_widths_within_sampling(
    tilt_deg: float, x_mm: float, z_mm: float
) -> None:
    measured = groove_dimensions(profile(tilt_deg, x_mm, z_mm), PIECE)
    for name in HEIGHTS:
        assert abs(measured[name].error_mm) < 1e-6, name
    for name in WIDTHS:
        # Either end is known to half a column; along the tilted tops that is 1 / cos as much.
        assert abs(measured[name].error_mm) <= PITCH_MM / np.cos(np.radians(tilt_deg)) + 1e-6


@given(**poses)
@examples(40)
def test_brightness_at_the_ends_determines_parts_of_a_column(
    tilt_deg: float, x_mm: float, z_mm: float
) -> None:
    measured = groove_dimensions(profile(tilt_deg, x_mm, z_mm, dimming=True), PIECE)
    for name in WIDTHS:
        # A column lit by less than half is not seen as the top's: up to half of it is lost at
        # either end, and what is interpolated is off by 0.1 of a column at most.
        error = measured[name].error_mm / PITCH_MM
        assert abs(error) < 2 * 0.6, name


@pytest.mark.parametrize("gamma", [1.0, 1.4, 2.2, 2.6])
@pytest.mark.parametrize("blur_mm", [0.6, 1.2])
def test_widths_hold_what_an_unknown_tone_curve_does_to_ends(gamma: float, blur_mm: float) -> None:
    one = profile(blur_mm=blur_mm, gamma=gamma)
    known, unknown = (groove_dimensions(one, PIECE, doubt) for doubt in (False, True))
    error = np.abs([known[name].error_mm for name in WIDTHS[:4]])
    assert (error <= [1.96 * unknown[name].sigma_mm for name in WIDTHS[:4]]).all()
    assert gamma < 2 or (error > [4 * known[name].sigma_mm for name in WIDTHS[:4]]).all()
    # From one left end to another: both lie as far aside.
    assert unknown["S2"].sigma_mm == pytest.approx(known["S2"].sigma_mm)


@given(**poses, seed=st.integers(0, 10_000))
@examples(40)
def test_noise_moves_heights_as_little_as_the_fit_allows(
    tilt_deg: float, x_mm: float, z_mm: float, seed: int
) -> None:
    measured = groove_dimensions(profile(tilt_deg, x_mm, z_mm, 0.15, 0.02, seed=seed), PIECE)
    for name in HEIGHTS:
        # The shortest bottom keeps 14 points clear of its corners: five standard errors.
        assert abs(measured[name].error_mm) < 5 * 0.15 / np.sqrt(14), name
        # Without modes the points' sigma is taken for common to each line: 0.15 twice, and the
        # fit's own.  The cosine is that of the tops' slope, known to 0.15 mm over 30.
        assert 0.21 < measured[name].sigma_mm < 0.15 * np.sqrt(2) * 1.15


def test_table_iii_from_several_profiles_keeps_the_bar() -> None:
    """The mean of profiles that a slight turn of the block shifts against the columns."""
    several = [profile(1.2, 0.05 * k, -380, 0.1, 0.01, dimming=True, seed=k) for k in range(40)]
    for name, length in groove_dimensions(several, PIECE).items():
        assert abs(length.error_mm) < 0.60, name  # Sec. IV.B: errors are less than 0.6 mm
        assert 0 < length.sigma_mm < 0.5


def test_points_reaching_beneath_a_top_do_not_break_it() -> None:
    """Seen aslant, a bottom's last columns may have a greater x than the next top's first."""
    one = profile(0.0, 0.0)
    xz = one.points.xz_mm.copy()
    low = xz[:, 1] < xz[:, 1].max() - 30
    xz[low, 0] += 2.0
    bent = replace(one, points=replace(one.points, xz_mm=xz))
    here, there = groove_dimensions(one, PIECE), groove_dimensions(bent, PIECE)
    for name in WIDTHS:
        assert there[name].measured_mm == pytest.approx(here[name].measured_mm, abs=1e-9)


def test_one_profile_and_a_list_of_it_agree() -> None:
    one = profile(1.0, 2.0)
    assert groove_dimensions(one, PIECE) == groove_dimensions([one], PIECE)


def test_mirrored_columns_change_nothing() -> None:
    """Invariance: the order of the points is that of the picture's columns, whichever way."""
    one = profile(1.0, 2.0, noise_mm=0.05)
    points = PlanePoints(one.points.xz_mm[::-1], one.points.sigma_mm[::-1], one.points.status[::-1])
    mirrored = Profile(one.position_mm, points, one.brightness[::-1])
    here, there = groove_dimensions(one, PIECE), groove_dimensions(mirrored, PIECE)
    for name in here:
        assert there[name].measured_mm == pytest.approx(here[name].measured_mm, abs=1e-9)


# What cannot be measured


def without(one: Profile, low_mm: float, high_mm: float) -> Profile:
    x = one.points.xz_mm[:, 0]
    gone = (x > low_mm) & (x < high_mm)
    points = PlanePoints(
        np.where(gone[:, None], np.nan, one.points.xz_mm),
        one.points.sigma_mm,
        np.where(gone, int(Status.OCCLUDED), one.points.status),
    )
    return replace(one, points=points)


def test_what_is_missing_is_named() -> None:
    edges = PIECE.edges_mm() - PIECE.edges_mm()[-1] / 2
    whole = profile()
    cases = [
        (without(whole, edges[3] - 1, edges[4] + 1), "bottom of groove 2"),
        (without(whole, -500, edges[1] + 1), "3 tops found"),
        (without(without(whole, -500, edges[0] - 1), edges[-1] + 1, 500), "floor"),
        (without(whole, -500, 500), "0 measured points"),
    ]
    for broken, words in cases:
        with pytest.raises(MeasurementError, match=rf"profile at 12\.5 mm: .*{words}"):
            groove_dimensions(broken, PIECE)


def test_no_profile_and_other_shapes_are_refused() -> None:
    with pytest.raises(InputError, match="no profile"):
        groove_dimensions([], PIECE)
    flat = profile()
    xz = np.column_stack([np.arange(len(flat.brightness)) * 0.9, np.zeros(len(flat.brightness))])
    points = PlanePoints(xz, np.full(xz.shape, 0.1), np.zeros(len(xz), dtype=np.int64))
    with pytest.raises(MeasurementError, match="1 tops found, the block has 4"):
        groove_dimensions(replace(flat, points=points), PIECE)
