"""The line as the centroid of the light about each column's brightest pixel."""

import numpy as np

from lscan.records import Status, Stripe

HALF_WIDTH = 6


def find_line(image, settings, clipped):
    """The line across the columns of a picture, as lscan asks an extractor for it."""
    padded = np.pad(image, ((HALF_WIDTH, HALF_WIDTH), (0, 0)), mode="edge")
    peak = image.argmax(axis=0)
    rows = peak + np.arange(2 * HALF_WIDTH + 1)[:, np.newaxis]
    around = np.take_along_axis(padded, rows, axis=0)
    light = np.maximum(around - np.median(image, axis=0), 0.0)
    total = np.maximum(light.sum(axis=0), 1e-9)
    places = np.clip(rows - HALF_WIDTH, 0, len(image) - 1)
    centre = (light * places).sum(axis=0) / total
    width = np.sqrt((light * (places - centre) ** 2).sum(axis=0) / total)
    height = image.max(axis=0) - np.median(image, axis=0)
    found = height >= settings.threshold_dn
    nothing = np.where(found, 0.0, np.nan)
    return Stripe(
        axis="columns",
        centre_px=centre + nothing,
        sigma_px=np.maximum(2 * width / np.sqrt(total), 0.02) + nothing,
        peak=height + nothing,
        status=np.where(found, Status.OK, Status.NO_PEAK).astype(np.int64),
    )
