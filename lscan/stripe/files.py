"""The line of one picture as a table."""

from pathlib import Path

from lscan.files.disk import write_atomically
from lscan.records import Status, Stripe


def save_stripe(path: Path, stripe: Stripe) -> None:
    """Write the stripe as CSV: one row a column (or row), empty fields where there is no line.

    Parameters
    ----------
    path : Path, of the file
    stripe : Stripe, px and DN

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    along = "column" if stripe.axis == "columns" else "row"
    lines = [f"{along},centre_px,sigma_px,peak_dn,status"]
    rows = zip(stripe.centre_px, stripe.sigma_px, stripe.peak, stripe.status, strict=True)
    for index, (centre, sigma, peak, status) in enumerate(rows):
        fields = (_field(value) for value in (centre, sigma, peak))
        lines.append(f"{index},{','.join(fields)},{Status(status).name}")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _field(value: float) -> str:
    return "" if value != value else repr(float(value))
