"""From electrons to the bytes of a picture: full well, gain, gamma, 8 bit, MJPEG."""

import cv2
import numpy as np

from lscan.records import Bytes
from sim.scene.instrument import FULL_SCALE_DN, Sensor
from sim.sensor.colour import ColourFilter, Picture

SUBSAMPLING = {
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}


def digitise(electrons: Picture, sensor: Sensor, colours: ColourFilter | None = None) -> Bytes:
    """Digital numbers of the electrons: full well, gain, filled in colours, gamma, 8 bit, frame.

    The same shape; (H, W, 3) RGB of the (H, W) electrons behind a colour filter.

    Parameters
    ----------
    electrons : array, electrons read out
    sensor : Sensor, its gain, gamma, black level, full well, range and frame
    colours : ColourFilter or None, the filter before the pixels
    """
    linear = np.minimum(electrons, np.float32(sensor.full_well_e))
    linear *= np.float32(_gain(sensor))
    linear += np.float32(sensor.black_level_dn)
    # Dark noise may pull a pixel below zero electrons; only the black level keeps it in range.
    np.clip(linear, 0.0, FULL_SCALE_DN, out=linear)
    if colours is not None:
        linear = colours.demosaic(linear)
    if sensor.gamma != 1:
        linear = FULL_SCALE_DN * (linear / FULL_SCALE_DN) ** (1 / sensor.gamma)
    image = np.minimum(np.rint(linear, out=linear).astype(np.uint8), np.uint8(sensor.clips_dn))
    if sensor.frame_dn is not None:
        image[[0, -1]] = image[:, [0, -1]] = sensor.frame_dn
    return image


def electrons_of(dn: float, sensor: Sensor) -> float:
    """Electrons that ``digitise`` makes ``dn`` of, as far as full well and range go.

    Zero or less where ``dn`` is not above the black level.

    Parameters
    ----------
    dn : float, grey value, DN, 0 to 255
    sensor : Sensor, its gain, gamma, black level and full well
    """
    linear = FULL_SCALE_DN * (min(dn, sensor.clips_dn) / FULL_SCALE_DN) ** sensor.gamma
    return min((linear - sensor.black_level_dn) / _gain(sensor), sensor.full_well_e)


def through_jpeg(image: Bytes, sensor: Sensor) -> Bytes:
    """The picture coded and decoded as one of MJPEG's; unchanged without one.

    Parameters
    ----------
    image : (H, W, 3) uint8 array, RGB
    sensor : Sensor, its quality and subsampling
    """
    if sensor.jpeg_quality is None:
        return image
    return from_jpeg(jpeg_bytes(image, sensor.jpeg_quality, sensor.jpeg_subsampling))


def jpeg_bytes(image: Bytes, quality: int, subsampling: str) -> bytes:
    """The picture as a JPEG file.

    Parameters
    ----------
    image : (H, W, 3) uint8 array, RGB
    quality : int, 1 to 100, as libjpeg counts
    subsampling : str, of the chroma, a key of SUBSAMPLING
    """
    settings = [
        cv2.IMWRITE_JPEG_QUALITY, quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SUBSAMPLING[subsampling],
    ]  # fmt: skip
    _, coded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    return coded.tobytes()


def from_jpeg(coded: bytes) -> Bytes:
    """The picture of a JPEG file that ``jpeg_bytes`` made; (H, W, 3) uint8, RGB.

    Parameters
    ----------
    coded : bytes, the whole file
    """
    decoded = cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _gain(sensor: Sensor) -> float:
    """DN per electron."""
    return sensor.gain * FULL_SCALE_DN / sensor.full_well_e
