"""The sandwave block in a raw scan: wedges, edges, faces, and its nominal top.

Everything is found by elevation and place, from the nominal shape alone; no option is set by
hand.  The block is what stands above the abrupt drop to the floor.  A plane fitted robustly to
it settles on the rim, which shares the mean height of the waves; the wedges' tops are the flat
patches that stand a wedge's height above it, one on each side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from lscan.config.targets import Sandwave
from lscan.errors import MeasurementError
from lscan.records import Floats, Ints, Mask, Status, Surface, has_value
from lscan.surface.edges import REACH_MM, EdgeCrossings, FaceSamples

# The landmarks of the sandwave block in a raw scan: wedge tops, wedge edges, block sides.


@dataclass(frozen=True)
class Features:
    """Landmarks of the block.

    Attributes
    ----------
    tops : (K, 3) array, mm, raw head frame, on the flat tops of both wedges, their outermost
        samples left out
    top_index : (K,) array, of them among all F N samples of the surface
    centre_left, centre_right : (3,) array, mm, raw head frame, centroids of the two tops
    wedge_left, wedge_right : EdgeCrossings, of the wedges' inner edges, near and far together
    side_left, side_right : EdgeCrossings, of the block's left and right side; may be empty
    """

    tops: Floats
    top_index: Ints
    centre_left: Floats
    centre_right: Floats
    wedge_left: EdgeCrossings
    wedge_right: EdgeCrossings
    side_left: EdgeCrossings
    side_right: EdgeCrossings


def find_features(surface: Surface, piece: Sandwave) -> Features:
    """The landmarks of the block in a raw scan of it.

    The block lies roughly level (within 5°), turned by at most 10° about z, anywhere in the
    scan; the floor around it may be visible or not.

    Parameters
    ----------
    surface : Surface, mm, frame of the head
    piece : Sandwave, the nominal shape

    Raises
    ------
    MeasurementError
        Where the surface is empty or too coarse, or a wedge is not in the scan.
    """
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    if valid.sum() < 100:
        what = f"the surface holds {int(valid.sum())} measured points: no sandwave block in it"
        raise MeasurementError(what)
    height, plane = _height_above_rim(surface.xyz_mm, valid, piece)
    spacing = _column_spacing(surface.xyz_mm, valid)
    block = valid & (height > -(piece.body_mm + _crest(piece)) / 2)
    patch_left, patch_right = _wedge_tops(surface.xyz_mm, block, height, piece)
    tops = patch_left | patch_right
    steps = np.diff(surface.xyz_mm[..., 1], axis=0)[valid[1:] & valid[:-1]]
    step_mm = float(np.median(np.abs(steps))) if len(steps) else 0.0
    inner = tops & _away_from_ends(tops, step_mm, spacing)
    if np.count_nonzero(inner) < 3:
        raise MeasurementError(
            f"wedges' tops: {np.count_nonzero(inner)} points lie {TOP_MARGIN_MM} mm within their "
            f"edges, 3 are needed: the scan is too coarse, its profiles are {step_mm:.2g} mm apart "
            f"and its columns {float(np.median(np.abs(spacing))):.2g} mm"
        )
    flat = block & (
        near_level(height, 0.0, piece) | near_level(height, piece.wedge.height_mm, piece)
    )

    def crossings(mask: Mask, direction: int, open_end: Mask | None = None) -> EdgeCrossings:
        return _crossings(surface.xyz_mm, mask, direction, spacing, plane[1], open_end)

    unseen = (surface.status == Status.OUT_OF_BOARD) | (surface.status == Status.AT_BORDER)
    return Features(
        tops=surface.xyz_mm[inner],
        top_index=np.flatnonzero(inner),
        centre_left=surface.xyz_mm[patch_left].mean(axis=0),
        centre_right=surface.xyz_mm[patch_right].mean(axis=0),
        wedge_left=crossings(patch_left, +1),
        wedge_right=crossings(patch_right, -1),
        side_left=crossings(flat, -1, unseen),
        side_right=crossings(flat, +1, unseen),
    )


TOP_MARGIN_MM = 1.5
"""Sheets are that thick: nearer to an edge part of the light is lost, and the line displaced."""


def _away_from_ends(tops: Mask, along_mm: float, spacing: Floats) -> Mask:
    """Mask of the samples that are a margin away from where the tops end; holes are no end.

    along_mm: from one profile to the next.  spacing: (N,) from one column to the next.
    """
    steps = (along_mm, float(np.median(np.abs(spacing))))
    rows, columns = (2 * int(np.ceil(TOP_MARGIN_MM / max(step, 0.1))) + 1 for step in steps)
    whole = ndimage.binary_closing(tops, np.ones((3, 5), dtype=bool))
    shape = np.ones((rows, max(columns, 5)), dtype=bool)
    return np.asarray(ndimage.binary_erosion(whole, shape), dtype=bool)


def _crest(piece: Sandwave) -> float:
    """Greatest height of the waves, mm."""
    return piece.a_mm + piece.b * piece.side_mm


def near_level(height: Floats, level: float, piece: Sandwave) -> Mask:
    """Mask of the heights, mm, that belong to a flat at ``level``: nearer to it than to a crest."""
    tolerance = max((piece.wedge.height_mm - _crest(piece)) / 2, 0.1 * piece.wedge.height_mm)
    return np.abs(height - level) < tolerance


def _height_above_rim(xyz: Floats, valid: Mask, piece: Sandwave) -> tuple[Floats, Floats]:
    """(F, N) height above the rim's plane in mm, NaN where not valid, and the plane.

    The plane is z = c0 + c1 x + c2 s.  Tukey's biweight with a shrinking scale, from the whole
    block's spread down to what distinguishes the rim from the waves.
    """
    block = _above_drop(xyz[..., 2], valid, drop_mm=0.75 * piece.body_mm)
    points = xyz[block]
    plane = _weighted_plane(points, np.ones(len(points)))
    for scale in np.geomspace(2 * piece.wedge.height_mm, 0.1 * piece.wedge.height_mm, 30):
        residual = points[:, 2] - points[:, :2] @ plane[1:] - plane[0]
        root = np.maximum(1 - (residual / scale) ** 2, 0.0)
        if np.count_nonzero(root) < 50:
            break
        plane = _weighted_plane(points, root**2)
    cosine = 1 / np.sqrt(1 + plane[1] ** 2 + plane[2] ** 2)
    height = (xyz[..., 2] - plane[0] - xyz[..., :2] @ plane[1:]) * cosine
    return np.where(valid, height, np.nan), plane


def _weighted_plane(points: Floats, weight: Floats) -> Floats:
    """(3,) plane z = c0 + c1 x + c2 s of least squares of points (K, 3) with weights (K,)."""
    centre = weight @ points / weight.sum()
    aside = points - centre
    normal = (aside * weight[:, None]).T @ aside
    slopes = np.linalg.lstsq(normal[:2, :2], normal[:2, 2], rcond=None)[0]
    return np.append(centre[2] - centre[:2] @ slopes, slopes)


def _above_drop(z: Floats, valid: Mask, drop_mm: float) -> Mask:
    """Mask of the samples between an abrupt rise and the abrupt fall after it, row by row.

    A side may be missing where the floor is not visible there.  Profiles without any drop are
    taken only where no profile has one: then there is no floor in the scan.
    """
    rank = np.cumsum(valid, axis=1) - 1
    count = valid.sum(axis=1)
    # Push the valid samples of each row to its left, so that neighbours are neighbours.
    packed = np.full(z.shape, np.nan)
    rows, columns = np.nonzero(valid)
    packed[rows, rank[rows, columns]] = z[rows, columns]
    # Up to two samples on the wall may lie between the upper and the lower side.
    step = np.full(z.shape, np.nan)
    step[:, 3:] = packed[:, 3:] - packed[:, :-3]
    rises: Mask = np.greater(step, drop_mm)
    falls: Mask = np.less(step, -drop_mm)
    order = np.arange(z.shape[1])
    first = np.where(rises.any(axis=1), np.argmax(rises, axis=1), 0)
    beyond = falls & (order >= first[:, None])
    # The first low sample may be three past the block's last one.
    last = np.where(beyond.any(axis=1), np.argmax(beyond, axis=1) - 3, count - 1)
    inside: Mask = (order >= first[:, None]) & (order <= last[:, None])
    inside = inside & (order < count[:, None])
    bounded: Mask = np.any(rises | falls, axis=1)
    if np.count_nonzero(bounded) >= 10:
        inside = inside & bounded[:, None]
    mask = np.zeros_like(valid)
    mask[rows, columns] = inside[rows, rank[rows, columns]]
    return mask


def _column_spacing(xyz: Floats, valid: Mask) -> Floats:
    """(N,) distance in mm along x from each column to the next, its median over the profiles."""
    step = np.diff(xyz, axis=1)
    smooth = valid[:, 1:] & valid[:, :-1] & (np.abs(step[..., 2]) < np.abs(step[..., 0]))
    overall = float(np.median(step[..., 0][smooth])) if smooth.any() else 1.0
    known = smooth.sum(axis=0) >= 3
    spacing = np.full(xyz.shape[1], overall)
    masked = np.where(smooth, step[..., 0], np.nan)[:, known]
    spacing[:-1][known] = np.nanmedian(masked, axis=0)
    spacing[-1] = spacing[-2]
    return spacing


def _wedge_tops(xyz: Floats, block: Mask, height: Floats, piece: Sandwave) -> tuple[Mask, Mask]:
    """Masks of the left and the right wedge's flat top: the two patches a block apart."""
    high = block & near_level(height, piece.wedge.height_mm, piece)
    # Single missing samples must not break a patch up.
    labels, count = ndimage.label(
        ndimage.binary_closing(high, np.ones((3, 5), dtype=bool)), np.ones((3, 3))
    )
    labels = np.where(high, labels, 0)
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:] * _sample_area(xyz, block)
    nominal_area = piece.wedge.base_mm * piece.wedge.reach_mm / 2
    right_size = (areas > 0.3 * nominal_area) & (areas < 2 * nominal_area)
    large = [int(k) + 1 for k in np.flatnonzero(right_size)]
    centres = {k: xyz[labels == k][:, :2].mean(axis=0) for k in large}
    apart = piece.side_mm + 2 * piece.rim_mm - 2 * piece.wedge.reach_mm / 3
    pairs = [
        (abs(float(np.linalg.norm(centres[a] - centres[b])) - apart), a, b)
        for a in large
        for b in large
        if centres[a][0] < centres[b][0]
    ]
    if not pairs or min(pairs)[0] > 0.1 * apart:
        raise MeasurementError(_missing_wedges(centres, xyz[block]))
    _, left, right = min(pairs)
    return labels == left, labels == right


