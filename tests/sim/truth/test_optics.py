"""The instrument's ray geometry against the tank's truth, which shares no code with it."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lscan import camera as optics
from sim.scene import FlatPort, Lens, Pose
from sim.truth.projection import Camera, image, rays_to

LENS = st.builds(
    Lens,
    focal_px=st.floats(500, 1500),
    centre_px=st.tuples(st.floats(280, 360), st.floats(200, 280)),
    k1=st.floats(-0.3, 0.2),
    k2=st.floats(-0.05, 0.1),
    k3=st.floats(-0.02, 0.02),
    p1=st.floats(-2e-3, 2e-3),
    p2=st.floats(-2e-3, 2e-3),
)
PORT = st.builds(
    FlatPort,
    gap_mm=st.floats(1, 60),
    thickness_mm=st.floats(0.5, 30),
    glass_index=st.floats(1.3, 1.9),
    tilt_x_deg=st.floats(-15, 15),
    tilt_y_deg=st.floats(-15, 15),
)


@settings(max_examples=60)
@given(lens=LENS, port=PORT, water=st.floats(1.33, 1.345), seed=st.integers(0, 1000))
def test_projection_agrees(lens: Lens, port: FlatPort, water: float, seed: int) -> None:
    """To 1e-6 px, a thousandth of the least uncertainty any mark has."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(200.0, 3000.0, 60)
    points = np.column_stack([*(rng.uniform(-0.35, 0.35, (2, 60)) * z), z])
    truth = Camera(Pose(np.eye(3), np.zeros(3)), lens, port, water)
    expected = image(truth, rays_to(truth, points).direction)
    window = optics.FlatPort(
        port.gap_mm,
        port.thickness_mm,
        float(port.glass_index),
        water,
        port.tilt_x_deg,
        port.tilt_y_deg,
    )
    camera = optics.Camera(
        lens.focal_px, lens.centre_px, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, window
    )
    np.testing.assert_allclose(optics.project(camera, points), expected, rtol=0, atol=1e-6)
