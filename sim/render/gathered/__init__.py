"""Light of higher orders without random noise: tables of how beams spread, and sums over them."""

from sim.render.backend import load_mitsuba

load_mitsuba()  # the variant: Mitsuba's classes depend on it
