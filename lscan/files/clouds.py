"""Clouds of points with their quality, as other programs read them: PLY, LAS and LAZ."""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np

from lscan.errors import InputError
from lscan.files.rasters import fitting_step
from lscan.records import Floats, Ints
from lscan.version import __version__


@dataclass(frozen=True)
class Cloud:
    """Points that have a value.

    Attributes
    ----------
    xyz_mm : (P, 3) array, mm
    sigma_mm : mapping, of (P,) arrays, mm, standard uncertainties by the names of the axes; that
        of y is left out where it is not known
    status : (P,) array, of Status
    brightness : (P,) array or None, DN, of the line at each point; NaN where it is not known
    frame : str, what x, y and z are of
    """

    xyz_mm: Floats
    sigma_mm: Mapping[str, Floats]
    status: Ints
    brightness: Floats | None
    frame: str


def cloud_writer(path: Path) -> Callable[[Cloud], bytes]:
    """What makes the content of a file of its suffix from a cloud.

    Parameters
    ----------
    path : Path, of a file ``.ply``, ``.las`` or ``.laz``

    Raises
    ------
    InputError
        For another suffix, or where the packages that write LAS are not installed.
    """
    las = {
        ".las": partial(las_bytes, compressed=False),
        ".laz": partial(las_bytes, compressed=True),
    }
    kinds: dict[str, Callable[[Cloud], bytes]] = {".ply": ply_bytes, **las}
    kind = path.suffix.lower()
    if kind not in kinds:
        allowed = ", ".join(kinds)
        raise InputError("no such kind of cloud", where=path, value=kind, allowed=allowed)
    if kind in las:
        try:
            _laspy()
        except ModuleNotFoundError as error:
            what = f"needs the package {error.name}: pip install 'lscan[clouds]'"
            raise InputError(what, where=path) from error
    return kinds[kind]


def ply_bytes(cloud: Cloud) -> bytes:
    """A binary PLY file, in mm in single precision.

    Each vertex has ``sigma_mm``, the standard uncertainty of its z, the same again as ``quality``,
    ``status`` and, where it is known, ``intensity``, the line's brightness in DN.

    Parameters
    ----------
    cloud : Cloud

    References
    ----------
    G. Turk, The PLY Polygon File Format, 1994.  MeshLab reads ``quality``, as VCGlib's
    import_ply.h calls it, and no name of ours.
    """
    columns = dict(zip("xyz", cloud.xyz_mm.T, strict=True))
    columns |= {"sigma_mm": cloud.sigma_mm["z"], "quality": cloud.sigma_mm["z"]}
    if cloud.brightness is not None:
        columns["intensity"] = cloud.brightness
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment lscan {__version__}, {cloud.frame} frame, mm",
        f"element vertex {len(cloud.status)}",
        *(f"property float {name}" for name in columns),
        "property uchar status",
        "end_header\n",
    ]
    vertices = np.empty(
        len(cloud.status), [*((name, "<f4") for name in columns), ("status", np.uint8)]
    )
    for name, values in (*columns.items(), ("status", cloud.status)):
        vertices[name] = values
    return "\n".join(head).encode() + vertices.tobytes()


_STEP = -7  # of coordinates in LAS, a power of ten of m: 0.1 um reach 214 m to either side
_BRIGHTEST = 2**16 - 1


def las_bytes(cloud: Cloud, *, compressed: bool) -> bytes:
    """A LAS 1.4 file of point format 6, in metres, or a LAZ file of the same.

    Each point has ``sigma_x``, ``sigma_z`` and, where it is known, ``sigma_y``, m, and ``status``
    as extra bytes, and the line's brightness in DN as its intensity, 0 where it is not known.  The
    coordinate system is a local one, named after the frame.  The file has no date: the same cloud
    gives the same bytes.

    Parameters
    ----------
    cloud : Cloud
    compressed : bool, whether as LAZ

    References
    ----------
    ASPRS, LAS Specification 1.4-R15, 2019.  OGC 01-009, 7.2, of LOCAL_CS.
    """
    laspy = _laspy()
    xyz = cloud.xyz_mm / 1000
    middle = np.rint((xyz.min(axis=0) + xyz.max(axis=0)) / 2) + 0.0  # no -0.0
    step = fitting_step(float(np.abs(xyz - middle).max()), _STEP)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.offsets, header.scales = middle, np.full(3, step)
    header.system_identifier = f"lscan, {cloud.frame} frame"
    header.generating_software = f"lscan {__version__}"
    header.global_encoding.wkt = True
    local = f'LOCAL_CS["{cloud.frame} frame",LOCAL_DATUM["scanner",0],UNIT["metre",1]]'
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(local))
    quality = {
        f"sigma_{axis}": ((values / 1000).astype(np.float32), f"standard uncertainty of {axis}, m")
        for axis, values in cloud.sigma_mm.items()
    }
    quality["status"] = (cloud.status.astype(np.uint8), "0 ok, 2 clipped peak")
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name, values.dtype, text)
            for name, (values, text) in quality.items()
        ]
    )
    points = laspy.LasData(header)
    points.X, points.Y, points.Z = np.rint((xyz - middle) / step).astype(np.int32).T
    points.return_number[:] = points.number_of_returns[:] = 1
    for name, (values, _) in quality.items():
        points[name] = values
    if cloud.brightness is not None:
        grey = np.nan_to_num(cloud.brightness)
        points.intensity = np.clip(np.rint(grey), 0, _BRIGHTEST).astype(np.uint16)
    file = io.BytesIO()
    points.write(file, do_compress=compressed)
    content = bytearray(file.getvalue())
    content[90:94] = bytes(4)  # day and year of the file, which laspy takes from the clock
    return bytes(content)


def _laspy() -> ModuleType:
    """The packages that write LAS and LAZ."""
    import laspy
    import lazrs  # noqa: F401 - by which laspy compresses

    return laspy
