"""The calibration file: its JSON layout, strict reading, and writing whole or not at all.

It holds format and version, model name, parameters with their covariances, what was known of
the optics, the marks with their residuals, image size, software: data only, and all that is
needed to solve the map again.
"""

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainSerializer,
    PositiveFloat,
    model_validator,
)

from lscan.calibration.calibrate import Calibration, residuals
from lscan.calibration.metric.planemap import solver
from lscan.calibration.metric.solve import CameraCalibration, MetricCalibration, SolvedViews
from lscan.calibration.metric.views import FittedView, LinePoints, ViewsFile
from lscan.calibration.planemap import (
    STRICT,
    Count,
    Gaps,
    Matrix,
    NotNegativeOrNaN,
    Number,
    Place,
    PlaneMap,
    Sigmas,
    Vector,
    check_theta,
    find_solver,
)
from lscan.camera.posedboards import CAMERA, COUNT
from lscan.config.documents import Strict, check
from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError
from lscan.files.disk import read_json, write_atomically
from lscan.records import (
    Axis,
    BoardReading,
    Floats,
    Ints,
    Mark,
    Marks,
    RingPoints,
    RulerReading,
    Status,
)

FORMAT: Final = "lscan-calibration"
VERSION: Final = 2  # 2: marks with status and sigma for dots and rings; optics
MOST_BYTES: Final = 32 * 2**20
"""Of a calibration file of either route; those of the paper's board have half a megabyte."""
SAME_MM = 1e-6  # residuals that belong to the parameters agree this well on any machine

Side = Annotated[int, Field(strict=True, gt=0)]


def _name(status: Any) -> Any:
    return status.name if isinstance(status, Status) else status


def _each(status: Any) -> Any:
    return [Status(code) for code in status] if isinstance(status, np.ndarray) else status


if TYPE_CHECKING:
    Code = Status
    Codes = Ints
else:  # names in the file
    Code = Annotated[
        Literal["OK", "NOT_FOUND", "OUT_OF_VIEW"],
        BeforeValidator(_name),
        AfterValidator(Status.__getitem__),
        PlainSerializer(_name),
    ]
    Codes = Annotated[
        tuple[Code, ...],
        BeforeValidator(_each),
        AfterValidator(partial(np.array, dtype=np.int64)),
        PlainSerializer(lambda status: [Status(code).name for code in status]),
    ]


def _pairs(values: Floats) -> Floats:
    if values.size and values.shape[1:] != (2,):
        raise ValueError("must be a list of pairs")
    return values.reshape(-1, 2)


@dataclass(frozen=True)
class StoredMarks(Marks):
    """Marks that are in a file; ``null`` where one has no place."""

    __pydantic_config__ = STRICT
    board_mm: Matrix
    image_px: Gaps
    sigma_px: Sigmas
    status: Codes

    def __post_init__(self) -> None:
        """Raise ValueError unless all are as many, with a place just where status is OK."""
        count = len(self.status)
        if self.board_mm.shape != (count, 2) or self.image_px.shape != (count, 2):
            raise ValueError(f"board_mm and image_px must hold {count} pairs, one per status")
        if self.sigma_px.shape != (count,):
            raise ValueError(f"sigma_px must hold {count} numbers, one per status")
        for values in (*self.image_px.T, self.sigma_px):
            if (np.isfinite(values) != self.found).any():
                raise ValueError("image_px and sigma_px must be numbers just where status is OK")


@dataclass(frozen=True)
class StoredMark(Mark):
    """A mark that is in a file; ``null`` where it has no place."""

    __pydantic_config__ = STRICT
    image_px: Gaps
    sigma_px: NotNegativeOrNaN
    status: Code

    def __post_init__(self) -> None:
        """Raise ValueError unless it has a place just where status is OK."""
        if self.image_px.shape != (2,):
            raise ValueError("image_px must be two numbers")
        if (np.isfinite([*self.image_px, self.sigma_px]) != (self.status == Status.OK)).any():
            raise ValueError("image_px and sigma_px must be numbers just where status is OK")


@dataclass(frozen=True)
class StoredRing(RingPoints):
    """Points of a ring that are in a file."""

    __pydantic_config__ = STRICT
    image_px: Annotated[Gaps, AfterValidator(_pairs)]
    sigma_px: Sigmas

    def __post_init__(self) -> None:
        """Raise ValueError unless each point is finite and has its uncertainty."""
        if self.sigma_px.shape != (len(self.image_px),):
            raise ValueError("image_px must hold one pair for each number of sigma_px")
        if not (np.isfinite(self.image_px).all() and np.isfinite(self.sigma_px).all()):
            raise ValueError("image_px and sigma_px must be finite numbers")


