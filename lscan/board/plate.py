"""A calibration board as a drawing at its true size, for a printer or a milling machine."""

from jinja2 import Environment, PackageLoader, StrictUndefined

from lscan.config.board import Board

CHECK_BAR_MM = 100.0
STRIP_MM = 15.0  # beneath the plate, for the bar
PAPER, INK = "#ffffff", "#000000"


def board_svg(board: Board) -> str:
    """SVG of the board's face, one unit a millimetre, as large as the plate and a strip beneath.

    The strip holds a bar of 100 mm (of the plate's width, where that is less) by which a print
    can be checked with a ruler, since printers may scale.  Marks of a bright-dot board are white
    on black.

    Parameters
    ----------
    board : Board, mm, its plate and marks
    """
    left, right, bottom, top = board.outline_mm()
    plate, mark = (PAPER, INK) if board.marks == "dark" else (INK, PAPER)
    environment = Environment(
        loader=PackageLoader("lscan.board", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["mm"] = _mm
    return environment.get_template("plate.svg.j2").render(
        board=board,
        left=left,
        top=top,
        width=right - left,
        height=top - bottom,
        strip=STRIP_MM,
        plate=plate,
        mark=mark,
        ink=INK,
        bar=min(CHECK_BAR_MM, right - left),
        bar_y=STRIP_MM / 2 - bottom,
    )


def _mm(value: float) -> str:
    """The number without a tail: a micrometre is finer than any printer."""
    return f"{round(float(value), 4) + 0.0:.10g}"
