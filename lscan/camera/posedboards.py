"""A camera and the boards before it as one vector of parameters, with limits and derivatives."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from lscan.camera.optics import (
    UNKNOWN_WATER,
    CameraModel,
    PortModel,
    Rays,
    leave_port_derivatives,
    meet_plane,
    project,
    rays,
    rays_of,
    stated_water,
    undistort,
    undistort_derivatives,
)
from lscan.config.rig import BENDS, Known, LensKind, OpticsSection
from lscan.errors import InputError
from lscan.records import Floats, Ints, Mask

# The parameters of a camera behind a port: their order, limits, and what is known beforehand.

LENS = ("focal_px", "centre_u_px", "centre_v_px", *BENDS, "fisheye")
"""fisheye: 1 of such a lens and 0 of another (CameraModel.fisheye); it is never free."""
NEWER = LENS[8:]
"""Of these older files know nothing: 0, and exact."""
PORT = ("gap_mm", "thickness_mm", "glass_index", "water_index", "tilt_x_deg", "tilt_y_deg")
CAMERA = LENS + PORT
COUNT = len(CAMERA)
WATER, FISHEYE = CAMERA.index("water_index"), CAMERA.index("fisheye")

PortKind = Literal["flat", "none"]

OWN_BENDS: dict[LensKind, dict[str, Known]] = {
    "brown": {},
    "rational": dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6"), (0.0, 5.0)),
    "fisheye": dict.fromkeys(("k3", "k4"), (0.0, 0.5)) | dict.fromkeys(("p1", "p2"), (0.0, 0.0)),
}
"""What is known of coefficients that [optics], which speaks of Brown's, does not describe.  The
angle itself, a rectilinear picture's radius, is 1 + 7/9 q + ... over 1 + 10/9 q + ... times it, and
a fisheye's own radii (stereographic, equal in area, orthographic) have coefficients below 0.2."""

# Where nothing is known: as uncertain as webcams differ among themselves; ours.
FOCAL_WIDTHS = (1.2, 0.8)  # focal length and its uncertainty over the picture's width
CENTRE_WIDTHS = 0.1  # uncertainty of the axis over the picture's width

CONTRADICTED = 4.0  # sigmas: one of 16,000 that was stated rightly is as far off

# The permitted range of each parameter that has one.
LIMITS = {
    "focal_px": (1.0, np.inf),
    "gap_mm": (0.0, np.inf),
    "thickness_mm": (0.0, np.inf),
    "glass_index": (1.0, 4.0),
    "water_index": (1.0, 4.0),
    "tilt_x_deg": (-45.0, 45.0),
    "tilt_y_deg": (-45.0, 45.0),
}
LEAST, GREATEST = np.array([LIMITS.get(name, (-np.inf, np.inf)) for name in CAMERA]).T


@dataclass(frozen=True)
class CameraPriors:
    """What is known of a camera beforehand, in the order of CAMERA.

    Attributes
    ----------
    mean : (18,) array, units as the names in CAMERA say
    sigma : (18,) array, standard uncertainties; 0: the parameter is held; infinite: nothing is
        known
    focal_given : bool, whether the focal length is known, rather than assumed or open
    bend_per_mm : float, 1/mm, standard uncertainty of each of PosedBoards.bend_per_mm about 0;
        0: the board is flat
    """

    mean: Floats
    sigma: Floats
    focal_given: bool
    bend_per_mm: float = 0.0

    @property
    def free(self) -> Mask:
        """(18,) mask of the parameters to be found."""
        return self.sigma > 0

    @property
    def informed(self) -> Mask:
        """(18,) mask of the free parameters of which something is known."""
        return self.free & np.isfinite(self.sigma)


def camera_of(theta: Floats, port: PortKind) -> CameraModel:
    """The camera of a vector of parameters.

    Parameters
    ----------
    theta : (18 or more,) array, the first in the order of CAMERA
    port : str, "flat", or "none" for a camera in air
    """
    focal, u, v, k1, k2, p1, p2, k3, k4, k5, k6, fisheye = theta[: len(LENS)].tolist()
    window = PortModel(*theta[len(LENS) : COUNT].tolist()) if port == "flat" else None
    return CameraModel(
        focal, (u, v), k1, k2, p1, p2, k3, k4, k5, k6, fisheye=fisheye > 0.5, port=window
    )


