"""PLY, OBJ and OFF files: faces of any number of corners, and triangles of the same area."""

import re
import struct
import warnings
from collections import Counter
from dataclasses import dataclass, field

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.records import Floats, Ints, Mask

# Faces of any number of corners, and the triangles that cover the same area.

FAN_STARTS = 4
"""Corners that a face is fanned from on trial: one of two serves for any quadrangle."""

THIN = 1e-9
"""Share of a face's area below which a triangle of it counts as having none."""

AREA_SHARE = 1e-6
"""By which the triangles' area may miss the face's: coordinates of 32 bits carry 1e-7."""

ON_LINE = 1e-12
"""Share of a face's extent within which a corner lies on an edge: rounding of 64 bits."""


@dataclass(frozen=True)
class PolygonMesh:
    """What a mesh file lists, in its own unit of length.

    Attributes
    ----------
    vertices : (N, 3) array
    corners : (K,) array, vertices of all faces, one face after the other
    sizes : (F,) array, number of corners of each face
    vertex_colours, face_colours : (N, 3), (F, 3) array, red, green and blue from 0 to 1, or None
    unread : str, what else the file says of its faces' reflectance; empty if nothing
    """

    vertices: Floats
    corners: Ints
    sizes: Ints
    vertex_colours: Floats | None = None
    face_colours: Floats | None = None
    unread: str = ""


