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
RATIONAL = LENS | {
    "k4": st.floats(-0.1, 0.3),
    "k5": st.floats(-0.05, 0.1),
    "k6": st.floats(-0.02, 0.02),
}
FISHEYE = {
    "focal_px": st.floats(200, 1500),
    "centre_px": LENS["centre_px"],
    "k1": st.floats(-0.1, 0.1),
    "k2": st.floats(-0.03, 0.03),
    "k3": st.floats(-0.01, 0.01),
    "k4": st.floats(-0.002, 0.002),
}
FLAT_PORT = {
    "gap_mm": st.floats(1, 60),
    "thickness_mm": st.floats(0.5, 30),
    "glass_index": st.floats(1.3, 1.9),
    "tilt_x_deg": st.floats(-15, 15),
    "tilt_y_deg": st.floats(-15, 15),
}