def with_newer(rows: Floats, *older: int) -> Floats:
    """Rows by the parameters of a camera, CAMERA's first; those of older files get NEWER's, 0.

    Parameters
    ----------
    rows : (K, ...) array
    *older : int, how many rows older files have
    """
    return np.insert(rows, [8] * len(NEWER), 0.0, axis=0) if len(rows) in older else rows


def priors_of(
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
    assume_webcam: bool = True,
    lens: LensKind = "brown",
) -> CameraPriors:
    """What is known of the camera from the section [optics] and from k3.

    Parameters
    ----------
    optics : OpticsSection, of the rig file
    image_size : tuple of int, (width, height) of the pictures, px
    k3 : tuple of float, third radial coefficient and its standard uncertainty; held at 0 by default
    assume_webcam : bool, whether a focal length or centre that is not given is assumed to be that
        of a webcam; otherwise nothing is known of it
    lens : str, the model of the lens, whose own coefficients are about 0 (OWN_BENDS); those of
        [optics] that it states are not

    Raises
    ------
    InputError
        Where a value is out of its range.
    """
    width, height = image_size
    webcam = {
        "focal_px": (FOCAL_WIDTHS[0] * width, FOCAL_WIDTHS[1] * width),
        "centre_u_px": ((width - 1) / 2, CENTRE_WIDTHS * width),
        "centre_v_px": ((height - 1) / 2, CENTRE_WIDTHS * width),
    }
    known: dict[str, Known | None] = dict.fromkeys(("k4", "k5", "k6"), (0.0, 0.0))
    known |= {"fisheye": (float(lens == "fisheye"), 0.0), "k3": k3}
    known |= {"water_index": stated_water(optics) or UNKNOWN_WATER}
    silent = {**OpticsSection().model_dump(include=set(BENDS)), "k3": (0.0, 0.0)}
    for name, own in OWN_BENDS[lens].items():
        stated = k3 if name == "k3" else getattr(optics, name, None)
        known[name] = own if stated in (None, silent.get(name)) else stated
    mean, sigma = np.zeros(COUNT), np.zeros(COUNT)
    for index, name in enumerate(CAMERA):
        given = known.get(name) or getattr(optics, name)
        mean[index], sigma[index] = given or webcam[name]
        if given is None and not assume_webcam:
            sigma[index] = np.inf
        low, high = LEAST[index], GREATEST[index]
        if not (np.isfinite(mean[index]) and low <= mean[index] <= high):
            where, allowed = "k3" if name == "k3" else f"optics.{name}", f"{low:g} to {high:g}"
            raise InputError("out of range", where=where, value=float(mean[index]), allowed=allowed)
    if optics.port == "none":
        mean[WATER] = 1.0
        sigma[len(LENS) :] = 0.0
    return CameraPriors(mean, sigma, optics.focal_px is not None)


def contradiction(
    theta: Floats,
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
    lens: LensKind = "brown",
) -> str:
    """What was stated beforehand and the pictures contradict, in words; "" where nothing is.

    Parameters
    ----------
    theta : (18,) array, the camera that was found, in the order of CAMERA
    optics : OpticsSection, what was known of it
    image_size : tuple of int, (width, height) of the pictures, px
    k3 : tuple of float, third radial coefficient and its standard uncertainty beforehand
    lens : str, the model of the lens
    """
    priors = priors_of(optics, image_size, k3, assume_webcam=False, lens=lens)
    off = np.abs(theta - priors.mean) / np.where(priors.informed, priors.sigma, np.inf)
    words = [
        f"{CAMERA[k]} comes out at {theta[k]:.6g}, {off[k]:.0f} of its standard uncertainties off "
        f"the {priors.mean[k]:g} ± {priors.sigma[k]:g} that [optics] has"
        for k in np.flatnonzero(off > CONTRADICTED)
    ]
    return "; ".join(words) + ": correct it, or state it as less certain" if words else ""


