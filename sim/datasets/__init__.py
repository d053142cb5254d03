"""Labelled pictures, views of a board, and renders with their truth, as files."""
