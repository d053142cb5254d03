"""The calibration file: its JSON layout, strict reading, and writing whole or not at all.

There are three kinds, told by their format word: the plane map of one picture of the board, the
metric calibration from several, and the camera of such a calibration alone.  Each holds the
parameters with their covariances, what was known of the optics, the marks it rests on and what
was left of them, image size and software: data only, and all that is needed to solve it again.
"""

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, TypeVar, cast

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
from lscan.calibration.fields import (
    STRICT,
    Count,
    FloatsWithGaps,
    Matrix,
    NotNegativeOrNaN,
    Number,
    Place,
    Sigmas,
    Vector,
    check_theta,
)
from lscan.calibration.maps.auto import with_chosen
from lscan.calibration.maps.spline import with_hidden_errors
from lscan.calibration.metric.planemap import Metric
from lscan.calibration.metric.solve import CameraCalibration, MetricCalibration
from lscan.calibration.metric.views import FittedView, LinePoints, ViewsFile
from lscan.calibration.planemap import PlaneMap, SolvedMap, find_solver
from lscan.camera.optics import stated_port
from lscan.camera.posedboards import CAMERA, COUNT, NEWER, with_newer
from lscan.config.documents import Strict, check
from lscan.config.rig import Known, LensKind, OpticsSection
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
METRIC_FORMAT: Final = "lscan-metric-calibration"
CAMERA_FORMAT: Final = "lscan-camera-calibration"
MOST_BYTES: Final = 32 * 2**20
"""Of a calibration file of any kind; those of the paper's board have half a megabyte."""
SAME_MM = 1e-6  # residuals that belong to the parameters agree this well on any machine

AnyCalibration = Calibration | MetricCalibration


def load_plane_map(path: Path | str) -> tuple[PlaneMap, tuple[int, int]]:
    """The plane map of a calibration file, and the (width, height) in px of its pictures.

    Parameters
    ----------
    path : Path or str, written by ``save_calibration``

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


def load_any(path: Path | str) -> AnyCalibration:
    """The calibration of a file, from one picture or from several.

    Parameters
    ----------
    path : Path or str, written by ``save_calibration``

    Raises
    ------
    InputError
        Where the file is no calibration, or is not as it was written.
    """
    path = Path(path)
    content: CalibrationFile | MetricFile | CameraFile
    content = _content(path, CalibrationFile, MetricFile, CameraFile)
    if isinstance(content, CameraFile):
        allowed = f"lscan calibrate-metric VIEWS.toml --camera {path.name} -o FILE"
        raise InputError("holds a camera alone, no laser sheet", where=path, allowed=allowed)
    return content.calibration(path)


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
    return _content(Path(path), CalibrationFile).calibration(Path(path))


def load_metric(path: Path) -> MetricCalibration:
    """The metric calibration that was saved in a file; it can be solved again from what it holds.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    return _content(path, MetricFile).calibration(path)


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
    content = _content(path, CameraFile)
    return CameraCalibration(theta=np.array([*content.camera.values()]), **content.solved_fields())


