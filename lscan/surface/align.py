"""A raw scan of the sandwave block brought into the workpiece frame (Sec. IV.C, Figs. 25 to 28).

Four adjustments as in the paper: two rotations that level the wedges' tops, one about z that
lays the line of the wedges' corners along x, and the yaw of the laser sheet against the track.
The yaw is not a rotation but a shear: with the sheet yawed by ``yaw`` the track moves the head
along (sin yaw, cos yaw, 0) in the head's own axes, so the point x of the sheet at track
position s lies at (x + s sin yaw, s cos yaw, z).  Positive yaw: the raw profiles must be shifted
towards +x in proportion to s.  (The paper shifts x alone, which takes cos yaw for 1: 0.07 %,
or 0.15 mm over the block, at its 2.2 degrees.)
Because the shear acts before the rotations, all four are solved together by iteration.
About a shaft nothing is sheared: without the yaw, the block's sides give the rotation about z.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lscan.config.targets import Sandwave
from lscan.errors import MeasurementError
from lscan.records import Floats, Surface
from lscan.surface import alignment
from lscan.surface.edges import EdgeCrossings, EdgeFit, fit_edges, fit_fading
from lscan.surface.features import Features, faces_beside, find_features
from lscan.surface.surface import require_head_frame

SETTLED_RAD = 1e-7
"""Change of yaw and of the rotation about z below which the iteration ends."""

MAX_ITERATIONS = 60

UNDECIDED_ITERATIONS = 10
"""Rounds after which it stays as it is how much each sample counts: a doubtful one that came and
went with the pose would keep the pose from settling."""

MIN_SIDE_CROSSINGS = 50
"""Fewest profiles that must cross a side of the block for it to be used."""

WINDOWS_MM = (15.0, 3.0, 2.0)
"""How far from its nominal place an edge is looked for, round after round: first over what a
yaw of 5 degrees shifts the block's corners, then over what is left of it."""

CORNER_MARGIN_MM = 1.5
"""Crossings this near (along y) to the ends of an edge are left out: corners are never sharp."""


@dataclass(frozen=True)
class BlockPose:
    """The part of an alignment that is iterated: angles in rad, shift (3,) mm, rotation (3, 3)."""

    yaw: float
    turn: float
    shift: Floats
    rotation: Floats

    def place(self, raw: Floats) -> Floats:
        """(..., 3) workpiece points of raw ones (..., 3), mm."""
        return raw @ (self.rotation @ alignment.shear(self.yaw)).T + self.shift

    def plan(self, raw: Floats) -> Floats:
        """(K, 2) of raw points (K, 3), mm."""
        return self.place(raw)[:, :2]


