"""What records say of themselves: in a line, and in a notebook's table."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from calibrations import drawn_calibration
from drawn_examples import examples
from hypothesis import given, strategies as st

import lscan
from lscan.pipeline import GrooveMeasures
from lscan.records import (
    Frame,
    Length,
    PlanePoints,
    Profile,
    Provenance,
    Stripe,
    Surface,
    plus_minus,
)

NAN = float("nan")
STATUS = np.array([0, 0, 7, 2])
STRIPE = Stripe("columns", np.ones(4), np.array([0.04, 0.05, NAN, 0.07]), np.ones(4), STATUS)
XZ_SIGMA = np.array([[0.1, 0.2], [0.1, 0.3], [NAN, NAN], [1.0, 1.0]])
POINTS = PlanePoints(np.ones((4, 2)), XZ_SIGMA, STATUS)
XYZ = np.array([[1.0, 2.0, 3.0], [11.0, 2.0, 4.0], [NAN, NAN, NAN], [6.0, 2.0, 5.0]])
SURFACE = Surface(
    xyz_mm=XYZ[None],
    sigma_x_mm=XZ_SIGMA[None, :, 0],
    sigma_z_mm=XZ_SIGMA[None, :, 1],
    status=STATUS[None],
    position_mm=np.array([2.0]),
    corrections=("the sheet's thickness",),
    yaw_rad=np.radians(1.5),
    yaw_sigma_rad=np.radians(0.021),
    provenance=Provenance("<b>rig</b>", 1, "ml", "auto", "00"),
)


@pytest.mark.parametrize(
    ("value", "sigma", "words"),
    [
        # GUM (JCGM 100:2008), 7.2.2: the standard of mass of 100.021 47 g, u = 0.35 mg.
        (100.02147, 0.00035, "100.02147 ± 0.00035 mm"),
        # GUM, 7.2.6: 10.057 62 Ω with u = 27 mΩ is rounded to 10.058 Ω.
        (10.05762, 0.027, "10.058 ± 0.027 mm"),
        (19.9312, 0.2381, "19.93 ± 0.24 mm"),
        (60.0, 0.0999, "60.00 ± 0.10 mm"),  # of which rounding makes another power of ten
        (1234.5, 123.4, "1230 ± 120 mm"),
        (-0.001, 0.24, "0.00 ± 0.24 mm"),
        (60.0, 0.0, "60.000 ± 0 mm"),
        (60.0, NAN, "60.000 ± unknown mm"),
        (NAN, 0.24, "nan ± 0.24 mm"),
    ],
)
def test_two_digits_of_the_uncertainty_are_said(value: float, sigma: float, words: str) -> None:
    assert plus_minus(value, sigma, "mm") == words


@examples(40)
@given(value=st.floats(-1e6, 1e6), sigma=st.floats(1e-9, 1e6))
def test_no_more_is_rounded_away_than_half_of_the_second_digit(value: float, sigma: float) -> None:
    said, about = map(float, plus_minus(value, sigma).split(" ± "))
    half = 0.5 * 10.0 ** (np.floor(np.log10(about) + 1e-9) - 1)
    tolerance = half * (1 + 1e-9) + 1e-15 * abs(value)  # double precision
    assert abs(said - value) <= tolerance
    assert abs(about - sigma) <= tolerance


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (Length(19.96, 19.9312, 0.2381), "<Length 19.93 ± 0.24 mm, nominal 19.96 mm>"),
        (
            STRIPE,
            "<Stripe, columns: 2 OK, 1 SATURATED, 1 OCCLUDED; centre ± 0.05 px (median)>",
        ),
        (
            POINTS,
            "<PlanePoints: 2 OK, 1 SATURATED, 1 OCCLUDED; x ± 0.1, z ± 0.3 mm (median)>",
        ),
        (
            Profile(1.5, POINTS, np.ones(4)),
            "<Profile at 1.5 mm: 2 OK, 1 SATURATED, 1 OCCLUDED; x ± 0.1, z ± 0.3 mm (median)>",
        ),
        (
            SURFACE,
            "<Surface, 1 profiles x 4 columns, frame of the head: 2 OK, 1 SATURATED, 1 OCCLUDED; "
            "x ± 0.1, z ± 0.3 mm (median)>",
        ),
        (
            replace(STRIPE, status=np.ones(4, dtype=int)),
            "<Stripe, columns: 4 NO_PEAK>",
        ),
        (
            Frame(np.zeros((48, 64, 3), np.uint8), 3, 1.5, 1.5, 0.0, 20.0),
            "<Frame 3 at 1.5 mm: 64 x 48 px, uint8, 20 ms>",
        ),
    ],
    ids=lambda one: type(one).__name__,
)
def test_a_record_is_one_line(record: object, words: str) -> None:
    assert repr(record) == words


def cells(html: str) -> list[list[str]]:
    """The table's rows, by a reader of XML, which refuses what is not closed or escaped."""
    return [["".join(cell.itertext()) for cell in row] for row in ElementTree.fromstring(html)]


def test_a_surface_is_a_table_in_a_notebook() -> None:
    assert cells(SURFACE._repr_html_()) == [
        ["size", "1 profiles x 4 columns, frame of the head"],
        ["OK", "2"],
        ["SATURATED", "1"],
        ["OCCLUDED", "1"],
        ["x", "1.00 to 11.00 mm, ± 0.1 mm (median)"],
        ["y", "2.00 to 2.00 mm"],
        ["z", "3.00 to 5.00 mm, ± 0.3 mm (median)"],
        ["corrected for", "the sheet's thickness"],
        ["yaw", "1.500 ± 0.021 deg"],
        ["made from", "1 pictures of <b>rig</b>, ml, auto"],
    ]


def test_lengths_are_a_table_in_a_notebook() -> None:
    measures = GrooveMeasures({"W1": Length(20.0, 19.9312, 0.2381)})
    assert cells(measures._repr_html_()) == [
        ["", "measured, mm", "nominal, mm", "error, mm"],
        ["W1", "19.93 ± 0.24", "20", "-0.07 ± 0.24"],
    ]


def test_a_calibration_is_a_line_and_a_table() -> None:
    calibration = drawn_calibration("polynomial-5")
    fit = f"96 of 100 dots, {calibration.rms_mm:.3f} mm rms"
    scale = plus_minus(*calibration.quantities()["scale_mm_per_px"])
    assert repr(calibration) == f"<Calibration polynomial-5: {fit}>"
    assert repr(calibration.plane_map) == "<PlaneMap polynomial-5>"
    assert repr(calibration.reading).endswith("96 of 100 dots, 16 named, 3 rings>")
    assert cells(calibration._repr_html_()) == [["polynomial-5", fit], ["scale_mm_per_px", scale]]


def test_a_rig_is_a_line() -> None:
    assert (
        repr(lscan.load_rig("paper/board")) == "<RigFile 'paper/board': 'paper: calibration board'>"
    )
