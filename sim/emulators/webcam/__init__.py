"""The tank as a webcam on a network."""
