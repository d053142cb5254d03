"""A figure ready for a page, and numbers as a page writes them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportFigure:
    """A figure ready for a page.

    key: short name, unique on the page.  title: what is shown, a few words.
    paper: the paper's figure, such as "Fig. 13".  alt: the picture in words.
    caption: what is seen, and the finding with its numbers.
    body: self-contained HTML: an inline SVG, or a canvas with its script.
    script: JavaScript to run after the page's plotting library, "" for a still picture.
    """

    key: str
    title: str
    paper: str
    alt: str
    caption: str
    body: str
    script: str = ""


def signed(value: float, digits: int) -> str:
    """The number with its sign, + or a true minus, and so many decimals."""
    return f"{value:+.{digits}f}".replace("-", "−")
