"""The file of a camera that was calibrated by itself, without a laser sheet."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from lscan.calibration.file import MOST_BYTES, Side, write_file
from lscan.calibration.multiview.file import StoredView
from lscan.calibration.multiview.solve import CameraCalibration
from lscan.calibration.multiview.viewsfile import ViewsFile
from lscan.calibration.stored import Number, Vector, check_theta
from lscan.camera.parameters import CAMERA, COUNT
from lscan.config.documents import Strict, check, read_json
from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError

FORMAT: Final = "lscan-camera-calibration"
VERSION = 1


class CameraFile(Strict):
    """The whole file.

    camera, camera_sigma: the parameters of camera and port, by name, and their uncertainties.
    """

    format: Literal["lscan-camera-calibration"] = FORMAT
    version: Annotated[int, Field(strict=True, ge=1, le=VERSION)]
    software: str
    image_size: tuple[Side, Side]
    optics: OpticsSection
    k3: Known
    camera: Annotated[dict[str, Number], AfterValidator(partial(check_theta, names=CAMERA))]
    camera_sigma: Vector
    views: tuple[StoredView, ...]

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.camera_sigma.shape != (COUNT,) or (self.camera_sigma < 0).any():
            raise ValueError(f"camera_sigma must be {COUNT} numbers not below 0")
        if not any(view.used for view in self.views):
            raise ValueError("views must hold one that was used")
        return self


def save_camera(path: Path, calibration: CameraCalibration) -> None:
    """Write the camera to a file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    calibration : CameraCalibration, with its views

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    content = CameraFile(
        version=VERSION,
        software=calibration.software,
        image_size=calibration.image_size,
        optics=calibration.optics,
        k3=calibration.k3,
        camera=dict(zip(CAMERA, calibration.theta.tolist(), strict=True)),
        camera_sigma=calibration.sigma,
        views=tuple(StoredView.model_validate(asdict(view)) for view in calibration.views),
    )
    write_file(path, content)


def load_camera(path: Path) -> CameraCalibration:
    """The camera that was saved in a file.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    document = read_json(path, MOST_BYTES)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError("is no camera calibration", where=path, allowed=f'format "{FORMAT}"')
    content = check(CameraFile, document, where=path)
    return CameraCalibration(
        theta=np.array(list(content.camera.values())),
        views=tuple(view.view() for view in content.views),
        optics=content.optics,
        k3=content.k3,
        image_size=content.image_size,
        sigma=content.camera_sigma,
        software=content.software,
    )


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
