"""Rasters as programs for maps, images and roughness read them: GeoTIFF, ESRI ASCII, X3P, SDF."""

import hashlib
import io
import struct
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil, log10
from xml.sax.saxutils import escape

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats
from lscan.version import __version__


@dataclass(frozen=True)
class Raster:
    """Bands of numbers on square cells.

    Attributes
    ----------
    west_mm, south_mm : float, mm, x and y of the outer corner of the first cell
    cell_mm : float, mm, side of a cell
    bands : mapping, of (R, C) arrays by what they are; rows along y upwards, columns along x; NaN
        where there is no value
    frame : str, what x and y are of
    """

    west_mm: float
    south_mm: float
    cell_mm: float
    bands: Mapping[str, Floats]
    frame: str

    @property
    def shape(self) -> tuple[int, int]:
        """(R, C) of the cells."""
        rows, columns = next(iter(self.bands.values())).shape
        return rows, columns


# GeoTIFF.


_SHORT, _LONG, _DOUBLE, _TEXT = 3, 4, 12, 2
_FORMATS = {_SHORT: "H", _LONG: "I", _DOUBLE: "d"}
_USER_DEFINED = 32767  # as OGC 19-008r4 calls what no register knows


def geotiff_bytes(raster: Raster) -> bytes:
    """A GeoTIFF file, one band after the other in double precision, the highest y first.

    x and y are those of the raster in mm, of no place on the Earth: GDAL and what builds on it find
    a local system.  What a band is, and that NaN is no value, stands in GDAL's own tags.

    Parameters
    ----------
    raster : Raster

    References
    ----------
    TIFF, Adobe, revision 6.0.  GeoTIFF: OGC 19-008r4.
    """
    rows, columns = raster.shape
    count, size = len(raster.bands), rows * columns * 8
    names = "".join(
        f'<Item name="DESCRIPTION" sample="{number}" role="description">{escape(name)}</Item>'
        for number, name in enumerate(raster.bands)
    )
    north_mm = raster.south_mm + rows * raster.cell_mm
    citation = f"{raster.frame}, mm|"
    keys = [
        (1024, 0, 1, _USER_DEFINED),  # the model: neither geographic nor projected
        (1025, 0, 1, 1),  # a pixel is an area
        (1026, 34737, len(citation), 0),
    ]
    directory = [1, 1, 1, len(keys), *(part for key in keys for part in key)]
    tags: list[tuple[int, int, Sequence[float] | str]] = [
        (256, _LONG, [columns]),
        (257, _LONG, [rows]),
        (258, _SHORT, [64] * count),
        (259, _SHORT, [1]),  # not compressed
        (262, _SHORT, [1]),  # 0 is black
        (273, _LONG, [0] * count),  # where bands begin, filled in below
        (277, _SHORT, [count]),
        (278, _LONG, [rows]),
        (279, _LONG, [size] * count),
        (284, _SHORT, [2]),  # one band after the other
        (305, _TEXT, f"lscan {__version__}"),
        (338, _SHORT, [0] * (count - 1)),
        (339, _SHORT, [3] * count),  # floating point
        (33550, _DOUBLE, [raster.cell_mm, raster.cell_mm, 0.0]),
        (33922, _DOUBLE, [0.0, 0.0, 0.0, raster.west_mm, north_mm, 0.0]),
        (34735, _SHORT, directory),
        (34737, _TEXT, citation),
        (42112, _TEXT, f"<GDALMetadata>{names}</GDALMetadata>"),
        (42113, _TEXT, "nan"),
    ]
    tags = [tag for tag in tags if len(tag[2])]
    begin = len(_header(tags))
    offsets = [begin + number * size for number in range(count)]
    tags = [(tag, kind, offsets if tag == 273 else values) for tag, kind, values in tags]
    bands = (np.ascontiguousarray(band[::-1], "<f8").tobytes() for band in raster.bands.values())
    return b"".join((_header(tags), *bands))


def _header(tags: Sequence[tuple[int, int, Sequence[float] | str]]) -> bytes:
    """All that stands before the bands: eight bytes, the directory, what is too long for it."""
    entries, beyond = b"", b""
    begin = 8 + 2 + 12 * len(tags) + 4
    for tag, kind, values in tags:
        if isinstance(values, str):
            data = values.encode("ascii", "xmlcharrefreplace") + b"\0"
            number = len(data)
        else:
            data = struct.pack(f"<{len(values)}{_FORMATS[kind]}", *values)
            number = len(values)
        if len(data) > 4:
            data += bytes(-len(data) % 8)
            place = struct.pack("<I", begin + len(beyond))
            beyond += data
        else:
            place = data.ljust(4, b"\0")
        entries += struct.pack("<HHI", tag, kind, number) + place
    beyond += bytes(-(begin + len(beyond)) % 8)
    return struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries + bytes(4) + beyond


# ESRI ASCII.


NO_VALUE = -9999


def esri_ascii_bytes(raster: Raster, band: str) -> bytes:
    """One band as an ESRI ASCII grid, the highest y first, to a nanometre.

    Parameters
    ----------
    raster : Raster
    band : str, one of its bands

    References
    ----------
    Esri ASCII raster format, ArcGIS documentation.
    """
    rows, columns = raster.shape
    head = (
        f"ncols {columns}\nnrows {rows}\nxllcorner {raster.west_mm!r}\n"
        f"yllcorner {raster.south_mm!r}\ncellsize {raster.cell_mm!r}\nNODATA_value {NO_VALUE}\n"
    )
    lines = (
        " ".join(f"{value:.6f}" if value == value else str(NO_VALUE) for value in row)
        for row in raster.bands[band][::-1].tolist()
    )
    return (head + "\n".join(lines) + "\n").encode()