def align_sandwave(surface: Surface, piece: Sandwave, sheared: bool = True) -> alignment.Alignment:
    """The alignment of a raw scan of the sandwave block with its workpiece frame.

    Edges are first taken to lie beyond the last samples on them.  Where the surface knows the
    line's brightness, they are then found by how it fades over them (edges.py): without that
    they are off by the column, and by the sheet, whose thickness lights an edge ahead of it.

    The wedges' tops come to z = wedge.height_mm, the midpoint of the corners W_L and W_R to its
    nominal place in plan and the line between them along x; where the line's brightness places both
    sides of the block, the corners are where the wedges' far edges are at the x that follows from
    them (the near ones are displaced by false light).  The yaw makes the block's sides
    orthogonal to that line: the left one, as in the paper, and where it is in the scan the
    right one too.  The wedges' edges have a small say as well, being symmetric about that
    line: a side that runs along the track to within a column or two is only known to that.

    Parameters
    ----------
    surface : Surface, mm, frame of the head
    piece : Sandwave, the nominal shape
    sheared : bool, False for a scan about a shaft: there is no yaw then, and what makes the sides
        run along y is the rotation about z instead of the line of the corners

    Raises
    ------
    InputError
        For a surface that is not in the head frame.
    MeasurementError
        Names what is missing in the scan.

    References
    ----------
    Sec. IV.C and eqs. (5) to (7) of the paper.
    """
    require_head_frame(surface)
    features = find_features(surface, piece)
    pose = rough_pose(features, piece)
    for window in WINDOWS_MM:
        selected = _select(features, pose, piece, window)
        pose, edges = _refine(features.tops, _by_crossings(selected, piece), pose, piece, sheared)
    if (fading := _by_fading(surface, pose, edges, list(selected), piece)) is not None:
        pose, edges = _refine(features.tops, fading, pose, piece, sheared)
    datum = _datum(surface, features, selected, pose, edges, sheared)
    modes = alignment.turned_modes(surface, pose.rotation @ alignment.shear(pose.yaw), datum.index)
    errors = alignment.parameter_modes(datum, modes)
    return alignment.Alignment(
        yaw_rad=pose.yaw,
        yaw_sigma_rad=float(np.linalg.norm(errors[alignment.YAW])),
        rotation=pose.rotation,
        translation_mm=pose.shift,
        normal=alignment.plane_normal(features.tops @ alignment.shear(pose.yaw).T),
        base_mm=piece.wedge.height_mm,
        left_corner_mm=edges.corners[0],
        right_corner_mm=edges.corners[1],
        pivot_mm=datum.pivot,
        modes=errors,
        sheared=sheared,
    )


def rough_pose(features: Features, piece: Sandwave) -> BlockPose:
    """The pose to a few mm, from the levels and middles of the wedges' tops alone; no yaw yet.

    So much may be wrong with the scan.

    Parameters
    ----------
    features : Features, of a scan in the frame of the head
    piece : Sandwave, the nominal shape
    """
    across = features.centre_right - features.centre_left
    turn = float(np.arctan2(across[1], across[0]))
    middle = (features.centre_left + features.centre_right) / 2
    return _pose_at(features.tops, 0.0, turn, middle, piece)


def _pose_at(
    tops: Floats, yaw: float, turn: float, raw_middle: Floats, piece: Sandwave
) -> BlockPose:
    """The pose that brings the raw point (3,) between the corners to its nominal place."""
    rotation = _rotation_about_z(-turn) @ alignment.level(tops @ alignment.shear(yaw).T)
    matrix = rotation @ alignment.shear(yaw)
    height = piece.wedge.height_mm - float((tops @ matrix[2]).mean())
    shift = _nominal_middle(piece) - (matrix @ raw_middle)[:2]
    return BlockPose(yaw, turn, np.array([*shift, height]), rotation)


def _rotation_about_z(angle: float) -> Floats:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _nominal_middle(piece: Sandwave) -> Floats:
    left, right = piece.wedge_tips_mm()
    return (left + right) / 2


def _tips_mm(piece: Sandwave) -> float:
    left, right = piece.wedge_tips_mm()
    return float(right[0] - left[0])


def _select(
    features: Features, pose: BlockPose, piece: Sandwave, window_mm: float
) -> dict[str, EdgeCrossings]:
    """The raw crossings that lie on each nominal edge to within ``window_mm``, by edge name."""
    selected = {}
    (left_near, left_tip, left_far), (right_far, right_tip, right_near) = piece.wedge_plans_mm()
    for name, crossings, start, end in (
        ("left wedge, near edge", features.wedge_left, left_near, left_tip),
        ("left wedge, far edge", features.wedge_left, left_tip, left_far),
        ("right wedge, near edge", features.wedge_right, right_near, right_tip),
        ("right wedge, far edge", features.wedge_right, right_tip, right_far),
        ("left side", features.side_left, *_side(piece, -piece.rim_mm)),
        ("right side", features.side_right, *_side(piece, piece.side_mm + piece.rim_mm)),
    ):
        plan = pose.plan(crossings.inside)
        slope = float((end[0] - start[0]) / (end[1] - start[1]))
        off = np.abs(plan[:, 0] - start[0] - slope * (plan[:, 1] - start[1]))
        low, high = start[1] + CORNER_MARGIN_MM, end[1] - CORNER_MARGIN_MM
        keep = (plan[:, 1] > low) & (plan[:, 1] < high) & (off < window_mm)
        selected[name] = replace(crossings.only(keep), slope=slope)
    sides = {name: len(selected[name].inside) for name in ("left side", "right side")}
    if max(sides.values()) < MIN_SIDE_CROSSINGS:
        raise MeasurementError(
            f"neither side of the block is found: {sides['left side']} and "
            f"{sides['right side']} profiles cross them, {MIN_SIDE_CROSSINGS} are needed"
        )
    return {
        name: edge
        for name, edge in selected.items()
        if name not in sides or sides[name] >= MIN_SIDE_CROSSINGS
    }