# A camera and the boards in front of it, as one vector of parameters.


POSE = ("turn_x", "turn_y", "turn_z", "seen_u_px", "seen_v_px", "mm_per_px")
TURN, SEEN, MM_PER_PX = slice(0, 3), slice(3, 5), 5  # in the order of POSE

BEND_STEPS = 2  # of meeting a bent board; each leaves the bend's slope, 0.01 or so, of the error

# Board axes (x right, y away, z up) of a board that squarely faces the camera, in its frame.
FACING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class PosedBoards:
    """A camera and V boards before it.

    The frame of a board is x right, y away from the camera, z up; its marks lie in y = 0 or, if
    it is bent, at y = a x^2 + b x z + c z^2 about ``centre_mm``, all boards alike.

    Attributes
    ----------
    theta : (18 + 6 V,) array, the camera in the order of parameters.CAMERA, then each board's pose
        in that of POSE.  ``turn`` is the rotation vector (rad) by which the board is turned from
        facing the ray on which ``centre_mm`` is seen; ``seen`` the pixel where it is seen;
        mm_per_px how far on it lies along that ray, over the apparent focal length.  These change
        little when the lens does and the picture does not, which keeps least squares quick.
    centre_mm : (2,) array, mm, the point (x, z) of each board about which it is turned
    port : str, "flat", or "none" for a camera in air, whose port parameters mean nothing
    bend_per_mm : (3,) array, 1/mm, a, b and c of the boards' bend
    """

    theta: Floats
    centre_mm: Floats
    port: PortKind = "flat"
    bend_per_mm: Floats = field(default_factory=lambda: np.zeros(3))

    @cached_property
    def camera(self) -> CameraModel:
        """The camera alone."""
        return camera_of(self.theta, self.port)

    @property
    def poses(self) -> Floats:
        """(V, 6) in the order of POSE."""
        return self.theta[COUNT:].reshape(-1, len(POSE))

    @cached_property
    def apparent_focal_px(self) -> float:
        """Focal length of the pinhole that sees the water like this camera near its axis."""
        port = self.camera.port
        return self.camera.focal_px * (port.water_index if port else 1.0)

    @cached_property
    def lines_of_sight(self) -> Rays:
        """The V rays on which ``centre_mm`` is seen, camera frame."""
        return rays(self.camera, self.poses[:, SEEN])

    @cached_property
    def axes(self) -> Floats:
        """(V, 3, 3) the boards' axes x, y, z as columns, camera frame."""
        turned: Floats = towards(self.lines_of_sight.direction) @ rotation(self.poses[:, TURN])
        return turned @ FACING

    @cached_property
    def places_mm(self) -> Floats:
        """(V, 3) where ``centre_mm`` of each board is, camera frame."""
        sight, distance = (
            self.lines_of_sight,
            self.poses[:, MM_PER_PX, None] * self.apparent_focal_px,
        )
        return sight.origin_mm + distance * sight.direction

    def in_water(self, index: float) -> "PosedBoards":
        """The same camera and boards, where they are in space, in water of another index.

        Parameters
        ----------
        index : float, of the water, relative to air
        """
        theta = self.theta.copy()
        theta[WATER] = index
        other = replace(self, theta=theta)
        seen = project(other.camera, self.places_mm)
        sight = rays(other.camera, seen)
        distance = np.linalg.norm(self.places_mm - sight.origin_mm, axis=1)
        turned = np.swapaxes(towards(sight.direction), 1, 2) @ self.axes @ FACING.T
        turn = Rotation.from_matrix(turned).as_rotvec()
        poses = np.column_stack([turn, seen, distance / other.apparent_focal_px])
        theta[COUNT:] = poses.ravel()
        return replace(self, theta=theta)

    def in_camera(self, board_mm: Floats, board: Ints | int = 0) -> Floats:
        """(N, 3) mm, points of the boards in the camera frame.

        Parameters
        ----------
        board_mm : (N, 2) array, mm, (x, z) on the board
        board : (N,) array or int, number of each point's board
        """
        of_each = np.broadcast_to(board, len(board_mm))
        across, away, up = np.moveaxis(self.axes, 2, 0)[:, of_each]
        x, z = (board_mm - self.centre_mm).T[:, :, None]
        flat = x * across + z * up + self.places_mm[of_each]
        if not self.bend_per_mm.any():
            return flat
        return flat + (squares(board_mm - self.centre_mm) @ self.bend_per_mm)[:, None] * away

    def project(self, board_mm: Floats, board: Ints | int = 0) -> Floats:
        """(N, 2) px, (u, v) at which points of the boards are seen; NaN where there is no image.

        Parameters
        ----------
        board_mm : (N, 2) array, mm, (x, z) on the board
        board : (N,) array or int, number of each point's board
        """
        return project(self.camera, self.in_camera(board_mm, board))

    def on_board(self, image_px: Floats, board: int = 0) -> Floats:
        """(K, 3) mm, camera frame, where the rays of pixels meet a board; NaN if they do not.

        Parameters
        ----------
        image_px : (K, 2) array, px, of (u, v)
        board : int, number of the board
        """
        axes, place = self.axes[board], self.places_mm[board]
        seen, normal = rays(self.camera, image_px), axes[:, 1]
        points = meet_plane(seen, normal, place)
        for _ in range(BEND_STEPS if self.bend_per_mm.any() else 0):
            height = squares((points - place) @ axes[:, [0, 2]]) @ self.bend_per_mm
            points = meet_plane(seen, normal, place + height[:, None] * normal)
        return points

    def locate(self, image_px: Floats, board: int = 0) -> Floats:
        """(K, 2) mm, (x, z) on a board where the rays of pixels meet it; NaN if they do not.

        Parameters
        ----------
        image_px : (K, 2) array, px, of (u, v)
        board : int, number of the board
        """
        beside = self.on_board(image_px, board) - self.places_mm[board]
        return beside @ self.axes[board][:, [0, 2]] + self.centre_mm


