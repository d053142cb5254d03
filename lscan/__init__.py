"""lscan: calibration, stripe extraction, reconstruction and measurement for laser line scanners."""

__version__ = "0.1.0"
