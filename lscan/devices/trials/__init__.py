"""Trials of a camera and of a track: what they can do, measured."""