@dataclass(frozen=True)
class StoredRuler(RulerReading):
    """A ruler that is in a file."""

    __pydantic_config__ = STRICT
    direction: Literal["vertical", "horizontal"]
    at_mm: Number
    marks: StoredMarks


class StoredReading(Strict):
    """records.BoardReading."""

    image_size: tuple[Side, Side]
    pitch_mm: Annotated[PositiveFloat, Field(strict=True)]
    shape: tuple[Side, Side]
    grid: StoredMarks
    rulers: tuple[StoredRuler, ...]
    dots: dict[str, StoredMark]
    rings: dict[str, StoredRing]

    @model_validator(mode="after")
    def _whole_grid(self) -> Self:
        rows, columns = self.shape
        if len(self.grid.status) != rows * columns:
            raise ValueError(f"grid must hold {rows} by {columns} marks, as shape says")
        return self

    def reading(self) -> BoardReading:
        """As the program holds it."""
        return BoardReading(**dict(self))


class StoredResiduals(Strict):
    """Map of each control point less its nominal place, N pairs; ``null`` where there is none."""

    mm: Gaps
    px: Gaps


class CalibrationFile(Strict):
    """The whole file."""

    format: Literal["lscan-calibration"] = FORMAT
    version: Literal[2] = VERSION
    software: str
    plane_map: str
    optics: OpticsSection
    parameters: dict[str, Any]
    reading: StoredReading
    residuals: StoredResiduals
    outliers_mm: tuple[Place, ...] = ()  # not in older files

    @model_validator(mode="after")
    def _one_residual_each(self) -> Self:
        shape = self.reading.grid.image_px.shape
        if self.residuals.mm.shape != shape or self.residuals.px.shape != shape:
            raise ValueError(f"residuals must hold {shape[0]} pairs, one per control point")
        return self


def write_file(path: Path, content: Strict) -> None:
    """Write a calibration whole or not at all.

    Parameters
    ----------
    path : Path, of the file
    content : Strict, the model of the file

    Raises
    ------
    InputError
        Where the disk refuses.
    """
    text = json.dumps(content.model_dump(mode="json"), indent=1, allow_nan=False)
    write_atomically(path, (text + "\n").encode())


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write the calibration to a file: a whole file or none.

    Parameters
    ----------
    path : Path or str, of the file
    calibration : Calibration, of one picture

    Raises
    ------
    InputError
        Where the file cannot be written.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.calibrate_run(lscan.open_run("runs/board"), "projective")
    >>> lscan.save_calibration("projective.json", calibration)
    """
    content = CalibrationFile(
        software=calibration.software,
        plane_map=calibration.name,
        optics=calibration.optics,
        parameters=calibration.plane_map.parameters(),
        reading=check(StoredReading, asdict(calibration.reading), where="board reading"),
        residuals=StoredResiduals(mm=calibration.residuals_mm, px=calibration.residuals_px),
        outliers_mm=tuple(calibration.outliers_mm),
    )
    write_file(Path(path), content)


def load_calibration(path: Path | str) -> Calibration:
    """The calibration that was saved in a file, number for number.

    Parameters
    ----------
    path : Path or str, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written: unknown or missing
        keys, numbers out of range, a map that does not exist, and residuals that do not belong to
        the parameters.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> calibration.plane_map.name
    'graticule-2'
    """
    return calibration_of(read_json(Path(path), MOST_BYTES), Path(path))


def calibration_of(document: Any, path: Path) -> Calibration:
    """The calibration in the JSON document of a file.

    Parameters
    ----------
    document : object, as JSON has it
    path : Path, of the file, for messages

    Raises
    ------
    InputError
        As ``load_calibration``.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        found = document.get("format") if isinstance(document, dict) else None
        raise InputError(
            "is no calibration file", where=path, value=found, allowed=f'format "{FORMAT}"'
        )
    version = document.get("version")
    if type(version) is not int or version != VERSION:
        raise InputError(
            "version: is not the one this program writes; calibrate again from the picture",
            where=path,
            value=version,
            allowed=VERSION,
        )
    content = check(CalibrationFile, document, where=path)
    reading, stored = content.reading.reading(), content.residuals
    with np.errstate(all="ignore"):  # numbers that make no map do not give these residuals
        try:
            plane_map = find_solver(content.plane_map).restore(content.parameters)
        except InputError as error:
            raise InputError(f"plane_map: {error}", where=path) from error
        computed, _ = residuals(plane_map, reading)
    if not np.allclose(computed, stored.mm, rtol=0, atol=SAME_MM, equal_nan=True):
        raise InputError("residuals.mm: do not belong to the parameters", where=path)
    return Calibration(
        name=content.plane_map,
        plane_map=plane_map,
        reading=reading,
        residuals_mm=stored.mm,
        residuals_px=stored.px,
        optics=content.optics,
        software=content.software,
        outliers_mm=np.array(content.outliers_mm, dtype=float).reshape(-1, 2),
    )


