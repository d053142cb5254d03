"""The command ``lscan schema``, and the files of lscan that it knows."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from lscan.acquisition.replay import ReplayOptions
from lscan.calibration.metric.views import ViewsDocument
from lscan.cli.console import Json, one_of, show
from lscan.config.board import Board
from lscan.config.rig import Rig
from lscan.config.targets import ShapesDocument
from lscan.config.userfiles import (
    Options,
    UserFile,
    as_text,
    find_file,
    json_schema,
    kinds,
    user_file,
)
from lscan.devices.genicam import GenicamOptions
from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.klipper import KlipperOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera.options import OpencvOptions
from lscan.files.disk import json_text, write_atomically

OPTIONS: Options = {
    "camera": {"genicam": GenicamOptions, "opencv": OpencvOptions, "replay": ReplayOptions},
    "track": {
        "grbl": SerialTrackOptions,
        "klipper": KlipperOptions,
        "manual": ManualOptions,
        "replay": ReplayOptions,
    },
}


def rig_file() -> UserFile:
    """What ``lscan scan`` takes."""
    return user_file("a rig: camera, track, plan and what is known of it", Rig, options=OPTIONS)


def board_file() -> UserFile:
    """A calibration board's."""
    return user_file("a calibration board: its dots, rings and ruler", Board)


def shapes_file() -> UserFile:
    """What ``lscan measure --shapes`` takes."""
    return user_file("shapes that are measured on a surface", ShapesDocument)


def views_file() -> UserFile:
    """What ``lscan calibrate-metric`` takes."""
    return user_file("pictures of a board in several poses", ViewsDocument)


def schema(
    kind: Annotated[str | None, Argument(help="Kind of file; a list of all if left out.")] = None,
    text: bool = Option(False, "--text", help="Print every key with what it means instead."),
    output: Path | None = Option(None, "--output", "-o", help="File to write, none by default."),
    json: Json = False,
) -> None:
    """Print the JSON schema by which an editor completes and checks a file that you write.

    With --text, print what may stand in such a file: each key, its type, bounds, unit and default.
    """
    if kind is None:
        found = {name: find_file(name).about for name in kinds()}
        show(found, *(f"{name:10}{about}" for name, about in found.items()), json=json)
        return
    one_of(kind, kinds(), "KIND")
    if text:
        written = "\n\n".join(as_text(section) for section in find_file(kind).sections)
    else:
        written = json_text(json_schema(kind))
    if output is None:
        print(written)
    else:
        write_atomically(output, f"{written}\n".encode())
        show(
            {"schema": str(output)},
            f"{output}: name it in a file's first line, #:schema {output.name}",
            json=json,
        )
