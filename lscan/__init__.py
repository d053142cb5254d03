"""lscan: calibration, stripe extraction, reconstruction and measurement for laser line scanners.

What is named here is the public interface; each name is loaded when it is first asked for.  From
a scan of the calibration board and one of an object to a surface:

    import lscan

    board = lscan.scan(lscan.load_rig("board.toml"), "runs/board")
    calibration = lscan.calibrate_run(board)
    run = lscan.scan(lscan.load_rig("rig.toml"), "runs/object")
    surface = lscan.reconstruct(run, calibration.plane_map).surface
    lscan.save_surface("surface.nc", surface)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lscan.version import __version__

if TYPE_CHECKING:
    from lscan.acquisition.run import Run, open_run
    from lscan.acquisition.scan import scan
    from lscan.board import read_board
    from lscan.calibration.api import PlaneMap
    from lscan.calibration.loading import load_plane_map
    from lscan.calibration.solve import (
        Calibration,
        calibrate,
        load_calibration,
        save_calibration,
    )
    from lscan.config.rig import StripeSection
    from lscan.config.rigfile import RigFile, load_rig
    from lscan.devices.api import Camera, Track
    from lscan.errors import LscanError
    from lscan.measure import diameters, distances
    from lscan.measurement import measure_groove, measure_run, measure_sandwave
    from lscan.pipeline import calibrate_run, mean_picture, reconstruct
    from lscan.records import BoardReading, Frame, Profile, Status, Stripe, Surface
    from lscan.stripe import extract_stripe
    from lscan.stripe.api import Extractor
    from lscan.surface import load_surface, save_surface

__all__ = [
    "BoardReading",
    "Calibration",
    "Camera",
    "Extractor",
    "Frame",
    "LscanError",
    "PlaneMap",
    "Profile",
    "RigFile",
    "Run",
    "Status",
    "Stripe",
    "StripeSection",
    "Surface",
    "Track",
    "__version__",
    "calibrate",
    "calibrate_run",
    "diameters",
    "distances",
    "extract_stripe",
    "load_calibration",
    "load_plane_map",
    "load_rig",
    "load_surface",
    "mean_picture",
    "measure_groove",
    "measure_run",
    "measure_sandwave",
    "open_run",
    "read_board",
    "reconstruct",
    "save_calibration",
    "save_surface",
    "scan",
]

_HOMES = {
    "lscan.acquisition.run": ("Run", "open_run"),
    "lscan.acquisition.scan": ("scan",),
    "lscan.board": ("read_board",),
    "lscan.calibration.api": ("PlaneMap",),
    "lscan.calibration.loading": ("load_plane_map",),
    "lscan.calibration.solve": (
        "Calibration",
        "calibrate",
        "load_calibration",
        "save_calibration",
    ),
    "lscan.config.rig": ("StripeSection",),
    "lscan.config.rigfile": ("RigFile", "load_rig"),
    "lscan.devices.api": ("Camera", "Track"),
    "lscan.errors": ("LscanError",),
    "lscan.measure": ("diameters", "distances"),
    "lscan.measurement": ("measure_groove", "measure_run", "measure_sandwave"),
    "lscan.pipeline": ("calibrate_run", "mean_picture", "reconstruct"),
    "lscan.records": ("BoardReading", "Frame", "Profile", "Status", "Stripe", "Surface"),
    "lscan.stripe": ("extract_stripe",),
    "lscan.stripe.api": ("Extractor",),
    "lscan.surface": ("load_surface", "save_surface"),
}
"""The public names by the module that defines them, as the imports above say to type checkers."""


def __getattr__(name: str) -> Any:
    """A public name, its module imported now."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
