"""Corrections of an extracted stripe: blur and smoothing."""