def squares(places: Floats) -> Floats:
    """(N, 3) x^2, x z and z^2, of whose sum a bend is made.

    Parameters
    ----------
    places : (N, 2) array, (x, z) from the middle of the board
    """
    x, z = places.T
    return np.column_stack([x * x, x * z, z * z])


def towards(direction: Floats) -> Floats:
    """(V, 3, 3) the smallest rotations that take the camera's axis to directions.

    Parameters
    ----------
    direction : (V, 3) array, unit vectors, camera frame
    """
    across = np.column_stack([-direction[:, 1], direction[:, 0], np.zeros(len(direction))])
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, direction[:, 2])
    return rotation(across * (angle / np.where(sine > 0, sine, 1.0))[:, None])


def rotation(vector: Floats) -> Floats:
    """(..., 3, 3) rotation matrices of rotation vectors.

    Parameters
    ----------
    vector : (..., 3) array, rad, the axis times the angle

    Examples
    --------
    >>> rotation(np.array([0.0, 0.0, np.pi / 2])).round(6) @ np.array([1.0, 0.0, 0.0])
    array([0., 1., 0.])
    """
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    cross = np.zeros((*vector.shape, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = z, -y, x
    half = np.sqrt(x * x + y * y + z * z)[..., None, None] / 2
    # sin(a) / a and (1 - cos(a)) / a^2, which are 1 and 1/2 at 0
    straight, square = np.sinc(2 * half / np.pi), np.sinc(half / np.pi) ** 2 / 2
    return np.eye(3) + straight * cross + square * (cross @ cross)


# How rays and projections change with the camera and with the poses of the boards.
#
# All follows from the derivatives of a pixel's ray, which have a closed form.  A point X is seen at
# a pixel p whose ray runs from o along d and reaches it after a distance s: X = o(p) + s d(p). Its
# differential,
#
#     dX = (o_p + s d_p) dp + d ds + (o_c + s d_c) dc,
#
# gives dp where the point is given, by its own change dX and that of the camera, dc.  The boards'
# rotations alone are derived by central differences.


PIXEL = [COUNT, COUNT + 1]  # columns of a ray's derivatives by its own pixel
OWN = COUNT + len(POSE)  # parameters that a mark depends on: the camera's, its own board's

AWAY_MM = 1e-2  # mm, of central differences: 1e-4 of a distance of 100 mm, its square the error
TURN_STEP = 1e-5  # rad, of central differences: far above rounding, far below any curvature


@dataclass(frozen=True)
class RayDerivatives:
    """Derivatives of N rays by the camera and by the pixels they belong to.

    Attributes
    ----------
    origin_mm : (N, 3, 20) array, mm per unit of the parameters of CAMERA, then of u and v
    direction : (N, 3, 20) array, by the same
    """

    origin_mm: Floats
    direction: Floats

    def after(self, distance_mm: Floats) -> Floats:
        """(N, 3, 20) derivatives of the points that the rays reach after given distances.

        Parameters
        ----------
        distance_mm : (N,) array, mm, from where each ray enters the water
        """
        return self.origin_mm + distance_mm[:, None, None] * self.direction


def ray_derivatives(camera: CameraModel, image_px: Floats) -> RayDerivatives:
    """Derivatives of the rays in the water on which a camera sees pixels; NaN where it has none.

    Parameters
    ----------
    camera : CameraModel, in air or behind a port
    image_px : (N, 2) array, px, of (u, v)
    """
    distorted = (image_px - np.array(camera.centre_px)) / camera.focal_px
    return _derivatives_at(camera, distorted, undistort(camera, distorted))


def _derivatives_at(camera: CameraModel, distorted: Floats, tangents: Floats) -> RayDerivatives:
    """``ray_derivatives`` of pixels whose tangents, distorted and not, are known."""
    by_distorted, by_coefficients = undistort_derivatives(camera, tangents)
    by_lens = np.zeros((len(tangents), 2, COUNT + 2))
    by_lens[:, :, 0] = (by_distorted @ -distorted[:, :, None])[:, :, 0] / camera.focal_px
    by_lens[:, :, 1:3] = -by_distorted / camera.focal_px
    by_lens[:, :, 3 : len(LENS) - 1] = by_coefficients
    by_lens[:, :, PIXEL] = by_distorted / camera.focal_px
    ahead = np.column_stack([tangents, np.ones(len(tangents))])
    length = np.linalg.norm(ahead, axis=1)[:, None]
    air = ahead / length
    by_tangents = (np.eye(3)[:, :2] - air[:, :, None] * air[:, None, :2]) / length[:, None]
    if camera.port is None:
        direction = by_tangents @ by_lens
        return RayDerivatives(np.zeros_like(direction), direction)
    parts = []
    for by_ray in leave_port_derivatives(camera.port, air, by_tangents):
        parts.append(by_ray[:, :, :2] @ by_lens)
        parts[-1][:, :, len(LENS) : COUNT] = by_ray[:, :, 2:]
    return RayDerivatives(*parts)


def frame_derivatives(boards: PosedBoards) -> tuple[Floats, Floats]:
    """Derivatives of the boards' axes and places by the camera and by each board's own pose.

    Parameters
    ----------
    boards : PosedBoards, V of them

    Returns
    -------
    tuple of array
        (V, 3, 3, 24) of PosedBoards.axes, (V, 3, 24) of places_mm.
    """
    seen, sight = boards.poses[:, SEEN], boards.lines_of_sight
    by_ray = ray_derivatives(boards.camera, seen)
    of_pose = np.arange(COUNT, OWN)
    columns = [*range(COUNT), *of_pose[SEEN]]
    distance = boards.poses[:, MM_PER_PX] * boards.apparent_focal_px
    places = np.zeros((len(seen), 3, OWN))
    places[:, :, columns] = by_ray.after(distance)
    apart = sight.direction * distance[:, None]
    places[:, :, 0] += apart / boards.camera.focal_px
    if boards.camera.port is not None:
        places[:, :, WATER] += apart / boards.camera.port.water_index
    places[:, :, of_pose[MM_PER_PX]] = sight.direction * boards.apparent_focal_px

    turn, direction = boards.poses[:, None, TURN], sight.direction[:, None, :]
    steps = TURN_STEP * np.array([np.eye(3), -np.eye(3)])[:, None]  # (2, 1, 3, 3)
    turned, faced = rotation(turn), towards(sight.direction)[:, None]
    by_direction, by_turn = (
        (after - before) / (2 * TURN_STEP)
        for after, before in (
            towards((direction + steps).reshape(-1, 3)).reshape(2, -1, 3, 3, 3) @ turned @ FACING,
            faced @ rotation(turn + steps) @ FACING,
        )
    )
    axes = np.zeros((len(seen), 3, 3, OWN))
    axes[..., columns] = np.einsum("vkij,vkc->vijc", by_direction, by_ray.direction)
    axes[..., of_pose[TURN]] = np.moveaxis(by_turn, 1, 3)
    return axes, places


def image_derivatives(boards: PosedBoards, board_mm: Floats, board: Ints) -> Floats:
    """(N, 2, 24) derivatives of the pixels at which points of the boards are seen.

    By the camera and by the pose of each point's own board; NaN where there is no image.

    Parameters
    ----------
    boards : PosedBoards, V of them
    board_mm : (N, 2) array, mm, (x, z) on the board
    board : (N,) array, number of each point's board
    """
    axes, places = frame_derivatives(boards)
    x, z = (board_mm - boards.centre_mm).T[:, :, None, None]
    moved = (x * axes[:, :, 0][board] + z * axes[:, :, 2][board]) + places[board]
    if boards.bend_per_mm.any():
        height = squares(board_mm - boards.centre_mm) @ boards.bend_per_mm
        moved += height[:, None, None] * axes[:, :, 1][board]
    camera, points = boards.camera, boards.in_camera(board_mm, board)
    distorted = (project(camera, points) - np.array(camera.centre_px)) / camera.focal_px
    tangents = undistort(camera, distorted)
    seen = rays_of(camera, tangents)
    distance = np.linalg.norm(points - seen.origin_mm, axis=1)
    by_ray = _derivatives_at(camera, distorted, tangents).after(distance)
    moved[:, :, :COUNT] -= by_ray[:, :, :COUNT]
    found = np.full((len(points), 2, OWN), np.nan)
    good = np.isfinite(by_ray).all(axis=(1, 2))
    spanned = np.concatenate([by_ray[:, :, PIXEL], seen.direction[:, :, None]], axis=2)
    found[good] = np.linalg.solve(spanned[good], moved[good])[:, :2]
    return found


def bend_derivatives(boards: PosedBoards, board_mm: Floats, board: Ints) -> Floats:
    """(N, 2, 3) px mm, derivatives of the pixels of points of the boards by their bend.

    Parameters
    ----------
    boards : PosedBoards, V of them
    board_mm : (N, 2) array, mm, (x, z) on the board
    board : (N,) array, number of each point's board
    """
    points, away = boards.in_camera(board_mm, board), boards.axes[board][:, :, 1]
    after, before = (project(boards.camera, points + way * away) for way in (AWAY_MM, -AWAY_MM))
    by_height = (after - before) / (2 * AWAY_MM)
    return by_height[:, :, None] * squares(board_mm - boards.centre_mm)[:, None]


def on_board_derivatives(boards: PosedBoards, image_px: Floats, board: int) -> Floats:
    """(K, 3, 24) derivatives of PosedBoards.on_board, by the camera and by the board's pose.

    Parameters
    ----------
    boards : PosedBoards, V of them
    image_px : (K, 2) array, px, of (u, v)
    board : int, number of the board
    """
    axes, places = (each[board] for each in frame_derivatives(boards))
    normal, by_normal = boards.axes[board][:, 1], axes[:, 1]
    points, seen = boards.on_board(image_px, board), rays(boards.camera, image_px)
    distance = np.linalg.norm(points - seen.origin_mm, axis=1)
    found = np.zeros((len(points), 3, OWN))
    found[:, :, :COUNT] = ray_derivatives(boards.camera, image_px).after(distance)[:, :, :COUNT]
    off = normal @ (places - found) - (points - boards.places_mm[board]) @ by_normal
    return found + seen.direction[:, :, None] * (off / (seen.direction @ normal)[:, None])[:, None]
