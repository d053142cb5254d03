"""Mitsuba plugins: camera, laser sheet, integrator.

Importing this package chooses Mitsuba's variant, which its classes depend on.
"""

from sim.render.backend import load_mitsuba

load_mitsuba()
