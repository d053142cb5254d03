"""The report's figures as their words in figures.toml have them."""

from matplotlib.figure import Figure

from lscan.figures import style
from lscan.figures.style import ReportFigure
from lscan.files.disk import packaged_table
from lscan.records import Bytes

_TABLE = packaged_table("lscan.paper.figures", "figures.toml")


def drawn(name: str, figure: Figure, /, **found: object) -> ReportFigure:
    """The drawn figure with the words of that name, ``found`` put into them."""
    words = words_of(name, **found)
    return ReportFigure(**words, body=style.svg(figure, words["key"], words["alt"]))


def photographed(name: str, image: Bytes, overlay: str = "", /, **found: object) -> ReportFigure:
    """The picture as ``style.photograph`` has it, with the words of that name."""
    words = words_of(name, **found)
    return ReportFigure(**words, body=style.photograph(image, overlay, words["alt"]))


def words_of(name: str, /, **found: object) -> dict[str, str]:
    """Key, title, paper's figure, picture in words and caption, as ReportFigure takes them."""
    templates = {"key": name, **_TABLE[name]}
    return {part: text.format(**found).replace("\n", " ") for part, text in templates.items()}
