"""The line of one picture as a table."""

from pathlib import Path

import numpy as np

from lscan.files.disk import write_atomically
from lscan.records import PlanePoints, Status, Stripe


def save_stripe(path: Path, stripe: Stripe, points: PlanePoints | None = None) -> None:
    """Write the stripe as CSV: one row a column (or row), empty fields where there is no line.

    Parameters
    ----------
    path : Path, of the file
    stripe : Stripe, px and DN, of N entries
    points : PlanePoints, optional, mm, the N points in the laser sheet: five columns more

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    along = "column" if stripe.axis == "columns" else "row"
    heading = f"{along},centre_px,sigma_px,peak_dn,status"
    numbers = np.column_stack([stripe.centre_px, stripe.sigma_px, stripe.peak])
    table = [
        f"{index},{_fields(row)},{Status(status).name}"
        for index, (row, status) in enumerate(zip(numbers, stripe.status, strict=True))
    ]
    if points is not None:
        heading += ",x_mm,z_mm,sigma_x_mm,sigma_z_mm,status_mm"
        in_mm = np.hstack([points.xz_mm, points.sigma_mm])
        table = [
            f"{line},{_fields(row)},{Status(status).name}"
            for line, row, status in zip(table, in_mm, points.status, strict=True)
        ]
    write_atomically(path, ("\n".join([heading, *table]) + "\n").encode())


def _fields(values: np.ndarray) -> str:
    return ",".join("" if np.isnan(value) else repr(float(value)) for value in values)
