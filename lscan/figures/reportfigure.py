"""A figure ready for a page, and numbers as a page writes them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportFigure:
    """A figure ready for a page.

    Attributes
    ----------
    key : str, short name, unique on the page
    title : str, what is shown, a few words
    paper : str, the paper's figure, such as "Fig. 13"
    alt : str, the picture in words
    caption : str, what is seen, and the finding with its numbers
    body : str, self-contained HTML: an inline SVG, or a canvas with its script
    script : str, JavaScript to run after the page's plotting library, "" for a still picture
    """

    key: str
    title: str
    paper: str
    alt: str
    caption: str
    body: str
    script: str = ""


def signed(value: float, digits: int) -> str:
    """The number as text with its sign, + or a true minus.

    Parameters
    ----------
    value : float, in any unit
    digits : int, decimals

    Examples
    --------
    >>> signed(-0.256, 2)
    '−0.26'
    """
    return f"{value:+.{digits}f}".replace("-", "−")
