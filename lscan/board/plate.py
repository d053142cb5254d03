"""A calibration board as a drawing at its true size, for a printer or a milling machine."""

from lscan.config.board import Board

CHECK_BAR_MM = 100.0
PAPER, INK = "#ffffff", "#000000"


def board_svg(board: Board) -> str:
    """SVG of the board's face, one unit a millimetre, as large as the plate and a strip beneath.

    The strip holds a bar of 100 mm (of the plate's width, where that is less) by which a print
    can be checked with a ruler: printers like to scale.  Marks of a bright-dot board are white
    on black.

    Parameters
    ----------
    board : Board, mm, its plate and marks
    """
    left, right, bottom, top = board.outline_mm()
    plate, mark = (PAPER, INK) if board.marks == "dark" else (INK, PAPER)
    width, height, strip = right - left, top - bottom, 15.0
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_mm(width)}mm" '
        f'height="{_mm(height + strip)}mm" '
        f'viewBox="{_mm(left)} {_mm(-top)} {_mm(width)} {_mm(height + strip)}">',
        f'<rect id="plate" x="{_mm(left)}" y="{_mm(-top)}" width="{_mm(width)}" '
        f'height="{_mm(height)}" fill="{plate}" stroke="{INK}" stroke-width="0.1"/>',
        f'<g id="marks" fill="{mark}">',
        *(_disc(x, z, diameter) for x, z, diameter in board.discs_mm()),
        "</g>",
        f'<g id="rings" fill="none" stroke="{mark}">',
        *(
            f'<circle id="{ring.name}" cx="{_mm(ring.x_mm)}" cy="{_mm(-ring.z_mm)}" '
            f'r="{_mm(ring.diameter_mm / 2)}" stroke-width="{_mm(ring.width_mm)}"/>'
            for ring in board.ring
        ),
        "</g>",
        *_check_bar(left, -bottom + strip / 2, min(CHECK_BAR_MM, width)),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _disc(x_mm: float, z_mm: float, diameter_mm: float) -> str:
    return f'<circle cx="{_mm(x_mm)}" cy="{_mm(-z_mm)}" r="{_mm(diameter_mm / 2)}"/>'


def _check_bar(x_mm: float, y_mm: float, length_mm: float) -> list[str]:
    ends = (x_mm, x_mm + length_mm)
    path = f"M{_mm(ends[0])} {_mm(y_mm)}H{_mm(ends[1])}"
    path += "".join(f"M{_mm(end)} {_mm(y_mm - 2)}v4" for end in ends)
    return [
        f'<path id="check" d="{path}" stroke="{INK}" stroke-width="0.2" fill="none"/>',
        f'<text x="{_mm(x_mm)}" y="{_mm(y_mm + 6)}" font-size="4" font-family="sans-serif">'
        f"{_mm(length_mm)} mm</text>",
    ]


def _mm(value: float) -> str:
    """The number without a tail: a micrometre is finer than any printer."""
    return f"{round(float(value), 4) + 0.0:.10g}"
