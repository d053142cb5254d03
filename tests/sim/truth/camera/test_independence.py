"""The truth's camera against the instrument's: two ways to the same pixel, without shared code.

The truth shortens optical paths (Fermat) and brackets the fold of the distortion; the instrument
solves Snell's equation for the tangent in air and takes the roots of a polynomial.
"""

import numpy as np
from camera_strategies import FISHEYE, FLAT_PORT, LENS, RATIONAL
from drawn_examples import examples
from hypothesis import assume, given, strategies as st
from numpy.polynomial import Polynomial

from lscan import camera as instrument
from lscan.camera.optics import fold_radius as instruments_fold
from lscan.config.rig import BENDS
from sim.scene import Lens, PlanePort, Pose
from sim.truth.camera import TrueCamera, fold_radius, image, rays_to

MANY = examples(60)
LENSES = (
    st.builds(Lens, **LENS)
    | st.builds(Lens, model=st.just("rational"), **RATIONAL)
    | st.builds(Lens, model=st.just("fisheye"), **FISHEYE)
)
PORTS = st.builds(PlanePort, **FLAT_PORT)


def instruments(lens: Lens, port: PlanePort, water_index: float) -> instrument.CameraModel:
    """The same camera as the instrument describes one."""
    window = instrument.PortModel(
        port.gap_mm,
        port.thickness_mm,
        float(port.glass_index),
        water_index,
        port.tilt_x_deg,
        port.tilt_y_deg,
    )
    bent = {name: getattr(lens, name) for name in BENDS}
    fisheye = lens.model == "fisheye"
    return instrument.CameraModel(
        lens.focal_px, lens.centre_px, **bent, fisheye=fisheye, port=window
    )


@MANY
@given(lens=LENSES, port=PORTS, water=st.floats(1.33, 1.345), seed=st.integers(0, 1000))
def test_both_see_a_point_in_the_same_pixel(
    lens: Lens, port: PlanePort, water: float, seed: int
) -> None:
    """To 1e-9 px.

    A place 1 m beside the normal is known to 2e-13 mm in float64; over 1 mm of air, the least
    here, and 1500 px of focal length that is 3e-10 px, which the distortion at most doubles.
    """
    rng = np.random.default_rng(seed)
    z = rng.uniform(200.0, 3000.0, 60)
    points = np.column_stack([*(rng.uniform(-0.35, 0.35, (2, 60)) * z), z])
    truth = TrueCamera(Pose(np.eye(3), np.zeros(3)), lens, port, water)
    expected = image(truth, rays_to(truth, points).direction)
    found = instrument.project(instruments(lens, port, water), points)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@MANY
@given(lens=LENSES)
def test_both_find_the_same_fold_of_the_distortion(lens: Lens) -> None:
    """To 1e-9 of the radius, but next to a double root, which float64 cannot distinguish from none.

    Coefficients known to 1e-16 move a root by 1e-16 over its distance from the next; 1e-5 apart
    they are sought only to 1e-11.
    """
    above, below = Polynomial([1, lens.k1, lens.k2, lens.k3]), Polynomial([1])
    if lens.model == "fisheye":
        above = Polynomial([*above.coef, lens.k4])
    if lens.model == "rational":
        below = Polynomial([1, lens.k4, lens.k5, lens.k6])
    q = Polynomial([0, 1])
    growth = above * below + 2 * q * (above.deriv() * below - above * below.deriv())
    inverse = [Polynomial(each.coef[::-1]) for each in (growth, below)]  # of 1 / q
    roots = np.concatenate([each.roots() for each in inverse])
    apart = np.abs(roots[:, np.newaxis] - roots)[np.triu_indices(len(roots), 1)]
    assume(apart.min(initial=np.inf) > 1e-5)
    found, expected = fold_radius(lens), instruments_fold(instruments(lens, PlanePort(), 1.33))
    if lens.model == "fisheye":  # an angle, of which those up to a right one have a tangent
        found = np.tan(found) if found < np.pi / 2 else np.inf
    # A tangent of 1e6 lies a microradian off a right angle: a fold beyond is none.
    if min(found, expected) < 1e6:
        assert abs(found - expected) <= 1e-9 * expected