def _missing_wedges(centres: dict[int, Floats], block: Floats) -> str:
    """What to say where the pair of wedges is not complete."""
    what = "no sandwave block in the scan: neither the left nor the right wedge's top is found"
    if len(centres) == 1:
        (centre,) = centres.values()
        lost = "right" if centre[0] < np.median(block[:, 0]) else "left"
        what = f"the {lost} wedge's flat top is not found in the scan"
    return what


def _sample_area(xyz: Floats, valid: Mask) -> float:
    """Typical plan area of one sample, mm²."""
    along_x = np.diff(xyz[..., 0], axis=1)[valid[:, 1:] & valid[:, :-1]]
    along_y = np.diff(xyz[..., 1], axis=0)[valid[1:] & valid[:-1]]
    if not len(along_x) or not len(along_y):
        raise MeasurementError("the scan is a single profile or column: no surface to align")
    return float(np.abs(np.median(along_x) * np.median(along_y)))


def _crossings(
    xyz: Floats, mask: Mask, direction: int, spacing: Floats, slope: float, open_end: Mask | None
) -> EdgeCrossings:
    """The outermost sample of ``mask`` in each row towards ``direction`` (+1: greater x).

    slope: dz/dx of the rim's plane.  open_end: (F, N) samples that end the data without being
    an edge; a row that ends at one of them, or at the picture's border, is left out.
    """
    # Columns may run towards greater or smaller x.
    towards = direction * int(np.sign(np.median(spacing)))
    rows = np.flatnonzero(mask.any(axis=1))
    order = mask[rows]
    last = mask.shape[1] - 1
    columns = last - np.argmax(order[:, ::-1], axis=1) if towards > 0 else np.argmax(order, axis=1)
    if open_end is not None:
        beside = np.clip(columns + towards, 0, last)
        keep = (beside != columns) & ~open_end[rows, beside]
        rows, columns = rows[keep], columns[keep]
    # The gap beyond each column: to the next or from the last.
    beyond = columns if towards > 0 else np.maximum(columns - 1, 0)
    gap = direction * np.abs(spacing[beyond])
    inside = xyz[rows, columns]
    outside = inside + np.column_stack([gap, 0 * gap, slope * gap])
    return EdgeCrossings(inside, outside, rows * mask.shape[1] + columns)


