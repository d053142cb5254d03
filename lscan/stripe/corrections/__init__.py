"""Corrections of an extracted stripe: blur, smoothing, ends of the line."""
