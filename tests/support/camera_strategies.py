"""Strategies of the fields of lenses and flat ports, for the truth's records and the instrument's.

Both name the fields alike: ``st.builds(Lens, **LENS)``, ``st.builds(CameraModel, **LENS, ...)``.
"""

from hypothesis import strategies as st

LENS = {
    "focal_px": st.floats(300, 1500),
    "centre_px": st.tuples(st.floats(200, 400), st.floats(150, 300)),
    "k1": st.floats(-0.25, 0.25),
    "k2": st.floats(-0.05, 0.1),
    "k3": st.floats(-0.02, 0.02),
    "p1": st.floats(-2e-3, 2e-3),
    "p2": st.floats(-2e-3, 2e-3),
}
FLAT_PORT = {
    "gap_mm": st.floats(1, 60),
    "thickness_mm": st.floats(0.5, 30),
    "glass_index": st.floats(1.3, 1.9),
    "tilt_x_deg": st.floats(-15, 15),
    "tilt_y_deg": st.floats(-15, 15),
}
