"""``lscan scenes``: the scenes that come with lscan, listed or copied."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import Json
from lscan.cli.console import print_json


def scenes(
    copy: Annotated[Path | None, typer.Option(help="New folder to copy all scenes to.")] = None,
    json: Json = False,
) -> None:
    """List the scenes, rigs and boards that come with lscan, or copy them to be changed."""
    from lscan.config.scenes import copy_scenes, scene_about, scene_names

    names = scene_names()
    if copy is not None:
        copy_scenes(copy)
    if json:
        print_json({"scenes": names, "copied_to": copy})
    elif copy is not None:
        print(f"{len(names)} scenes, rigs and boards in {copy}")
    else:
        for name in names:
            print(f"{name:26}{scene_about(name)}")
