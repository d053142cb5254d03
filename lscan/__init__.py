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

import inspect
from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from typing import TYPE_CHECKING, Any, get_type_hints

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
    """A public name, its module imported now; a function refuses arguments of another kind."""
    for home, names in _HOMES.items():
        if name in names:
            found = getattr(import_module(home), name)
            return _checked(found) if inspect.isfunction(found) else found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which raises TypeError for an argument that is not of its class of lscan.

    Arguments of other types, such as paths and arrays, are left to the function.
    """
    types = get_type_hints(function)
    kinds = {name: kind for name, kind in types.items() if _is_of_lscan(kind)}
    signature = inspect.signature(function)

    @wraps(function)
    def checked(*arguments: Any, **named: Any) -> Any:
        for name, value in signature.bind(*arguments, **named).arguments.items():
            kind = kinds.get(name, object)
            if not isinstance(value, kind):
                given = type(value).__name__
                fields = getattr(value, "__dataclass_fields__", ())
                fitting = [part for part in fields if isinstance(getattr(value, part), kind)]
                hint = f"; its .{fitting[0]} is one" if fitting else ""
                what = f"{function.__name__}: {name}: must be a {kind.__name__}, not a {given}"
                raise TypeError(what + hint)
        return function(*arguments, **named)

    return checked


def _is_of_lscan(kind: Any) -> bool:
    return inspect.isclass(kind) and kind.__module__.startswith("lscan.")


def __dir__() -> list[str]:
    return sorted(__all__)
