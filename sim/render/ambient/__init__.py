"""Ambient light on surfaces: worked out once a tank, without random noise."""

from sim.render.backend import load_mitsuba

load_mitsuba()  # the variant: Mitsuba's classes depend on it
