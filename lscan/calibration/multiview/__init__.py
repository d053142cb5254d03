"""The metric route: camera and laser sheet from pictures of a board in several poses.

For rigs whose board cannot be made coplanar with the sheet.  ``viewsfile`` reads the pictures,
``start`` and ``bundle`` find the camera and the boards' poses, ``lines``, ``equations`` and
``sheet`` the laser's plane from the line seen on the boards, ``solve`` goes through all of it
and says what became of each view, ``planemap`` is the map that comes of it, ``file`` keeps it.
"""

from lscan.calibration.multiview.file import load_metric, save_metric
from lscan.calibration.multiview.planemap import Metric
from lscan.calibration.multiview.solve import MetricCalibration, ViewReport, calibrate_metric
from lscan.calibration.multiview.views import LinePoints, View
from lscan.calibration.multiview.viewsfile import ViewsFile, load_views, read_views

__all__ = [
    "LinePoints",
    "Metric",
    "MetricCalibration",
    "View",
    "ViewReport",
    "ViewsFile",
    "calibrate_metric",
    "load_metric",
    "load_views",
    "read_views",
    "save_metric",
]
