"""Pages: a figure ready for one, numbers as it writes them, and its template of Jinja2.

Nothing is drawn here and Jinja is loaded late: who imports a report loads no plotting library.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Template


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


def signed_number(value: float, digits: int) -> str:
    """The number as text with its sign, + or a true minus.

    Parameters
    ----------
    value : float, in any unit
    digits : int, decimals

    Examples
    --------
    >>> signed_number(-0.256, 2)
    '−0.26'
    """
    return f"{value:+.{digits}f}".replace("-", "−")


def page_template(package: str, name: str, **filters: Callable[..., object]) -> "Template":
    """The template of a page.

    Parameters
    ----------
    package, name : str
        The package that holds the file, and the file's name.
    **filters : callable
        Functions that the template uses, by their names there.

    Returns
    -------
    jinja2.Template
        What is filled in is escaped; a value that the template needs and does not get is an error.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(package, ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters)
    return environment.get_template(name)