def triangles_of(mesh: PolygonMesh) -> tuple[Ints, Ints]:
    """Triangles that cover the faces of a mesh, and the face that each belongs to.

    Every corner of a face stays one of its triangles', those on a straight edge too, so that faces
    which share an edge still do.  Faces of fewer than three corners have no triangle.

    Parameters
    ----------
    mesh : PolygonMesh, each face nearly flat; a hole is joined to the outline by a bridge, an
        edge that the face passes both ways

    Returns
    -------
    (T, 3) array of vertices, turning as their face does, and (T,) array of faces in rising order

    Raises
    ------
    InputError
        Where a face crosses itself, seen along its mean normal.
    """
    if (mesh.sizes == 3).all():
        return mesh.corners.reshape(-1, 3), np.arange(len(mesh.sizes))
    first = np.cumsum(mesh.sizes) - mesh.sizes
    triangles, owners = [np.empty((0, 3), dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for size in np.unique(mesh.sizes[mesh.sizes >= 3]):
        left = np.flatnonzero(mesh.sizes == size)
        rings = mesh.corners[first[left, None] + np.arange(size)]
        for _ in range(1 if size == 3 else FAN_STARTS):
            covers = _fan_covers(mesh.vertices[rings])
            triangles.append(_fans(rings[covers]))
            owners.append(np.repeat(left[covers], size - 2))
            left, rings = left[~covers], np.roll(rings[~covers], -1, axis=1)
        for face, ring in zip(left.tolist(), rings, strict=True):
            found = _ears(mesh.vertices, ring, face)
            triangles.append(found)
            owners.append(np.full(len(found), face))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


def _fans(rings: Ints) -> Ints:
    """Triangles from the first of (M, n) corners to each side that does not touch it."""
    across = [rings[:, [0, k, k + 1]] for k in range(1, rings.shape[1] - 1)]
    return np.stack(across, axis=1).reshape(-1, 3)


def _fan_covers(points: Floats) -> Mask:
    """(M,) whether the fan from the first of (M, n, 3) corners is the face; of a triangle it is."""
    arms = points[:, 1:] - points[:, :1]
    across = np.cross(arms[:, :-1], arms[:, 1:])
    if across.shape[1] == 1:
        return np.ones(len(points), dtype=bool)
    area = np.einsum("mka,ma->mk", across, across.sum(axis=1))
    flat = ~across.any(axis=(1, 2))  # without any area: no cover is wrong
    return np.asarray((area > THIN * area.sum(axis=1)[:, None]).all(axis=1) | flat)


def _ears(vertices: Floats, ring: Ints, face: int) -> Ints:
    """Triangles of a face that no fan covers, by cutting its ears in the plane of its mean normal.

    Earcut leaves out corners on straight edges, which are put back.
    """
    ring = ring[ring != np.roll(ring, -1)]
    names, place = np.unique(ring, return_inverse=True)
    points = vertices[names] - vertices[names].mean(axis=0)
    corners = points[place]
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    plan = points @ np.linalg.svd(normal[None, :])[2][1:].T
    area = _cross(plan[place], np.roll(plan[place], -1, axis=0)).sum()
    if area < 0:
        plan, area = plan[:, ::-1].copy(), -area
    cut = mapbox_earcut.triangulate_float64(plan[place], np.array([len(place)], dtype=np.uint32))
    found, sides = place[cut.reshape(-1, 3)], _edges(place[None, :])
    if _edges(found) != sides:
        found = _split_at_corners(found, plan, place)
    a, b, c = plan[found.T]
    covered = np.abs(_cross(b - a, c - a)).sum()
    if abs(covered - area) > AREA_SHARE * area or _edges(found) != sides:
        raise InputError("crosses itself, seen along its mean normal", where=f"face {face + 1}")
    return names[found]


def _split_at_corners(triangles: Ints, plan: Floats, ring: Ints) -> Ints:
    """The triangles, cut wherever a corner of the face lies on an inner edge of theirs."""
    tolerance = ON_LINE * np.ptp(plan, axis=0).max()
    sides = set(zip(ring.tolist(), np.roll(ring, -1).tolist(), strict=True))
    waiting, done = triangles.tolist(), []
    while waiting:
        triangle = waiting.pop()
        if len(set(triangle)) < 3:
            continue
        for turn in range(3):
            a, b, c = triangle[turn:] + triangle[:turn]
            if (a, b) in sides:
                continue
            along, away = plan[b] - plan[a], plan - plan[a]
            length = np.linalg.norm(along)
            share = away @ along / length**2
            on = (np.abs(_cross(along, away)) <= tolerance * length) & (share > 0) & (share < 1)
            on[[a, b]] = False
            if on.any():
                middle = int(np.flatnonzero(on)[0])
                waiting += [[a, middle, c], [middle, b, c]]
                break
        else:
            done.append(triangle)
    return np.array(done, dtype=np.int64).reshape(-1, 3)


def _edges(rings: Ints) -> Counter[tuple[int, int]]:
    """How often (M, n) rings pass each edge, less how often they pass it the other way."""
    passed: Counter[tuple[int, int]] = Counter()
    for a, b in zip(
        rings.ravel().tolist(), np.roll(rings, -1, axis=1).ravel().tolist(), strict=True
    ):
        passed[min(a, b), max(a, b)] += 1 if a < b else -1
    return Counter({edge: count for edge, count in passed.items() if count})


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


# PLY, OBJ and OFF files, read as faces of any number of corners.
#
# InputError says what is wrong; any other error that is raised means that the content does not
# follow its format, in a way that has no words of its own.


PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
PLY_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_CORNERS = ("vertex_indices", "vertex_index")
PLY_COLOURS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
PLY_LEVELS = ("intensity", "gray", "grey", "luminance")
"""Properties that may be a reflectance; the format says neither of what nor in which unit."""


@dataclass(frozen=True)
class PlyElement:
    """One element of a PLY header.

    Attributes
    ----------
    count : int, number of its rows
    types : dict, the NumPy type of each property in the order of a row's values
    lengths : dict, the NumPy type of the length before the values, of each property that is a list
    """

    count: int
    types: dict[str, str] = field(default_factory=dict)
    lengths: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class PlyRows:
    """Rows of an element whose lists are alike in length.

    Attributes
    ----------
    rows : (M,) array, their places in the element
    values : (M,) structured array, a field a property
    """

    rows: Ints
    values: NDArray[np.void]


def read_ply(content: bytes) -> PolygonMesh:
    """A PLY file: text or binary, of either byte order.

    Parameters
    ----------
    content : bytes, of the file
    """
    elements, order, comments, body = _ply_header(content)
    if order == "=":
        body = memoryview(_numbers(bytes(body)).tobytes())
    tables: dict[str, list[PlyRows]] = {}
    for name, element in elements.items():
        text = order == "="
        tables[name], body = _ply_rows(element, body, order, text)
        if {"vertex", "face"} <= tables.keys():
            break
    vertex, face = elements["vertex"], elements.get("face", PlyElement(0))
    vertices = np.stack([_column(vertex, tables["vertex"], axis) for axis in "xyz"], axis=-1)
    lists = [name for name in face.lengths if name in PLY_CORNERS] or list(face.lengths)
    if face.count and len(lists) != 1:
        raise InputError("has faces without a list of vertex_indices", value=list(face.types))
    corners, sizes = _ply_lists(face.count, tables.get("face", []), "".join(lists))
    unread = [f"vertex property {name!r}" for name in PLY_LEVELS if name in vertex.types]
    unread += [f"face property {name!r}" for name in PLY_LEVELS if name in face.types]
    unread += [line for line in comments if line.lower().startswith("texturefile")]
    return PolygonMesh(
        vertices.astype(float),
        corners,
        sizes,
        _ply_colours(vertex, tables["vertex"]),
        _ply_colours(face, tables.get("face", [])),
        ", ".join(unread),
    )


def _ply_header(content: bytes) -> tuple[dict[str, PlyElement], str, list[str], memoryview]:
    """Elements, byte order ("=" of text), comments and what follows the header."""
    # A comment may be of any encoding; each byte is one letter of Latin-1.
    ending = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    found = ending and re.search(rb"[\r\n]end_header[ \t]*" + ending[1], content)
    if not ending or not found:
        raise InputError("has no header from 'ply' to 'end_header'")
    elements: dict[str, PlyElement] = {}
    order, comments, element = "", [], PlyElement(0)  # of properties before any element: unread
    for line in content[ending.end() : found.start()].decode("latin-1").split(ending[1].decode()):
        match line.split():
            case ["format", kind, _] if kind in PLY_FORMATS:
                order = PLY_FORMATS[kind]
            case ["element", name, count] if count.isdecimal() and name not in elements:
                elements[name] = element = PlyElement(int(count))
            case ["property", kind, name] if kind in PLY_TYPES and name not in element.types:
                element.types[name] = PLY_TYPES[kind]
            case ["property", "list", length, kind, name] if {
                length,
                kind,
            } <= PLY_TYPES.keys() and name not in element.types:
                element.types[name], element.lengths[name] = PLY_TYPES[kind], PLY_TYPES[length]
            case ["comment" | "obj_info", *_]:
                comments.append(line.split(maxsplit=1)[-1].strip())
            case []:
                pass
            case _:
                raise InputError("has a header line that cannot be read", value=line.strip())
    if not order or "vertex" not in elements or not {*"xyz"} <= elements["vertex"].types.keys():
        raise InputError("has no format, or no vertices of x, y and z, in its header")
    return elements, order, comments, memoryview(content)[found.end() :]


def _ply_rows(
    element: PlyElement, body: memoryview, order: str, text: bool
) -> tuple[list[PlyRows], memoryview]:
    """The rows of an element, those with lists of one length together, and what follows them.

    Text has been read into numbers of 64 bits, one after the other.
    """
    types = {name: order + ("f8" if text else kind) for name, kind in element.types.items()}
    lengths = {name: order + ("f8" if text else kind) for name, kind in element.lengths.items()}

    def row(sizes: tuple[int, ...]) -> np.dtype[np.void]:
        wanted, fields = iter(sizes), []
        for name, kind in types.items():
            if name in lengths:
                fields += [(f"{name} length", lengths[name]), (name, kind, (next(wanted),))]
            else:
                fields.append((name, kind))
        return np.dtype(fields)

    if element.count == 0 or not types:  # rows without anything in them, however many
        return [], body
    least = row((0,) * len(lengths)).itemsize
    if element.count * least > len(body):
        what, allowed = "has fewer rows than its header says", f"{len(body) // least} by its size"
        raise InputError(what, value=element.count, allowed=allowed)
    if not lengths:
        values = np.frombuffer(body, row(()), element.count)
        return [PlyRows(np.arange(element.count), values)], body[values.nbytes :]
    sizes = _ply_sizes(body, types, lengths, 0)[0]
    if row(sizes).itemsize * element.count <= len(body):
        values = np.frombuffer(body, row(sizes), element.count)
        alike = [(values[f"{k} length"] == n).all() for k, n in zip(lengths, sizes, strict=True)]
        if all(alike):
            return [PlyRows(np.arange(element.count), values)], body[values.nbytes :]
    starts: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    place = 0
    for index in range(element.count):
        sizes, behind = _ply_sizes(body, types, lengths, place)
        starts.setdefault(sizes, []).append((index, place))
        place = behind
    octets = np.frombuffer(body, np.uint8)
    parts = []
    for sizes, found in starts.items():
        rows, places = np.array(found, dtype=np.int64).T
        own = octets[places[:, None] + np.arange(row(sizes).itemsize)]
        parts.append(PlyRows(rows, own.view(row(sizes))[:, 0]))
    return parts, body[place:]


def _ply_sizes(
    body: memoryview, types: dict[str, str], lengths: dict[str, str], place: int
) -> tuple[tuple[int, ...], int]:
    """The lengths of the lists of the row at a place, and the place behind it."""
    sizes = []
    for name, kind in types.items():
        count = 1
        if name in lengths:
            dtype = np.dtype(lengths[name])
            (length,) = struct.unpack_from(lengths[name][0] + dtype.char, body, place)
            count = int(length)
            if count < 0 or count != length:
                raise InputError("has a list that cannot be so long", value=length)
            sizes.append(count)
            place += dtype.itemsize
        place += count * np.dtype(kind).itemsize
    if place > len(body):
        raise InputError("has fewer numbers than its header says")
    return tuple(sizes), place


def _column(element: PlyElement, parts: list[PlyRows], name: str) -> NDArray[np.generic]:
    """(count,) the values of a property."""
    column = np.empty(element.count, dtype=element.types[name])
    for part in parts:
        column[part.rows] = part.values[name]
    return column


def _ply_lists(count: int, parts: list[PlyRows], name: str) -> tuple[Ints, Ints]:
    """The values of a list property, one row's after the other's, and (count,) how many each."""
    sizes = np.zeros(count, dtype=np.int64)
    for part in parts:
        sizes[part.rows] = part.values[name].shape[-1]
    if len(parts) == 1:
        return parts[0].values[name].astype(np.int64).ravel(), sizes
    first = np.cumsum(sizes) - sizes
    values = np.empty(sizes.sum(), dtype=np.int64)
    for part in parts:
        own = part.values[name]
        values[first[part.rows, None] + np.arange(own.shape[-1])] = own
    return values, sizes


def _ply_colours(element: PlyElement, parts: list[PlyRows]) -> Floats | None:
    for names in PLY_COLOURS:
        if set(names) <= element.types.keys():
            colours = np.stack([_column(element, parts, name) for name in names], axis=-1)
            return _shares(colours.astype(float), element.types[names[0]])
    return None


def read_obj(content: bytes) -> PolygonMesh:
    """A Wavefront OBJ file; lines, points and curved surfaces in it are not read.

    Parameters
    ----------
    content : bytes, of the file
    """
    vertices: list[list[float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    materials: dict[str, None] = {}
    for line in content.decode("latin-1").replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        try:
            match line.split():
                case ["v", *numbers]:
                    vertices.append([float(number) for number in numbers])
                case ["f", *references]:
                    named = [int(reference.partition("/")[0]) for reference in references]
                    # Counted from 1, or backwards from the last vertex so far.
                    corners += [n - 1 if n > 0 else len(vertices) + n for n in named]
                    sizes.append(len(named))
                case ["usemtl" | "mtllib" as key, *names]:
                    materials[" ".join([key, *names])] = None
        except ValueError as error:
            raise InputError("has a line without its numbers", value=line.strip()) from error
    widths = {len(vertex) for vertex in vertices} or {3}
    if len(widths) > 1:
        raise InputError("has vertices of different numbers of values", value=sorted(widths))
    table = np.array(vertices).reshape(-1, *widths)
    colours = _shares(table[:, 3:6], "f8") if table.shape[1] >= 6 else None
    unread = ", ".join(materials)
    return PolygonMesh(
        table[:, :3],
        np.array(corners, dtype=np.int64),
        np.array(sizes, dtype=np.int64),
        colours,
        unread=unread,
    )


def read_off(content: bytes) -> PolygonMesh:
    """An OFF file of text, with colours or normals of its vertices or without.

    Parameters
    ----------
    content : bytes, of the file
    """
    text = re.sub(r"#.*", "", content.decode("latin-1"))
    if not (head := re.match(r"\s*(?:ST)?(C?)(N?)OFF(?![A-Za-z])(?!\s+BINARY)", text)):
        raise InputError("has no header OFF, COFF, NOFF or CNOFF of a text")
    lines = [words for words in map(str.split, text[head.end() :].splitlines()) if words]
    (count, faces), rows = map(int, lines[0][:2]), lines[1:]
    if min(count, faces) < 0 or len(rows) < count + faces:
        raise InputError("has fewer lines than its header says")
    table = np.array(rows[:count], dtype=float).reshape(count, -1)
    # Normals, three numbers, come before the colours; texture coordinates, two, after them.
    behind = table[:, 6 if head[2] else 3 :]
    rings = rows[count : count + faces]
    sizes = np.array([int(ring[0]) for ring in rings], dtype=np.int64)
    if (sizes < 0).any() or any(len(r) <= n for r, n in zip(rings, sizes.tolist(), strict=True)):
        raise InputError("has a face of fewer corners than it says")
    corners = [int(c) for r, n in zip(rings, sizes.tolist(), strict=True) for c in r[1 : n + 1]]
    looks = [ring[n + 1 :] for ring, n in zip(rings, sizes.tolist(), strict=True)]
    widths = {len(look) for look in looks}
    coloured = widths in ({3}, {4})
    return PolygonMesh(
        table[:, :3],
        np.array(corners, dtype=np.int64),
        sizes,
        _off_shares([row[-behind.shape[1] :] for row in rows[:count]])
        if behind.shape[1] >= 3
        else None,
        _off_shares(looks) if coloured else None,
        "" if coloured or widths <= {0} else "colours of some faces, or numbers of a colour map",
    )


def _off_shares(colours: list[list[str]]) -> Floats:
    """(N, 3) red, green and blue from 0 to 1: whole numbers up to 255, or shares with a point."""
    whole = all(number.isdigit() for colour in colours for number in colour[:3])
    return _shares(np.array(colours, dtype=float)[:, :3], "u1" if whole else "f8")


def _shares(colours: Floats, kind: str) -> Floats:
    """Colours from 0 to 1, of numbers of a NumPy type; those above 1 are of 255."""
    if kind == "u2":
        return colours / 65535
    if colours.size and not (colours.min() >= 0 and colours.max() <= 255):
        extreme = colours.flat[np.abs(colours).argmax()]
        raise InputError("has a colour out of range", value=float(extreme), allowed="0 to 255")
    whole = kind[0] in "iu" or (colours.size and colours.max() > 1)
    return colours / 255 if whole else colours


def _numbers(text: bytes) -> Floats:
    """The numbers of a text, between spaces and line ends."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # of what is no number
        try:
            return np.fromstring(text, dtype=float, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise InputError("has a word that is no number") from error
