"""The webcam's sensor: from radiance to electrons to digital numbers (EMVA 1288, linear)."""

from sim.sensor.radiometry import photons_per_radiance
from sim.sensor.webcam import Webcam, digitise

__all__ = ["Webcam", "digitise", "photons_per_radiance"]
