"""The line's scatter follows its light: the bound in closed form, and pictures of less light."""

import numpy as np
import pytest
from study_cases import known_of, study_with

from lscan.records import select
from lscan.stripe.fit import centre_bound_px
from lscan.stripe.picture import Noise
from sim.render.tank import Tank
from sim.scene import Scene
from sim.scene.varying import number_at, with_numbers
from sim.studies.rig.evaluation import GeometricRig
from sim.studies.rig.prepared import (
    centre_variance_px2,
    centres_in,
    depends_on_light,
    line_bounds_px,
    lines_at,
    picture_of_layers,
)
from sim.studies.rig.states import states_of

NOISE = {"key": "sensor.noise", "when": "noise"}
EXPOSURES = 16


@pytest.mark.parametrize("width_px", [0.5, 1.0, 2.0, 4.0])
def test_with_additive_noise_alone_the_bound_is_the_closed_form(width_px: float) -> None:
    """(sigma/A)^2 2 w/sqrt(pi); the sum ends at 3 widths of the widest, where 0.04 % is left of
    the integral of x^2 exp(-x^2), and errs by 1e-6 where the step is half a width."""
    one = np.ones(1)
    found = centre_variance_px2(width_px * one, 100 * one, 4 * one, 0 * one, 0 * one)
    np.testing.assert_allclose(found, 4e-4 * 2 * width_px / np.sqrt(np.pi), rtol=1e-3)


def test_with_all_noise_the_bound_is_the_instruments() -> None:
    """Its pixels integrate, which widens a line of 3 px by 1/24/9 of itself, and samples shot and
    speckle once a pixel: 2 % of the variance together."""
    width, height = np.array([3.0, 3.0]), np.array([30.0, 200.0])
    noise = Noise(constant=1.2, per_dn=0.05, speckle=0.2)
    ones = np.ones(2)
    found = centre_variance_px2(width, height, 1.2 * ones, 0.05 * ones, 0.04 * ones)
    np.testing.assert_allclose(np.sqrt(found), centre_bound_px(width, height, noise), rtol=0.01)


def test_causes_of_light_are_known_from_others() -> None:
    power = {"key": "laser.power_mw", "when": "drift", "fixed": 1.0}
    tilt = {"key": "laser.tilt_deg", "when": "drift", "fixed": 0.1}
    board = {"key": "calibrate.camera.exposure_ms", "when": "as-built", "fixed": 5.0}
    for cause, expected in ((power, True), (tilt, False), (board, False), (NOISE, False)):
        assert depends_on_light(study_with({"one": cause})) is expected


def test_a_quarter_of_the_light_doubles_the_scatter_at_least() -> None:
    """Shot noise alone: twice; additive noise alone: four times.  The sheet's power decides both,
    the tank is dark.  Each error grows as the scatter of its place does."""
    scan = study_with({"noise": NOISE}).scan
    power = scan.tank.laser.power_mw
    dim = {"key": "laser.power_mw", "when": "drift", "fixed": power / 4}
    rig = GeometricRig(study_with({"noise": NOISE, "dim": dim}), known_of())
    known = rig.prepared
    lines = lines_at(scan, known.places)
    bounds = [
        line_bounds_px(one, known.places, lines)[0]
        for one in (scan, with_share(scan, "laser.power_mw", 0.25))
    ]
    times = bounds[1] / bounds[0]
    shown = np.isfinite(times)
    assert shown.mean() > 0.95
    assert ((times[shown] > 2) & (times[shown] < 4)).all()
    nominal, darker = (
        rig._line(states_of(rig.study, np.array([0.3, dim])))[0][:, 1] for dim in (np.nan, 0.5)
    )
    true = rig._true_line(scan, known.places)[0][:, 1]
    np.testing.assert_allclose((darker - true)[shown], (times * (nominal - true))[shown], rtol=1e-6)


@pytest.mark.slow
def test_pictures_of_less_light_scatter_as_is_said() -> None:
    """One picture's light, exposed in full and for a quarter of the time, again and again.

    With the noise that the extractor is told of, to which the bound speaks.  15 columns of 16
    exposures know a scatter to 4.7 %, a ratio of two to 6.7 %, the median of 60 places, few of
    which share columns, to 1.3 times 6.7/sqrt(60) = 1.1 %; the bound takes pixels for points
    and leaves out ground and rounding that are not normal: as much as in the other test of it,
    and three scatters.  The bar, 10 %, was set when 5 % had been seen.
    """
    scan, places = study_with({"noise": NOISE}).scan, known_of().places
    part = select(places, places.frame == places.frame[0])
    lines = lines_at(scan, part)
    layers = Tank(scan).render(float(part.position_mm[0]))
    near = [slice(entry - 7, entry + 8) for entry in part.entry]
    above = []
    for scene in (scan, with_share(scan, "camera.exposure_ms", 0.25)):
        pictures = [picture_of_layers(scene, layers, True, True, seed) for seed in range(EXPOSURES)]
        centres = centres_in(scene, pictures)
        seen = np.isfinite(centres).all(axis=0)
        variance = np.where(seen, centres.var(axis=0, ddof=1), np.nan)
        found = np.sqrt([np.nanmean(variance[here]) for here in near])
        above.append(found / line_bounds_px(scene, part, lines)[1])
    assert np.median(above[1] / above[0]) == pytest.approx(1.0, abs=0.10)


def with_share(scene: Scene, key: str, share: float) -> Scene:
    """The scene with a share of the number at a key."""
    return with_numbers(scene, {key: share * number_at(scene, key)}, "the test")
