"""The sandwave's slopes and normals against eq. (4): the ground truth uses them too."""

import numpy as np
from hypothesis import given, strategies as st

from lscan.config.targets import Sandwave

STEP = 1e-30  # of a complex step, whose derivative has no error but rounding (Squire & Trapp 1998)

waves = st.builds(
    Sandwave,
    a_mm=st.floats(0.1, 10),
    b=st.floats(0, 0.1),
    c_per_mm=st.floats(0.01, 1),
    d_rad=st.floats(-3, 3),
    e_per_mm=st.floats(-0.1, 0.1),
)
places = st.lists(st.tuples(st.floats(0, 150), st.floats(0, 150)), min_size=1, max_size=8)


@given(waves, places)
def test_slopes_are_the_derivatives_of_the_height(
    piece: Sandwave, xy: list[tuple[float, float]]
) -> None:
    x, y = np.array(xy, dtype=complex).T
    by_x = piece.height_mm(x + 1j * STEP, y).imag / STEP
    by_y = piece.height_mm(x, y + 1j * STEP).imag / STEP
    # A phase of up to 153 rad is rounded by 1.4e-14, and the sums of a few terms, each below the
    # swing of 25 mm times 1 per mm, no worse.
    np.testing.assert_allclose(
        piece.slopes(x.real, y.real), np.column_stack([by_x, by_y]), rtol=0, atol=25 * 1e-13
    )


@given(waves, places)
def test_normals_are_upright_units_square_to_the_surface(
    piece: Sandwave, xy: list[tuple[float, float]]
) -> None:
    x, y = np.array(xy).T
    normals, slopes = piece.normals(x, y), piece.slopes(x, y)
    assert (normals[:, 2] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(normals[:, :2] + normals[:, 2:] * slopes, 0.0, atol=1e-14)
