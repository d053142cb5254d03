"""The command ``lscan draw-board``: a thin face over lscan.board.drawing."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import Json, require_folders
from lscan.cli.console import print_json


def draw_board(
    board: Annotated[Path, typer.Argument(help="Board file, or a rig file that names one.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="SVG file to write.")],
    json: Json = False,
) -> None:
    """Draw a calibration board at its true size, to be printed or milled."""
    from lscan.board.drawing import board_svg
    from lscan.config.board import Board
    from lscan.config.documents import check, read_document
    from lscan.config.rig import inline_board
    from lscan.files.disk import write_atomically

    require_folders(output)
    document = inline_board(read_document(board), source=str(board))
    section = "board" if "board" in document else ""
    drawn = check(Board, document.get("board", document), where=board, prefix=section)
    write_atomically(output, board_svg(drawn).encode())
    left, right, bottom, top = drawn.outline_mm()
    if json:
        print_json({"drawing": output, "width_mm": right - left, "height_mm": top - bottom})
    else:
        print(f"{output}: {right - left:g} by {top - bottom:g} mm; print it at 100 %")
