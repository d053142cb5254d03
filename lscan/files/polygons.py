"""Faces of any number of corners, and the triangles that cover the same area."""

from collections import Counter
from dataclasses import dataclass

import mapbox_earcut
import numpy as np

from lscan.errors import InputError
from lscan.records import Floats, Ints, Mask

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