# The samples on the faces beside each edge of the sandwave block, clear of all other edges.


CLEAR_MM = 3.0
"""Samples this near to another edge are dimmed by it as well."""

TIP_MM = 1.5
"""Along y, samples this near to a wedge's tip are left out; its other edge is twice as far."""

OFF_MM = 2.0
"""How far off, at most, the block is taken to be before its edges are found by their fading."""

FEWEST_SAMPLES = 40
"""Fewest on a face: its level takes three coefficients, the edge, its wall and width as many."""


def faces_beside(
    names: Sequence[str], points: Floats, brightness: Floats, piece: Sandwave
) -> list[tuple[Ints, FaceSamples]] | None:
    """For each edge named, the index (K,) of its samples among all, and the samples.

    None where a face has fewer than FEWEST_SAMPLES.  The wedges' near edges have a lower face, the
    rim; behind the far ones it is hidden, for the camera looks along y.  Of what is beyond the
    block's sides nothing is asked.

    Parameters
    ----------
    names : sequence of str, of the edges, such as "left wedge, near edge"
    points : (..., 3) array, mm, about in the workpiece frame
    brightness : (...) array, DN
    piece : Sandwave, the nominal shape
    """
    flat, light = points.reshape(-1, 3), brightness.ravel()
    valid = np.isfinite(flat).all(axis=1) & (light > 0)
    top = valid & near_level(flat[:, 2], piece.wedge.height_mm, piece)
    rim = valid & near_level(flat[:, 2], 0.0, piece)
    found = []
    for name in names:
        left, wedge, near = name.startswith("left"), "wedge" in name, "near" in name
        # Mirrored, so that each edge is one of the left half: x from the side inwards.
        inwards = flat[:, 0] + piece.rim_mm if left else piece.side_mm + piece.rim_mm - flat[:, 0]
        plan = np.column_stack([inwards, flat[:, 1] - piece.side_mm / 2])
        if wedge:
            upper, lower, slope = _beside_wedge(plan, top, rim, near, piece)
        else:
            upper, lower, slope = _beside_side(plan, top | rim, piece), np.zeros_like(top), 0.0
        if upper.sum() < FEWEST_SAMPLES or (near and lower.sum() < FEWEST_SAMPLES):
            return None
        index = np.asarray(np.flatnonzero(upper | lower), dtype=np.int64)
        slope, side = slope if left else -slope, 1 if wedge == left else -1
        samples = (flat[index, :2], light[index], lower[index])
        found.append((index, FaceSamples(slope, side, 0 if wedge else 1, *samples)))
    return found