# X3P and SDF, of roughness: lengths in metres, y upwards, no colours and no more than one band.


_MAIN = """<?xml version="1.0" encoding="UTF-8" standalone="no"?>
<p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2">
  <Record1>
    <Revision>ISO5436 - 2000</Revision>
    <FeatureType>SUR</FeatureType>
    <Axes>
      <CX>
        <AxisType>I</AxisType><DataType>D</DataType>
        <Increment>{cell!r}</Increment><Offset>{x!r}</Offset>
      </CX>
      <CY>
        <AxisType>I</AxisType><DataType>D</DataType>
        <Increment>{cell!r}</Increment><Offset>{y!r}</Offset>
      </CY>
      <CZ>
        <AxisType>A</AxisType><DataType>D</DataType>
        <Increment>1</Increment><Offset>0</Offset>
      </CZ>
    </Axes>
  </Record1>
  <Record3>
    <MatrixDimension>
      <SizeX>{columns}</SizeX><SizeY>{rows}</SizeY><SizeZ>1</SizeZ>
    </MatrixDimension>
    <DataLink>
      <PointDataLink>bindata/data.bin</PointDataLink>
      <MD5ChecksumPointData>{md5}</MD5ChecksumPointData>
    </DataLink>
  </Record3>
  <Record4>
    <ChecksumFile>md5checksum.hex</ChecksumFile>
  </Record4>
</p:ISO5436_2>
"""


def x3p_bytes(raster: Raster, band: str) -> bytes:
    """One band as an X3P file, in metres in double precision, NaN where there is no value.

    The offsets of its axes are x and y of the first cell's middle.  Record 2, which says who
    measured when, is left out: it asks for a date, and the same raster gives the same bytes.

    Parameters
    ----------
    raster : Raster
    band : str, one of its bands, mm

    References
    ----------
    ISO 25178-72:2017, which took the format over from ISO 5436-2; its schema and samples are those
    of the openGPS project.
    """
    rows, columns = raster.shape
    heights = np.ascontiguousarray(raster.bands[band] / 1000, "<f8").tobytes()
    half_mm = raster.cell_mm / 2
    main = _MAIN.format(
        cell=raster.cell_mm / 1000,
        x=(raster.west_mm + half_mm) / 1000,
        y=(raster.south_mm + half_mm) / 1000,
        columns=columns,
        rows=rows,
        md5=_md5(heights),
    ).encode()
    members = {
        "main.xml": main,
        "bindata/data.bin": heights,
        "md5checksum.hex": f"{_md5(main)} *main.xml\n".encode(),
    }
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name, content in members.items():
                entry = zipfile.ZipInfo(name)  # of 1980: the same bytes whenever it is written
                entry.external_attr = 0o644 << 16  # unzipped, it can be read
                archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
        return file.getvalue()


def _md5(content: bytes) -> str:
    return hashlib.md5(content, usedforsecurity=False).hexdigest()


_MOST_OF_SDF = 2**16 - 1
_MISSING = -(2**31)
_NANOMETRE = -6  # as a power of ten of mm


def sdf_bytes(raster: Raster, band: str) -> bytes:
    """One band as a binary SDF file: whole nanometres in 32 bits, the least number where no value.

    Programs disagree on what a missing point is among real numbers and in text, and agree among
    whole ones.  Beyond 2 m the steps are ten times as large, and so on.  The format has no place
    for where the raster begins.  A date of zeros is one that is not known.

    Parameters
    ----------
    raster : Raster
    band : str, one of its bands, mm

    Raises
    ------
    InputError
        The raster has more rows or columns than the format counts.

    References
    ----------
    ISO 25178-71:2017, version 1.0 of the file.
    """
    rows, columns = raster.shape
    if max(rows, columns) > _MOST_OF_SDF:
        what, value = "has too many cells along a side for SDF", f"{columns} x {rows}"
        raise InputError(what, where="grid", value=value, allowed=f"at most {_MOST_OF_SDF}")
    heights = raster.bands[band]
    known = np.isfinite(heights)
    step_mm = fitting_step(float(np.abs(heights[known]).max(initial=0.0)), _NANOMETRE)
    steps = np.full(raster.shape, _MISSING, "<i4")
    steps[known] = np.rint(heights[known] / step_mm)
    head = struct.pack(
        "<8s10s12s12sHHddddBBB",
        b"bISO-1.0",
        b"lscan".ljust(10),
        b"0" * 12,  # made
        b"0" * 12,  # changed
        columns,
        rows,
        raster.cell_mm / 1000,
        raster.cell_mm / 1000,
        step_mm / 1000,
        -1.0,  # the instrument's resolution: not known
        0,  # not compressed
        6,  # 32 bits with a sign
        0,  # no checksum
    )
    return head + steps.tobytes()


def fitting_step(most: float, least_power: int) -> float:
    """The least power of ten, of those from one on, of which 32 bits with a sign count to ``most``.

    Parameters
    ----------
    most : float, largest size of what is stored
    least_power : int, exponent of the least step, in the same unit

    Examples
    --------
    >>> fitting_step(2000.0, -6), fitting_step(3000.0, -6)
    (1e-06, 1e-05)
    """
    least = most / (2**31 - 1)
    return 10.0 ** max(least_power, ceil(log10(least)) if least else least_power)
