"""The index of port glass against catalogue values; absorption outside its range."""

import pytest

from lscan.errors import InputError
from sim.water import glass_index
from sim.water.optics import absorption_per_m

LAST_DIGIT = 0.51e-6  # the values have six decimals


@pytest.mark.parametrize(
    ("glass", "indices"),
    [
        ("N-BK7", (1.514846, 1.514520, 1.514207)),
        ("fused silica", (1.456812, 1.456535, 1.456268)),
        ("PMMA", (1.488446, 1.488092, 1.487755)),
    ],
)
def test_glass_has_its_catalogue_index(glass, indices):
    found = [glass_index(glass, nm) for nm in (640, 650, 660)]
    assert found == pytest.approx(indices, abs=LAST_DIGIT)


@pytest.mark.parametrize("index", [1.0, 1.49, 2.5])
def test_a_number_is_an_index(index):
    assert glass_index(index, 650) == index
    assert glass_index(index, 5000) == index


@pytest.mark.parametrize(
    ("t", "psu", "nm", "named"),
    [
        (-1, 0, 650, "temperature_c"),
        (float("nan"), 0, 650, "temperature_c"),
        (20, 36, 650, "salinity_psu"),
        (20, 0, 399, "wavelength_nm"),
    ],
)
def test_absorption_out_of_range_is_refused(t, psu, nm, named):
    with pytest.raises(InputError, match=f"water: {named}.*allowed"):
        absorption_per_m(t, psu, nm)


@pytest.mark.parametrize(
    ("glass", "nm", "says"),
    [
        ("bk7", 650, r"port: glass_index.*'bk7'.*N-BK7, fused silica, PMMA"),
        (0.9, 650, r"port: glass_index.*0\.9.*1 to 2\.5"),
        (float("nan"), 650, "glass_index"),
        ("PMMA", 430, r"PMMA: wavelength_nm.*436\.8 to 1052"),
        ("N-BK7", 290, "N-BK7: wavelength_nm"),
        ("fused silica", 4000, "fused silica: wavelength_nm"),
    ],
)
def test_glass_out_of_range_is_refused(glass, nm, says):
    with pytest.raises(InputError, match=says):
        glass_index(glass, nm)