def _beside_wedge(
    plan: Floats, top: Mask, rim: Mask, near: bool, piece: Sandwave
) -> tuple[Mask, Mask, float]:
    """Masks (K,) of the samples on top and on the rim beside an edge of the left wedge; dx/dy.

    plan: (K, 2) mm, x from the block's side, y from its middle.
    """
    inwards, y = plan.T
    slope = piece.wedge.reach_mm / (piece.wedge.base_mm / 2) * (1 if near else -1)
    along = -y if near else y
    depth = piece.wedge.reach_mm + slope * y - inwards
    beside = (along > TIP_MM) & (along < piece.wedge.base_mm / 2) & (inwards > CLEAR_MM)
    upper = top & beside & (depth > -OFF_MM) & (depth < REACH_MM + OFF_MM)
    lower = rim & beside & (depth < OFF_MM) & (depth > -REACH_MM - OFF_MM)
    lower &= inwards < piece.rim_mm - CLEAR_MM  # the waves begin there
    return upper, lower if near else np.zeros_like(lower), slope


def _beside_side(plan: Floats, top: Mask, piece: Sandwave) -> Mask:
    """Mask (K,) of the samples on top beside the left side, clear of the wedge's edges."""
    inwards, y = plan.T
    reach = piece.side_mm / 2 + piece.rim_mm - CLEAR_MM
    beside = (np.abs(y) < reach) & (np.abs(np.abs(y) - piece.wedge.base_mm / 2) > CLEAR_MM)
    return np.asarray(top & beside & (inwards > -OFF_MM) & (inwards < REACH_MM + OFF_MM))