def _side(piece: Sandwave, x: float) -> tuple[Floats, Floats]:
    """Ends of a side of the block, clear of its corners by a sixth of the rim."""
    reach = piece.rim_mm * 5 / 6
    return np.array([x, -reach]), np.array([x, piece.side_mm + reach])


def _refine(
    tops: Floats, find: "_Finder", pose: BlockPose, piece: Sandwave, sheared: bool
) -> tuple[BlockPose, "_Edges"]:
    """The pose at which the base plane, the corners and the yaw agree, and the edges in it."""
    weight = None
    for iteration in range(1, MAX_ITERATIONS + 1):
        edges = find(pose, weight)
        weight = edges.fit.weight if iteration >= UNDECIDED_ITERATIONS else None
        across = edges.corners[1] - edges.corners[0]
        turn_error = float(np.arctan2(across[1], across[0]))
        # A lean towards +x with growing y says that the profiles were shifted too far.
        yaw_error = float(np.arctan(edges.fit.lean)) + turn_error
        if not sheared:
            yaw_error, turn_error = 0.0, -float(np.arctan(edges.fit.lean))
        middle = edges.middle
        # About the place the middle of the corners has.
        inverse = np.linalg.inv(pose.rotation @ alignment.shear(pose.yaw))
        raw_middle = inverse @ (np.array([*middle, piece.wedge.height_mm]) - pose.shift)
        pose = _pose_at(tops, pose.yaw - yaw_error, pose.turn + turn_error, raw_middle, piece)
        shift = float(np.abs(middle - _nominal_middle(piece)).max()) / piece.side_mm
        if max(abs(yaw_error), abs(turn_error), shift) < SETTLED_RAD:
            return pose, edges
    raise MeasurementError(
        f"the alignment did not settle in {MAX_ITERATIONS} rounds: still "
        f"{np.degrees(max(abs(yaw_error), abs(turn_error))):.2g} degrees off"
    )


@dataclass(frozen=True)
class _Edges:
    """The edges fitted in one pose: the wedges' four, then the sides that are in the scan.

    by_brightness: found by how the line's light fades over them.  tips_mm: nominal distance of the
    corners.
    """

    fit: EdgeFit
    by_brightness: bool
    tips_mm: float

    @property
    def by_sides(self) -> bool:
        """Whether the block's two sides say where it lies along x.

        They are four times as long as the wedges' edges and do not lean, so that brightness
        places them much better.
        """
        return self.by_brightness and len(self.fit.at_mm) == 6

    @property
    def corners(self) -> Floats:
        """(2, 2) where the left wedge's edges meet, and where the right one's do.

        Where the sides say where it lies, it is where the far edges are at the corners' nominal x:
        the walls below the near ones, which the camera sees, and the rim before them light each
        other, and the brightness there moves those edges outwards by 0.2 mm.
        """
        if not self.by_sides:
            return np.stack([self.fit.meet(0, 1), self.fit.meet(2, 3)])
        at, slope, half = self.fit.at_mm, self.fit.slope, self.tips_mm / 2
        x = at[4:].mean() + np.array([-half, half])
        y = (x - at[[1, 3]]) / slope[[1, 3]]
        return np.column_stack([x + self.fit.lean * y, y + self.fit.pivot_mm])

    @property
    def middle(self) -> Floats:
        """(2,) of the corners."""
        return np.asarray(self.corners.mean(axis=0), dtype=float)


