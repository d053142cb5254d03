"""The sensor plugin with a film finer than the sensor's pixels (sim.render.fineness)."""

import mitsuba as mi

from sim.render.plugins.camera import RefractiveCamera


class FineCamera(RefractiveCamera):
    """A camera whose film cuts each pixel into parts; ``configure`` it with the finer lens.

    fineness: parts of a pixel's side, a property of the plugin, 1 if it is not given.
    """

    def __init__(self, props: mi.Properties) -> None:
        """Read the fineness."""
        super().__init__(props)
        self.fineness = int(props.get("fineness", 1))

    def _time(self, place: mi.Point2f, shutter_sample: mi.Float) -> mi.Float:
        """As of a coarse film: all parts of a pixel are read with the first of its rows."""
        rows_late = mi.Float(mi.UInt32(place.y) % self.fineness) / self.film().size().y
        return super()._time(place, shutter_sample) - rows_late * self.readout


mi.register_sensor("fine_camera", FineCamera)