def save_calibration(path: Path | str, calibration: AnyCalibration | CameraCalibration) -> None:
    """Write the calibration to a file: a whole file or none.

    Parameters
    ----------
    path : Path or str, of the file
    calibration : Calibration, MetricCalibration or CameraCalibration

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
    model: type[Strict] = CalibrationFile
    fields: dict[str, Any]
    if isinstance(calibration, Calibration):
        fields = {
            "plane_map": calibration.name,
            "parameters": calibration.plane_map.parameters(),
            "reading": asdict(calibration.reading),
            "residuals": {"mm": calibration.residuals_mm, "px": calibration.residuals_px},
            "outliers_mm": tuple(calibration.outliers_mm),
        }
    else:
        fields = {
            "image_size": calibration.image_size,
            "k3": calibration.k3,
            "lens": calibration.lens,
            "camera_sigma": calibration.sigma,
            "views": tuple(map(asdict, calibration.views)),
        }
        if isinstance(calibration, CameraCalibration):
            model = CameraFile
            fields["camera"] = dict(zip(CAMERA, calibration.theta.tolist(), strict=True))
        else:
            model = MetricFile
            fields |= {"plane_map": "metric", "parameters": calibration.plane_map.parameters()}
    fields |= {"software": calibration.software, "optics": calibration.optics}
    content = check(model, fields, where=path).model_dump(mode="json")
    text = json.dumps(content, indent=1, allow_nan=False)
    write_atomically(Path(path), (text + "\n").encode())


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
            what = "differs from what the camera was calibrated with"
            allowed = f"leave it out, or as in {where}"
            raise InputError(what, where=f"{views.path}: {key}", allowed=allowed)


# What the files hold: the records, their arrays as lists and ``null`` for NaN.


Side = Annotated[int, Field(strict=True, gt=0)]


if TYPE_CHECKING:
    Code = Status
    Codes = Ints
else:  # names in the file
    Code = Annotated[
        Literal["OK", "NOT_FOUND", "OUT_OF_VIEW"],
        BeforeValidator(lambda code: getattr(code, "name", code)),
        AfterValidator(Status.__getitem__),
        PlainSerializer(lambda code: code.name),
    ]
    Codes = Annotated[
        tuple[Code, ...],
        BeforeValidator(lambda codes: [*map(Status, codes)] if hasattr(codes, "dtype") else codes),
        AfterValidator(partial(np.array, dtype=np.int64)),
        PlainSerializer(lambda codes: [Status(code).name for code in codes]),
    ]


class StoredPlaces:
    """Base of the records with places in the picture, as they are in a file."""

    __pydantic_config__ = STRICT

    def __post_init__(self) -> None:
        """Raise ValueError unless each place has its sigma, and both just where status is OK."""
        record: Any = self
        image_px, sigma_px = record.image_px, np.atleast_1d(record.sigma_px)
        if isinstance(record, Mark):
            image_px = image_px[None]
        found = np.atleast_1d(getattr(record, "status", np.zeros_like(sigma_px))) == Status.OK
        count = len(found)
        if image_px.shape != (count, 2) or sigma_px.shape != (count,):
            each = f"for each of {count} places"
            raise ValueError(f"image_px must hold one pair, and sigma_px one number, {each}")
        if isinstance(record, Marks) and record.board_mm.shape != (count, 2):
            raise ValueError(f"board_mm must hold {count} pairs, one per status")
        if (np.isfinite([*image_px.T, sigma_px]) != found).any():
            raise ValueError("image_px and sigma_px must be numbers, null where status is not OK")


@dataclass(frozen=True)
class StoredMarks(StoredPlaces, Marks):
    """Marks that are in a file; ``null`` where one has no place."""

    board_mm: Matrix
    image_px: FloatsWithGaps
    sigma_px: Sigmas
    status: Codes


@dataclass(frozen=True)
class StoredMark(StoredPlaces, Mark):
    """A mark that is in a file; ``null`` where it has no place."""

    image_px: FloatsWithGaps
    sigma_px: NotNegativeOrNaN
    status: Code


@dataclass(frozen=True)
class StoredRing(StoredPlaces, RingPoints):
    """Points of a ring that are in a file."""

    image_px: Annotated[
        FloatsWithGaps, AfterValidator(lambda px: px if px.size else px.reshape(0, 2))
    ]
    sigma_px: Sigmas


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


class StoredResiduals(Strict):
    """Map of each control point less its nominal place, N pairs; ``null`` where there is none."""

    mm: FloatsWithGaps
    px: FloatsWithGaps


@dataclass(frozen=True)
class StoredLine(StoredPlaces, LinePoints):
    """The line of a view that is in a file."""

    image_px: Matrix
    sigma_px: Vector
    axis: Axis

    def __post_init__(self) -> None:
        """Raise ValueError unless each point has its uncertainty, above 0."""
        super().__post_init__()
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


class CalibrationFile(Strict):
    """The file of a calibration from one picture."""

    format: Literal["lscan-calibration"] = FORMAT
    version: Literal[2] = 2  # 2: marks with status and sigma for dots and rings; optics
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

    def calibration(self, path: Path) -> Calibration:
        """As the program holds it; InputError where map and residuals do not belong together."""
        reading, stored = BoardReading(**dict(self.reading)), self.residuals
        plane_map = _plane_map(self, path)
        with np.errstate(all="ignore"):  # numbers that make no map do not give these residuals
            computed, _ = residuals(plane_map, reading)
        if not np.allclose(computed, stored.mm, rtol=0, atol=SAME_MM, equal_nan=True):
            raise InputError("residuals.mm: do not belong to the parameters", where=path)

        def with_error(solved: SolvedMap) -> SolvedMap:
            """As the solver has it; the file states what was added to the lack of fit since."""
            beside = cast(SolvedMap, with_hidden_errors(solved, reading, self.optics))
            return beside.model_copy(update={"lack_of_fit_mm": solved.lack_of_fit_mm})

        return Calibration(
            name=self.plane_map,
            plane_map=with_chosen(plane_map, with_error),
            reading=reading,
            residuals_mm=stored.mm,
            residuals_px=stored.px,
            optics=self.optics,
            software=self.software,
            outliers_mm=np.array(self.outliers_mm, dtype=float).reshape(-1, 2),
        )


def _sigma_of_camera(sigma: Floats) -> Floats:
    return with_newer(sigma, COUNT - len(NEWER))


class StoredViews(Strict):
    """What both files of the metric route hold: solve.SolvedViews, its sigma as camera_sigma."""

    format: str
    version: Literal[1] = 1
    software: str
    image_size: tuple[Side, Side]
    optics: OpticsSection
    k3: Known
    camera_sigma: Annotated[Vector, AfterValidator(_sigma_of_camera)]
    lens: LensKind = "brown"  # older files know no other
    views: tuple[StoredView, ...]

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.camera_sigma.shape != (COUNT,) or (self.camera_sigma < 0).any():
            raise ValueError(f"camera_sigma must be {COUNT} numbers not below 0")
        return self

    def solved_fields(self) -> dict[str, Any]:
        """The fields of a SolvedViews."""
        return {
            "software": self.software,
            "image_size": self.image_size,
            "optics": self.optics,
            "k3": self.k3,
            "lens": self.lens,
            "sigma": self.camera_sigma,
            "views": tuple(FittedView(**dict(view)) for view in self.views),
        }


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

    def calibration(self, path: Path) -> MetricCalibration:
        """As the program holds it; InputError where the parameters make no map."""
        plane_map = cast(Metric, _plane_map(self, path))
        return MetricCalibration(plane_map=plane_map, **self.solved_fields())


class CameraFile(StoredViews):
    """The file of a camera alone.  camera: the parameters of camera and port, by name."""

    format: Literal["lscan-camera-calibration"] = CAMERA_FORMAT
    camera: Annotated[dict[str, Number], AfterValidator(partial(check_theta, names=CAMERA))]

    @model_validator(mode="after")
    def _has_a_view(self) -> Self:
        if not any(view.used for view in self.views):
            raise ValueError("views must hold one that was used")
        return self


File = TypeVar("File", bound=CalibrationFile | MetricFile | CameraFile)


def _content(path: Path, *models: type[File]) -> File:
    """The file as that of the models whose format word it has; InputError where there is none."""
    document = read_json(path, MOST_BYTES)
    kind = document.get("format") if isinstance(document, dict) else None
    formats = {model.model_fields["format"].default: model for model in models}
    if (model := formats.get(str(kind))) is None:
        wanted = next(iter(formats))
        what = f"is no {wanted.removeprefix('lscan-').replace('-', ' ')} file"
        raise InputError(what, where=path, value=kind, allowed=f'format "{wanted}"')
    version, written = document.get("version"), model.model_fields["version"].default
    if type(version) is not int or version != written:
        what = "version: is not the one this program writes; calibrate again from the pictures"
        raise InputError(what, where=path, value=version, allowed=written)
    return check(model, document, where=path)


def _plane_map(content: CalibrationFile | MetricFile, path: Path) -> PlaneMap:
    """The map of the parameters; InputError where they make none."""
    with np.errstate(all="ignore"):
        try:
            plane_map = find_solver(content.plane_map).restore(content.parameters)
        except InputError as error:
            raise InputError(f"plane_map: {error}", where=path) from error
    port = {"stated_port": stated_port(content.optics)}  # older files' maps do not say it
    return with_chosen(plane_map, lambda solved: solved.model_copy(update=port))
