"""The class of a line laser, as its radiation counts by IEC 60825-1.

The standard lets a class be told by what passes an aperture at a distance.  For visible,
continuous light from a source as small as a laser diode two of its conditions matter: 7 mm at
100 mm from the laser, the naked eye's pupil (condition 3), and 50 mm at 2 m, binoculars
(condition 1).  A line's light is spread over its fan, so that less than all of it enters: the
share of the fan within the angle that the aperture spans, at the fan's brightest place.  Across
its thickness all of it is taken to enter, and the source to be a point (C6 = 1): both make the
class no lower than it is.

References
----------
IEC 60825-1:2014 (edition 3), 4.3, 5.4 and tables 3 to 8: accessible emission limits of class 1,
0.39 mW (500 nm to 700 nm; at shorter waves a photochemical limit is added, and no class 1 is
given here), of class 2, 1 mW, of class 3R, 5 mW, of class 3B, 500 mW.
"""

from math import atan, degrees, erf, sqrt
from typing import Literal

from sim.scene import Laser

LaserClass = Literal["1", "2", "3R", "3B", "4"]
CLASSES: tuple[LaserClass, ...] = ("1", "2", "3R", "3B", "4")
LIMITS_MW: dict[LaserClass, float] = {"1": 0.39, "2": 1.0, "3R": 5.0, "3B": 500.0}
CLASS_1_FROM_NM = 500.0
APERTURES_MM = ((7.0, 100.0), (50.0, 2000.0))
"""Diameter and distance: conditions 3 and 1."""


def laser_class(laser: Laser) -> LaserClass:
    """The lowest class whose limit the laser keeps.

    Parameters
    ----------
    laser : Laser, its power, wavelength and fan; several sheets count as one
    """
    power_mw = accessible_mw(laser)
    for name, limit_mw in LIMITS_MW.items():
        if name == "1" and laser.wavelength_nm < CLASS_1_FROM_NM:
            continue
        # Beyond 3R the whole beam may do harm, not what enters an eye alone.
        if (laser.power_mw if name == "3B" else power_mw) <= limit_mw:
            return name
    return "4"


def accessible_mw(laser: Laser) -> float:
    """The most of its power that enters one of the apertures, mW.

    Parameters
    ----------
    laser : Laser
    """
    spans = (2 * degrees(atan(diameter / 2 / distance)) for diameter, distance in APERTURES_MM)
    return laser.power_mw * max(_share(laser, span) for span in spans)


def _share(laser: Laser, span_deg: float) -> float:
    """Of the fan's power, within an angle at its brightest place: its middle, or an edge."""
    part = min(span_deg / 2 / laser.fan_half_angle_deg, 1.0)
    if laser.fan == "gaussian":
        return erf(sqrt(2) * part) / erf(sqrt(2))
    if laser.fan_rise <= 0:  # as 1 + rise a^2, a from -1 to 1
        return part * (1 + laser.fan_rise * part**2 / 3) / (1 + laser.fan_rise / 3)
    inner = max(1 - 2 * part, -1.0)
    return (1 - inner + laser.fan_rise * (1 - inner**3) / 3) / (2 + 2 * laser.fan_rise / 3)
