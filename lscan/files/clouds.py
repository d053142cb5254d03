"""Clouds of points with their quality, as other programs read them: PLY, E57, LAS and LAZ."""

import hashlib
import io
import struct
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.files.rasters import fitting_step
from lscan.records import Bytes, Floats, Ints
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
    path : Path, of a file ``.ply``, ``.e57``, ``.las`` or ``.laz``

    Raises
    ------
    InputError
        For another suffix, or where the packages that write LAS are not installed.
    """
    las = {
        ".las": partial(las_bytes, compressed=False),
        ".laz": partial(las_bytes, compressed=True),
    }
    kinds: dict[str, Callable[[Cloud], bytes]] = {".ply": ply_bytes, ".e57": e57_bytes, **las}
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


# E57: pages of 1024 bytes with a checksum each; in them a head, packets of points, and XML that
# says what these are.


_PAGE = 1020  # bytes of a page that are not its checksum
_HEAD, _SECTION = struct.Struct("<8sIIQQQQ"), struct.Struct("<B7xQQQ")
_E57_TYPES = {
    "<f8": 'type="Float"',
    "<f4": 'type="Float" precision="single"',
    "|u1": 'type="Integer" minimum="0" maximum="255"',
}
_E57 = """<?xml version="1.0" encoding="UTF-8"?>
<e57Root type="Structure" xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0"
 xmlns:lscan="urn:lscan:e57">
<formatName type="String">ASTM E57 3D Imaging Data File</formatName>
<guid type="String">{{{file}}}</guid>
<versionMajor type="Integer">1</versionMajor>
<versionMinor type="Integer">0</versionMinor>
<e57LibraryVersion type="String">lscan {version}</e57LibraryVersion>
<coordinateMetadata type="String"/>
<data3D type="Vector" allowHeterogeneousChildren="1">
<vectorChild type="Structure">
<guid type="String">{{{scan}}}</guid>
<name type="String">{frame} frame</name>
<cartesianBounds type="Structure">
{bounds}
</cartesianBounds>
{limits}
<points type="CompressedVector" fileOffset="{offset}" recordCount="{count}">
<prototype type="Structure">
{prototype}
</prototype>
<codecs type="Vector" allowHeterogeneousChildren="1"/>
</points>
</vectorChild>
</data3D>
<images2D type="Vector" allowHeterogeneousChildren="1"/>
</e57Root>
"""
_LIMITS = """<intensityLimits type="Structure">
<intensityMinimum type="Float">{low!r}</intensityMinimum>
<intensityMaximum type="Float">{high!r}</intensityMaximum>
</intensityLimits>"""


def e57_bytes(cloud: Cloud) -> bytes:
    """An E57 file of one scan, in metres in double precision.

    Each point has, as fields of an extension, ``lscan:sigmaX``, ``lscan:sigmaZ`` and, where it is
    known, ``lscan:sigmaY``, m in single precision, and ``lscan:status``; the line's brightness in
    DN is its intensity, 0 where it is not known.  The identifiers are made from the points: the
    same cloud gives the same bytes.

    Parameters
    ----------
    cloud : Cloud

    References
    ----------
    ASTM E2807-11.
    """
    xyz = cloud.xyz_mm / 1000
    fields: dict[str, NDArray[Any]] = {
        f"cartesian{axis}": values.astype("<f8") for axis, values in zip("XYZ", xyz.T, strict=True)
    }
    limits = ""
    if cloud.brightness is not None:
        fields["intensity"] = grey = np.nan_to_num(cloud.brightness).astype("<f4")
        limits = _LIMITS.format(low=float(grey.min()), high=float(grey.max()))
    for axis, values in cloud.sigma_mm.items():
        fields[f"lscan:sigma{axis.upper()}"] = (values / 1000).astype("<f4")
    fields["lscan:status"] = cloud.status.astype("u1")
    packets = b"".join(_packets(fields))
    bounds = (
        f'<{axis}{end} type="Float">{value!r}</{axis}{end}>'
        for end, corner in (("Minimum", xyz.min(axis=0)), ("Maximum", xyz.max(axis=0)))
        for axis, value in zip("xyz", corner.tolist(), strict=True)
    )
    points = hashlib.sha256(packets).hexdigest()
    file, scan = (uuid.uuid5(uuid.NAMESPACE_OID, points + of) for of in ("file", "scan"))
    xml = _E57.format(
        file=file,
        scan=scan,
        version=__version__,
        frame=cloud.frame,
        bounds="\n".join(bounds),
        limits=limits,
        offset=_HEAD.size,
        count=len(xyz),
        prototype="\n".join(f"<{name} {_E57_TYPES[v.dtype.str]}/>" for name, v in fields.items()),
    ).encode()
    first = _HEAD.size + _SECTION.size
    section = _SECTION.pack(1, _SECTION.size + len(packets), first, 0)  # no index of the packets
    end = first + len(packets)
    size = -(-(end + len(xml)) // _PAGE) * (_PAGE + 4)
    head = _HEAD.pack(b"ASTM-E57", 1, 0, size, end + 4 * (end // _PAGE), len(xml), _PAGE + 4)
    return _paged(head + section + packets + xml)


def _packets(fields: Mapping[str, NDArray[Any]]) -> Iterator[bytes]:
    """Packets of points, field after field, of no more than 64 KiB each."""
    count = (2**16 - 64) // sum(values.itemsize for values in fields.values())
    for begin in range(0, len(fields["cartesianX"]), count):
        streams = [values[begin : begin + count].tobytes() for values in fields.values()]
        lengths = struct.pack(f"<H{len(streams)}H", len(streams), *map(len, streams))
        body = b"".join((lengths, *streams))
        body += bytes(-len(body) % 4)
        yield struct.pack("<BBH", 1, 0, 4 + len(body) - 1) + body


def _paged(content: bytes) -> bytes:
    """The content in pages, each with its CRC-32C (Castagnoli), the highest byte first."""
    content += bytes(-len(content) % _PAGE)
    pages: Bytes = np.frombuffer(content, np.uint8).reshape(-1, _PAGE)
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ np.uint32(0x82F63B78), table >> 1)
    sums = np.full(len(pages), 2**32 - 1, np.uint32)
    for place in np.ascontiguousarray(pages.T):
        sums = table[(sums ^ place) & 0xFF] ^ sums >> 8
    return np.hstack([pages, (~sums).astype(">u4").view(np.uint8).reshape(-1, 4)]).tobytes()


# LAS and LAZ.


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