_Finder = Callable[[BlockPose, Floats | None], _Edges]
"""Finds the edges in a pose; the weights say how much each sample counts, once decided."""


def _by_crossings(selected: Mapping[str, EdgeCrossings], piece: Sandwave) -> _Finder:
    """Finds edges between the last samples on them and the first ones off them."""

    def find(pose: BlockPose, weight: Floats | None) -> _Edges:
        in_plan = {name: edge.moved(pose.plan) for name, edge in selected.items()}
        return _Edges(fit_edges(in_plan, piece.side_mm / 2, weight), False, _tips_mm(piece))

    return find


def _by_fading(
    surface: Surface, pose: BlockPose, edges: _Edges, names: Sequence[str], piece: Sandwave
) -> _Finder | None:
    """Finds edges by the fading of the line; None where too little of it is seen or known."""
    if surface.brightness is None:
        return None
    beside = faces_beside(names, pose.place(surface.xyz_mm), surface.brightness, piece)
    if beside is None:
        return None
    raw = [surface.xyz_mm.reshape(-1, 3)[index] for index, _ in beside]

    def find(pose: BlockPose, weight: Floats | None) -> _Edges:
        samples = [
            replace(face, plan=pose.plan(points))
            for points, (_, face) in zip(raw, beside, strict=True)
        ]
        return _Edges(fit_fading(samples, edges.fit, weight), True, _tips_mm(piece))

    return find


def _datum(
    surface: Surface,
    features: Features,
    selected: Mapping[str, EdgeCrossings],
    pose: BlockPose,
    edges: _Edges,
    sheared: bool,
) -> alignment.Datum:
    """What the alignment was made from, in the workpiece frame that it leads to.

    Edges not found by brightness are each off by some part of a column of its own, an even
    distribution: what lies behind it, dark or bright, decides how far out the line is still
    seen; and columns sample the sides, which makes the yaw uncertain.
    """
    blind, yaw_variance = 0.0, 0.0
    if not edges.by_brightness:
        blind, yaw_variance = _median_gap(selected.values()) ** 2 / 12, _sampling_variance(selected)
    return alignment.Datum(
        tops=pose.place(features.tops),
        top_index=features.top_index,
        top_sigma_mm=np.sqrt(alignment.own_variances(surface)[..., 2].ravel()[features.top_index]),
        edges=[edge.moved(pose.place) for edge in selected.values()],
        edge_covariance=edges.fit.covariance + blind * np.diag([0.0, *np.ones(len(selected))]),
        yaw_variance=yaw_variance,
        corners=edges.corners,
        rotation=pose.rotation,
        yaw_rad=pose.yaw,
        by_sides=edges.by_sides,
        sheared=sheared,
    )


def _median_gap(edges: Iterable[EdgeCrossings]) -> float:
    """Distance from one column to the next where these edges are crossed, mm."""
    gaps = [edge.outside[:, 0] - edge.inside[:, 0] for edge in edges]
    return float(np.median(np.abs(np.concatenate(gaps))))


def _sampling_variance(selected: Mapping[str, EdgeCrossings]) -> float:
    """Variance of the yaw, rad², because columns sample the block's sides.

    A side of length L that runs along the track within one column, of width g, may have any
    slope below g / L, small ones more likely: a triangular distribution, of variance
    (g / L)² / 6.  Each further column crossed ties the line down at one more place.
    """
    precision = 0.0
    for name, edge in selected.items():
        if "side" in name:
            gap, length = _median_gap([edge]), float(np.ptp(edge.inside[:, 1]))
            slope = float(np.polyfit(edge.inside[:, 1], edge.inside[:, 0], 1)[0])
            crossed = 1 + abs(slope) * length / gap
            precision += 6 * (crossed * length / gap) ** 2
    return 1 / precision
