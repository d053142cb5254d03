"""The arguments that several commands take, and what is checked of them before any work."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from lscan.errors import InputError

if TYPE_CHECKING:
    from pydantic import BaseModel

Options = TypeVar("Options", bound="BaseModel")

RigOrScene = Annotated[
    Path, typer.Argument(help="Rig file or scene file (TOML), or a scene's name.")
]
PictureOrRun = Annotated[Path, typer.Argument(help="Picture file or run folder.")]
ChannelName = Annotated[str | None, typer.Option("--channel", help="red, green, blue or grey.")]
Overlay = Annotated[
    Path | None,
    typer.Option("--overlay", help="Write the picture with what was found drawn on it."),
]
RunFolder = Annotated[Path, typer.Argument(help="Run folder.")]
CalibrationFile = Annotated[
    Path, typer.Option("--calibration", "-c", help="Calibration file (JSON).")
]
ShaftFile = Annotated[
    Path | None,
    typer.Option("--shaft", help="TOML file with the [shaft] found; a run folder has its own."),
]
Trust = Annotated[
    bool, typer.Option("--trust", help="Run the code that a run folder names as its extractor.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def require_folders(*outputs: Path | None) -> None:
    """Refuse, before any work is done, an output whose folder does not exist."""
    for output in outputs:
        if output is not None and not os.path.isdir(output.parent):  # noqa: PTH112 - takes any
            raise InputError("the folder to write to does not exist", where=output)


def check_options(model: type[Options], given: dict[str, Any]) -> Options:
    """The options of a command as a model.

    Parameters
    ----------
    model : type
        A class of pydantic, whose keys are called as the options are.
    given : dict
        The options' values.

    Raises
    ------
    InputError
        One line that names the option as it is typed, its value and what is allowed.
    """
    from lscan.config.documents import check

    for key, value in given.items():
        try:
            check(model, {key: value}, where=None)
        except InputError as error:
            what, option = error.what.removeprefix(f"{key}: "), f"--{key.replace('_', '-')}"
            allowed = error.allowed
            raise InputError(what, where=option, value=error.value, allowed=allowed) from error
    return model.model_validate(given)
