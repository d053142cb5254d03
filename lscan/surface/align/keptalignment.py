"""An alignment kept in a file: the yaw and level of a rig, found once from a scan of the block.

The sheet's yaw against the track and the level of what stands in the tank stay as they are from
scan to scan, but only the sandwave block with its wedges shows them.  A scan of it gives the
alignment that scans of other targets are then brought into the block's frame with.

The alignment errs with each of the calibration's errors, which displaced the block's points, and
by noise of its own.  A target scanned with the same calibration is displaced by the same errors,
and what levelling the block took out of them is taken out of its points too.  With another
calibration they are independent.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from lscan.calibration.planemap import Matrix, Place, Vector, check_covariance, of_length
from lscan.config.documents import Strict, check
from lscan.config.targets import Sandwave
from lscan.errors import InputError
from lscan.files.disk import read_json, write_json
from lscan.records import Floats, Provenance, Surface
from lscan.surface.align.alignment import Alignment
from lscan.surface.align.datum import PARAMETERS, YAW
from lscan.surface.provenance import StoredProvenance
from lscan.version import __version__

FORMAT: Final = "lscan-alignment"
VERSION = 1

ORTHONORMAL = 1e-9
"""How far the product of a rotation with its transpose may be from one: rounding is 1e-15."""

LARGEST = 1e6
"""Of any number of the file, mm or degrees: a kilometre."""

IN_FILE = np.array([180 / np.pi] * 4 + [1.0] * 3)
"""From the parameters' units to those of a file: four angles in degrees, three shifts in mm."""


@dataclass(frozen=True)
class KeptAlignment:
    """An alignment, and the scan it was found in.

    Attributes
    ----------
    alignment : Alignment, as found
    provenance : Provenance, of the scan it was found in
    source : str, where it is from, in words
    """

    alignment: Alignment
    provenance: Provenance
    source: str

    def of(self, raw: Surface) -> Alignment:
        """The alignment as it errs in another surface.

        Parameters
        ----------
        raw : Surface, frame of the head
        """
        count = 0 if raw.modes_mm is None else raw.modes_mm.shape[-1]
        given = raw.provenance.calibration_sha256 if raw.provenance else None
        same = given == self.provenance.calibration_sha256
        modes = self.alignment.modes
        if same and modes.shape[1] == count + PARAMETERS:
            return self.alignment
        independent = np.hstack([np.zeros((PARAMETERS, count)), modes])
        return replace(self.alignment, modes=independent)


Triple = Annotated[Vector, of_length(3)]


class DeterminedFrom(StoredProvenance):
    """The scan an alignment was found in."""

    workpiece: Sandwave


def _rotation(matrix: Floats) -> Floats:
    """The matrix; ValueError where it is no rotation."""
    if matrix.shape == (3, 3) and np.abs(matrix).max() < 2:  # larger ones overflow
        off = np.abs(matrix @ matrix.T - np.eye(3)).max()
        if off < ORTHONORMAL and np.linalg.det(matrix) > 0:
            return matrix
    raise ValueError("must be a rotation, 3 by 3")


class AlignmentFile(Strict):
    """The whole file.

    rotation, translation_mm: as of alignment.Alignment.  covariance: of the alignment's own
    errors, in the order of datum.py: rotations about x, y and z, yaw (degrees), shifts (mm), all
    about the pivot.  by_calibration: change of these parameters by each independent error of the
    calibration that is one standard deviation large.
    """

    format: Literal["lscan-alignment"] = FORMAT
    version: Annotated[int, Field(strict=True, ge=1, le=VERSION)]
    software: str
    determined_from: DeterminedFrom
    yaw_deg: Annotated[float, Field(ge=-45, le=45)]
    rotation: Annotated[Matrix, AfterValidator(_rotation)]
    translation_mm: Triple
    base_mm: float
    left_corner_mm: Place
    right_corner_mm: Place
    pivot_mm: Triple
    covariance: Matrix
    by_calibration: Annotated[Matrix, of_length(PARAMETERS)]

    @model_validator(mode="after")
    def _usable(self) -> Self:
        check_covariance(self.covariance, PARAMETERS)
        for name in ("translation_mm", "pivot_mm", "covariance", "by_calibration"):
            if np.abs(getattr(self, name)).max(initial=0.0) > LARGEST:
                raise ValueError(f"{name} must hold no number above {LARGEST:g}")
        values = np.linalg.eigvalsh(self.covariance / _scales(self.covariance))
        if values[0] < -ORTHONORMAL:
            raise ValueError("covariance must be that of seven quantities: none is below nought")
        return self

    def alignment(self) -> Alignment:
        """As the program holds it."""
        modes = np.hstack([self.by_calibration, _root(self.covariance)]) / IN_FILE[:, None]
        return Alignment(
            yaw_rad=float(np.radians(self.yaw_deg)),
            yaw_sigma_rad=float(np.linalg.norm(modes[YAW])),
            rotation=self.rotation,
            translation_mm=self.translation_mm,
            normal=self.rotation[2],
            base_mm=self.base_mm,
            left_corner_mm=self.left_corner_mm,
            right_corner_mm=self.right_corner_mm,
            pivot_mm=self.pivot_mm,
            modes=modes,
        )


def save_alignment(
    path: Path, alignment: Alignment, provenance: Provenance, piece: Sandwave
) -> None:
    """Write an alignment to a JSON file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    alignment : Alignment, found in a scan of the sandwave along a linear track
    provenance : Provenance, of that scan's surface
    piece : Sandwave, the block's nominal shape

    Raises
    ------
    InputError
        Where the scan was made about a shaft, or the file cannot be written.
    """
    if not alignment.sheared:
        raise InputError(
            "a scan about a shaft has no yaw to keep", where=path, allowed="a linear track"
        )
    modes = alignment.modes * IN_FILE[:, None]
    count = modes.shape[1] - PARAMETERS
    own = modes[:, count:]
    content = AlignmentFile(
        version=VERSION,
        software=__version__,
        determined_from=DeterminedFrom(workpiece=piece, **asdict(provenance)),
        yaw_deg=float(np.degrees(alignment.yaw_rad)),
        rotation=alignment.rotation,
        translation_mm=alignment.translation_mm,
        base_mm=alignment.base_mm,
        left_corner_mm=alignment.left_corner_mm,
        right_corner_mm=alignment.right_corner_mm,
        pivot_mm=alignment.pivot_mm,
        covariance=own @ own.T,
        by_calibration=modes[:, :count],
    )
    write_json(path, content.model_dump(mode="json"))


def load_alignment(path: Path) -> KeptAlignment:
    """The alignment that was saved in a file.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError("is no alignment", where=path, allowed=f'format "{FORMAT}"')
    content = check(AlignmentFile, document, where=path)
    provenance = content.determined_from.provenance()
    return KeptAlignment(
        content.alignment(), provenance, f"the block scanned with {provenance.rig!r}"
    )


def _scales(covariance: Floats) -> Floats:
    """(P, P) products of standard deviations, 1 for those that are 0."""
    sigma = np.sqrt(np.diag(covariance))
    sigma = np.where(sigma > 0, sigma, 1.0)
    return np.outer(sigma, sigma)


def _root(covariance: Floats) -> Floats:
    """(P, P) matrix whose product with its transpose is the covariance; it may be singular."""
    scales = _scales(covariance)
    values, vectors = np.linalg.eigh(covariance / scales)
    return np.asarray(
        np.sqrt(np.diag(scales))[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    )
