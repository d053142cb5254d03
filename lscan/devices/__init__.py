"""Cameras and tracks: the protocols (api.py) and the drivers that come with lscan."""
