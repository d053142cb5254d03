"""The class of a line laser, counted by hand from IEC 60825-1's limits and apertures."""

from math import atan, degrees

import numpy as np
import pytest

from sim.scene import Laser
from sim.studies.design.catalogue import accessible_mw, laser_class

SPAN_DEG = 2 * degrees(atan(3.5 / 100))  # of 7 mm at 100 mm: 4.01 degrees


def laser(power_mw: float, half_deg: float, **keys: object) -> Laser:
    return Laser.model_validate(
        {"power_mw": power_mw, "apex_mm": (0.0, 0.0, 0.0), "fan_half_angle_deg": half_deg} | keys
    )


def test_a_uniform_fan_counts_by_angle() -> None:
    assert accessible_mw(laser(9.2, 35.0)) == pytest.approx(9.2 * SPAN_DEG / 70)
    # A fan that fits into the pupil counts whole.
    assert accessible_mw(laser(0.9, 1.0)) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("power_mw", "half_deg", "nm", "name"),
    [
        (0.39, 1.0, 650.0, "1"), (0.39, 1.0, 450.0, "2"), (0.40, 1.0, 650.0, "2"),
        (1.0, 1.0, 650.0, "2"), (1.01, 1.0, 650.0, "3R"), (5.0, 1.0, 650.0, "3R"),
        (5.1, 1.0, 650.0, "3B"), (500.0, 1.0, 650.0, "3B"), (501.0, 1.0, 650.0, "4"),
        (9.2, 35.0, 650.0, "2"), (501.0, 70.0, 650.0, "4"),
    ],
)  # fmt: skip
def test_each_class_ends_at_its_limit(
    power_mw: float, half_deg: float, nm: float, name: str
) -> None:
    assert laser_class(laser(power_mw, half_deg, wavelength_nm=nm)) == name


@pytest.mark.parametrize(
    "fan", [{"fan": "gaussian"}, {"fan_rise": 0.8}, {"fan_rise": -0.5}, {"fan_rise": 0.0}]
)
@pytest.mark.parametrize("half_deg", [3.0, 20.0, 45.0])
def test_the_brightest_place_of_any_fan_counts(fan: dict[str, object], half_deg: float) -> None:
    """Against the fan's power per angle, integrated: 1e-4 is what 20,001 places leave."""
    one = laser(1.0, half_deg, **fan)
    part = np.linspace(-1, 1, 20_001)
    density = np.exp(-2 * part**2) if one.fan == "gaussian" else 1 + one.fan_rise * part**2
    power = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    window = round(SPAN_DEG / (2 * half_deg) * 20_000)
    most = (power[window:] - power[: len(power) - window]).max() / power[-1]
    assert accessible_mw(one) == pytest.approx(most, abs=1e-4)