# The files of the metric route: a metric calibration, or a camera alone, and all it rests on.


METRIC_FORMAT: Final = "lscan-metric-calibration"
CAMERA_FORMAT: Final = "lscan-camera-calibration"
METRIC_VERSION = 1
ALIKE = ("software", "image_size", "optics", "k3")  # what a file and solve.SolvedViews name alike


@dataclass(frozen=True)
class StoredLine(LinePoints):
    """The line of a view that is in a file."""

    __pydantic_config__ = STRICT
    image_px: Matrix
    sigma_px: Vector
    axis: Axis

    def __post_init__(self) -> None:
        """Raise ValueError unless each point has its uncertainty, above 0."""
        count = len(self.sigma_px)
        if self.image_px.shape != (count, 2):
            raise ValueError(f"image_px must hold {count} pairs, one for each of sigma_px")
        if (self.sigma_px <= 0).any():
            raise ValueError("sigma_px must be above 0")


class StoredView(Strict):
    """views.FittedView; ``null`` for a root mean square of nothing."""

    name: str
    marks: StoredMarks | None
    line: StoredLine | None
    fault: str
    used: bool
    marks_used: Count
    rms_px: NotNegativeOrNaN
    line_used: bool
    line_points_used: Count
    line_rms_mm: NotNegativeOrNaN
    reason: str

    @model_validator(mode="after")
    def _used_what_there_is(self) -> Self:
        if self.used and (self.marks is None or np.isnan(self.rms_px) or not self.marks_used):
            raise ValueError("used must be false without marks, marks_used and rms_px")
        if self.line_used and (self.line is None or np.isnan(self.line_rms_mm) or not self.used):
            raise ValueError("line_used must be false without a used view, line and line_rms_mm")
        return self

    def view(self) -> FittedView:
        """As the program holds it."""
        return FittedView(**dict(self))


class StoredViews(Strict):
    """What both files hold: solve.SolvedViews, its sigma as camera_sigma."""

    format: str
    version: Annotated[int, Field(strict=True, ge=1, le=METRIC_VERSION)]
    software: str
    image_size: tuple[Side, Side]
    optics: OpticsSection
    k3: Known
    camera_sigma: Vector
    views: tuple[StoredView, ...]

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.camera_sigma.shape != (COUNT,) or (self.camera_sigma < 0).any():
            raise ValueError(f"camera_sigma must be {COUNT} numbers not below 0")
        return self

    def solved(self) -> dict[str, Any]:
        """The fields of a SolvedViews."""
        views = tuple(view.view() for view in self.views)
        alike = {name: getattr(self, name) for name in ALIKE}
        return alike | {"sigma": self.camera_sigma, "views": views}


class MetricFile(StoredViews):
    """The file of a metric calibration."""

    format: Literal["lscan-metric-calibration"] = METRIC_FORMAT
    plane_map: Literal["metric"]
    parameters: dict[str, Any]

    @model_validator(mode="after")
    def _has_a_line(self) -> Self:
        if not any(view.line_used for view in self.views):
            raise ValueError("views must hold a line that was used")
        return self


class CameraFile(StoredViews):
    """The file of a camera alone.  camera: the parameters of camera and port, by name."""

    format: Literal["lscan-camera-calibration"] = CAMERA_FORMAT
    camera: Annotated[dict[str, Number], AfterValidator(partial(check_theta, names=CAMERA))]

    @model_validator(mode="after")
    def _has_a_view(self) -> Self:
        if not any(view.used for view in self.views):
            raise ValueError("views must hold one that was used")
        return self


Content = TypeVar("Content", bound=StoredViews)


def _stored(calibration: SolvedViews) -> dict[str, Any]:
    """The fields of a StoredViews, but for its format."""
    views = tuple(StoredView.model_validate(asdict(view)) for view in calibration.views)
    alike = {name: getattr(calibration, name) for name in ALIKE}
    return alike | {"version": METRIC_VERSION, "camera_sigma": calibration.sigma, "views": views}


def _content(document: Any, model: type[Content], what: str, path: Path) -> Content:
    """The document as a model; InputError where it is of another format, or not as written."""
    wanted = model.model_fields["format"].default
    if not isinstance(document, dict) or document.get("format") != wanted:
        raise InputError(f"is no {what} calibration", where=path, allowed=f'format "{wanted}"')
    return check(model, document, where=path)


