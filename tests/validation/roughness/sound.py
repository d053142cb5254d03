"""The models of backscattering against values that others have published."""

from dataclasses import dataclass

import numpy as np

from lscan.roughness import PowerLaw, Sediment, backscattering_strength, reflection
from tests.validation.rows import Row, row

GAMMA2 = 3.25


@dataclass(frozen=True)
class PublishedStrength:
    """One value: kHz, grazing angle, strength of roughness and loss of reflection in dB."""

    bottom: Sediment
    w2_cm4: float
    frequency_khz: float
    grazing_deg: float
    strength_db: float
    loss_db: float


def _published(
    bottom: Sediment, w2_si: float, *values: tuple[float, float, float, float]
) -> list[PublishedStrength]:
    """w2_si: where lengths are in m and wavenumbers in rad/m."""
    return [PublishedStrength(bottom, w2_si * 100 ** (4 - GAMMA2), *value) for value in values]


PUBLISHED = (
    *_published(
        Sediment("fine sand", 1.451, 1.1072, 0.01602), 8.6e-5,
        (20, 60, -32.047, 11.999), (20, 75, -22.894, 12.518), (20, 90, -1.719, 12.661),
        (300, 30, -27.495, 6.499), (300, 45, -26.882, 10.681),
        (300, 75, -18.141, 12.518), (300, 90, -15.832, 12.661),
    ),
    *_published(
        Sediment("medium sand", 1.845, 1.1782, 0.01624), 1.406e-4,
        (20, 60, -25.429, 7.973), (20, 75, -16.533, 8.497), (300, 30, -18.513, 1.153),
        (300, 60, -17.624, 7.973), (300, 90, -15.226, 8.639),
    ),
    *_published(
        Sediment("silt", 1.149, 0.9873, 0.00386), 1.64e-5,
        (20, 75, -41.961, 24.075), (300, 60, -42.149, 24.303), (300, 75, -32.627, 24.075),
    ),
)  # fmt: skip
"""By Jackson's program of APL-UW TM 2-00, as the test data of HydrOffice OpenBST have them; in it
the water has 1,500 m/s, the sediments a shear wave of .002 of that.  Those where his sum of ten
exponentials stands for the integral to .001 dB: where q of ``kirchhoff_integral`` is above some
.03.  Below, small slopes are small roughness, which has a closed form."""


def check_rows() -> list[Row]:
    """The largest differences from published values, dB."""
    strength, loss = [], []
    for one in PUBLISHED:
        law = PowerLaw(GAMMA2, one.w2_cm4)
        found = backscattering_strength(law, one.bottom, one.frequency_khz, one.grazing_deg)
        strength.append(abs(float(found) - one.strength_db))
        reflected = -20 * np.log10(abs(complex(reflection(one.bottom, one.grazing_deg))))
        loss.append(abs(reflected - one.loss_db))
    return [
        row("roughness-published", max(strength), name="backscatter", count=len(strength)),
        row("roughness-published", max(loss), name="loss of reflection", count=len(loss)),
    ]
