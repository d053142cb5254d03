"""The control points of the calibration board, found in one picture (Sec. III.1, Figs. 8 to 12).

``read_board`` (reader) goes through these modules: ``picture`` (grey values, negative, ground, the
centre of a mark), ``search`` (the three first dots, and the adaptive search from dot to dot),
``lattice`` (which dot is which, the local map, is this the board?) and ``marks`` (rulers, named
dots, rings).  What they do mark by mark is compiled in ``loops``.
"""

from lscan.board.drawing import draw_overlay
from lscan.board.reader import read_board

__all__ = ["draw_overlay", "read_board"]