# The sandwave block's nominal top: height and slope at a place in plan, clear of its steps.


@dataclass(frozen=True)
class NominalTop:
    """The top of the block at N places in plan, workpiece frame.

    Attributes
    ----------
    height_mm : (N,) array, mm
    slope : (N, 2) array, of the height by x and by y
    clear : (N,) mask, whether the place lies on the block and away from every step: from its sides,
        the border of the waves and the edges of the wedges
    """

    height_mm: Floats
    slope: Floats
    clear: Mask

    @cached_property
    def normal(self) -> Floats:
        """(N, 3) upward unit normals."""
        upward = np.column_stack([-self.slope, np.ones(len(self.slope))])
        return upward / np.linalg.norm(upward, axis=1, keepdims=True)


def nominal_top(piece: Sandwave, plan_mm: Floats, margin_mm: float) -> NominalTop:
    """The top at places in plan: eq. (4) on the waves, flat on rims and wedges.

    Parameters
    ----------
    piece : Sandwave, the nominal shape
    plan_mm : (N, 2) array, mm, (x, y), frame of the workpiece
    margin_mm : float, mm; a place nearer than this to a step is not clear
    """
    x, y = plan_mm.T
    far = piece.side_mm
    inset = np.minimum(np.minimum(x, far - x), np.minimum(y, far - y))
    waves = inset > 0
    wedge = _distance_into_wedge(piece, plan_mm)
    height = np.where(waves, piece.height_mm(x, y), np.where(wedge > 0, piece.wedge.height_mm, 0.0))
    slope = np.where(waves[:, None], piece.slopes(x, y), 0.0)
    clear = (np.abs(inset) > margin_mm) & (np.abs(wedge) > margin_mm)
    return NominalTop(height, slope, clear & (inset + piece.rim_mm > margin_mm))


FOOT_ROUNDS = 2
"""Of looking for the foot: 1 mm off a crest of curvature 0.2/mm, each leaves a fifth."""


def above_top(piece: Sandwave, points_mm: Floats, margin_mm: float) -> tuple[Floats, NominalTop]:
    """(N,) distance of points above the top along its normal, mm, and the top at its foot.

    The foot and not the place beneath the point: noise along the normal would else decide on
    the slope too, and what goes with the slope would be biased by it.

    Parameters
    ----------
    piece : Sandwave, the nominal shape
    points_mm : (N, 3) array, mm, frame of the workpiece
    margin_mm : float, mm; a foot nearer than this to a step is not clear
    """
    plan = points_mm[:, :2]
    for _ in range(FOOT_ROUNDS):
        distance, top = _off_tangent(piece, points_mm, plan, margin_mm)
        plan = points_mm[:, :2] - distance[:, None] * top.normal[:, :2]
    return _off_tangent(piece, points_mm, plan, margin_mm)


def _off_tangent(
    piece: Sandwave, points_mm: Floats, plan_mm: Floats, margin_mm: float
) -> tuple[Floats, NominalTop]:
    """(N,) distance of points from the planes that touch the top at (N, 2) places, and the top."""
    top = nominal_top(piece, plan_mm, margin_mm)
    offset = points_mm - np.column_stack([plan_mm, top.height_mm])
    return (offset * top.normal).sum(axis=1), top


def _distance_into_wedge(piece: Sandwave, plan_mm: Floats) -> Floats:
    """(N,) distance in plan to the inner edges of the nearer wedge, mm; negative outside."""
    x, y = plan_mm.T
    half, reach = piece.wedge.base_mm / 2, piece.wedge.reach_mm
    from_side = np.minimum(x + piece.rim_mm, piece.side_mm + piece.rim_mm - x)
    short = 1 - from_side / reach - np.abs(y - piece.side_mm / 2) / half
    return short / np.hypot(1 / reach, 1 / half)
