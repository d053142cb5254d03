"""Alignment of a surface with its nominal target, and the features it rests on."""
