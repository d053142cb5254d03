"""The control points of the calibration board, found in one picture (Sec. III.1, Figs. 8 to 12).

``read_board`` goes through these modules in order: ``picture`` (grey values, negative, noise),
``blobs`` and ``seeds`` (the three first dots), ``search`` (the adaptive search from dot to
dot), ``evidence`` (is this the board?), ``lattice`` (which dot is which, and the local map),
``features`` and ``rings``.  Every centre is found by ``centre``.
"""

from lscan.board.drawing import draw_overlay
from lscan.board.reader import read_board

__all__ = ["draw_overlay", "read_board"]
