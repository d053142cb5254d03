"""Roughness of the seabed: spectrum, power law, ripples, moments, and where the instrument ends."""

from lscan.files.publicnames import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __file__)