def save_metric(path: Path, calibration: MetricCalibration) -> None:
    """Write the calibration to a file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    calibration : MetricCalibration, with its views

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    parameters = calibration.plane_map.parameters()
    write_file(path, MetricFile(plane_map="metric", parameters=parameters, **_stored(calibration)))


def load_metric(path: Path) -> MetricCalibration:
    """The calibration that was saved in a file; it can be solved again from what it holds.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    return metric_of(read_json(path, MOST_BYTES), path)


def metric_of(document: Any, path: Path) -> MetricCalibration:
    """The calibration in the JSON document of a file.

    Parameters
    ----------
    document : object, as JSON has it
    path : Path, of the file, for messages

    Raises
    ------
    InputError
        As ``load_metric``.
    """
    content = _content(document, MetricFile, "metric", path)
    try:
        with np.errstate(all="ignore"):  # of numbers that make no map
            plane_map = solver.restore("", content.parameters)
    except InputError as error:
        raise InputError(str(error), where=path) from error
    return MetricCalibration(plane_map=plane_map, **content.solved())


def save_camera(path: Path, calibration: CameraCalibration) -> None:
    """Write a camera alone to a file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    calibration : CameraCalibration, with its views

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    camera = dict(zip(CAMERA, calibration.theta.tolist(), strict=True))
    write_file(path, CameraFile(camera=camera, **_stored(calibration)))


def load_camera(path: Path) -> CameraCalibration:
    """The camera alone that was saved in a file.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    content = _content(read_json(path, MOST_BYTES), CameraFile, "camera", path)
    return CameraCalibration(theta=np.array(list(content.camera.values())), **content.solved())


def require_same_camera(
    camera: CameraCalibration, views: ViewsFile, size: tuple[int, int], where: Path
) -> None:
    """Refuse a camera that cannot have taken the pictures of a views file.

    Parameters
    ----------
    camera : CameraCalibration, as loaded
    views : ViewsFile, whose [optics] and k3, where it has them, must be those of the camera
    size : tuple of int, (width, height) of its pictures, px
    where : Path, of the camera's file, for messages

    Raises
    ------
    InputError
        Where the pictures' size or what was known of the optics differs.
    """
    if camera.image_size != size:
        allowed = f"{camera.image_size[0]} x {camera.image_size[1]} px, as the camera's"
        raise InputError("pictures of another size", where=views.path, value=size, allowed=allowed)
    document = views.document
    for key, known in (("optics", camera.optics), ("k3", camera.k3)):
        if key in document.model_fields_set and getattr(document, key) != known:
            raise InputError(
                "differs from what the camera was calibrated with",
                where=f"{views.path}: {key}",
                allowed=f"leave it out, or as in {where}",
            )


# The calibration of a file, whichever route made it.


AnyCalibration = Calibration | MetricCalibration


def load_any(path: Path | str) -> AnyCalibration:
    """The calibration of a file.

    Parameters
    ----------
    path : Path or str, written by ``save_calibration`` or by ``save_metric``

    Raises
    ------
    InputError
        Where the file is no calibration, or is not as it was written.
    """
    path = Path(path)
    document = read_json(path, MOST_BYTES)
    kind = document.get("format") if isinstance(document, dict) else None
    if kind == CAMERA_FORMAT:
        allowed = f"lscan calibrate-metric VIEWS.toml --camera {path.name} -o FILE"
        raise InputError("holds a camera alone, no laser sheet", where=path, allowed=allowed)
    if kind == METRIC_FORMAT:
        return metric_of(document, path)
    return calibration_of(document, path)


def save_any(path: Path, calibration: AnyCalibration) -> None:
    """Write a calibration to a file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    calibration : Calibration or MetricCalibration

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    if isinstance(calibration, MetricCalibration):
        save_metric(path, calibration)
    else:
        save_calibration(path, calibration)


def load_plane_map(path: Path | str) -> tuple[PlaneMap, tuple[int, int]]:
    """The plane map of a calibration file, and the (width, height) in px of its pictures.

    Parameters
    ----------
    path : Path or str, written by ``save_calibration`` or by ``save_metric``

    Raises
    ------
    InputError
        Where the file is no calibration, or is not as it was written.

    Examples
    --------
    >>> import lscan
    >>> plane_map, size_px = lscan.load_plane_map("calibration.json")
    >>> plane_map.name, size_px
    ('graticule-2', (640, 480))
    """
    calibration = load_any(path)
    return calibration.plane_map, calibration.image_size
