"""What the two command lines share: commands loaded when run, errors, bars, what is printed."""

import ast
import ctypes
import errno
import os
import sys
import time
from collections import UserDict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import wraps
from glob import escape, glob
from importlib import resources
from inspect import signature
from io import TextIOWrapper
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, NoReturn, TypeVar

import typer
from rich import progress as rich_progress
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup
from typer.models import ArgumentInfo, OptionInfo

from lscan.config.scenes import scene_names
from lscan.devices.signals import ignore_stop_signals, interrupted_by_signals, on_stop_signals
from lscan.errors import InputError, LscanError, Stopped, missing_package
from lscan.files.cache import long_work_shown
from lscan.files.disk import json_text
from lscan.records import Progress
from lscan.version import __version__

# Memory that a process keeps for its next picture.


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of mallopt(3), as malloc.h numbers them
_KEPT_BYTES = 2**28  # the arrays of several pictures of 8 million pixels
_LARGEST_BYTES = 2**25  # glibc's limit for blocks out of memory that is kept


def keep_freed_memory() -> None:
    """Have the C library keep the memory that large arrays free.

    By default it hands that back, and the system clears every page anew for the next array: half
    of the time in which a line is found, as arrays of a picture's size come and go.  Nothing is
    changed where the C library is not glibc.

    References
    ----------
    mallopt(3) of the Linux manual.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc, or Windows
        return
    mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES)
    mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)


# The names that a shell offers for an argument or an option.


def _rigs(typed: str) -> list[str]:
    """Scenes of lscan, and TOML files that begin with what is typed."""
    return [*scene_names(), *glob(f"{escape(typed)}*.toml")]  # noqa: PTH207 - "./" stays as typed


def _installed(group: str) -> tuple[str, ...]:
    """Names of a group's entry points."""
    from lscan.config.plugins import installed  # reads all packages: not for every help

    return installed(group)


MAP_NAMES = [
    *(f"graticule-{kind}{end}" for kind in ("1", "2", "bspline") for end in ("", "-norulers")),
    *(f"polynomial-{degree}" for degree in range(1, 10)),
    *("auto", "projective", "spline", "refractive"),
]
COMPLETED: dict[str, Callable[..., Sequence[str]]] = {
    **dict.fromkeys(("rig", "scene", "scenes", "--rig"), _rigs),
    **dict.fromkeys(("named", "--extractor"), lambda: _installed("lscan.extractors")),
    "--plane_map": lambda: MAP_NAMES,
    "kind": lambda: _installed("lscan.userfiles"),
}
"""By the parameter of a command's function; that of an option begins with dashes."""


# A command line: its commands, each loaded when it is called, and one clear line for an error.


Named = TypeVar("Named", bound=str)
FAILED, BAD_INPUT = 1, 2
STOPPED = Stopped.exit_code
_OUTPUT_FAILS = (errno.ENOSPC, errno.EIO, errno.EBADF)  # files that lscan writes are named
SAID_EVERY_S = 60.0  # of long work where no terminal shows a bar

_bars: list[rich_progress.Progress] = []  # what draws all bars that there are: one or none


class _Commands(UserDict[str, Any]):
    """Commands by name; the place of one, ``module:function``, until it is asked for."""

    def __getitem__(self, name: str) -> Any:
        if isinstance(found := self.data[name], str):
            alone = typer.Typer(add_completion=False, rich_markup_mode=None)
            alone.command(name)(_declared_command(found))
            self.data[name] = found = typer.main.get_command(alone)
        return found


def _declared_command(place: str) -> Callable[..., None]:
    """A function with the parameters and help of the one at ``place``, which it loads and calls.

    Of that one's module it runs what the parameters name, and neither loads nor runs the rest:
    help and refused options need no SciPy.
    """
    module, _, function = place.partition(":")
    package, _, stem = module.rpartition(".")
    tree = ast.parse((resources.files(package) / f"{stem}.py").read_text(encoding="utf-8"))
    makers = {name: part for part in tree.body for name in _names_made(part)}
    declared = makers[function]
    assert isinstance(declared, ast.FunctionDef)
    del declared.body[1:]  # leaves the docstring
    needed, left = set[ast.stmt](), list[ast.stmt]([declared])
    while left:
        needed.add(part := left.pop())
        named = {makers.get(node.id) for node in ast.walk(part) if isinstance(node, ast.Name)}
        left += [maker for maker in named if maker and maker not in needed]
    tree.body = [part for part in tree.body if part in needed]
    names: dict[str, Any] = {"__name__": module}
    exec(compile(tree, module, "exec"), names)
    for name, parameter in signature(names[function]).parameters.items():
        for info in (parameter.default, *getattr(parameter.annotation, "__metadata__", ())):
            if isinstance(info, ArgumentInfo | OptionInfo):
                key = name if isinstance(info, ArgumentInfo) else f"--{name}"
                info.autocompletion = COMPLETED.get(key)

    @wraps(names[function])
    def call(**given: Any) -> None:
        resolve_name(place)(**given)

    return call


def _names_made(part: ast.stmt) -> list[str]:
    """The names that a statement of a module gives it."""
    if isinstance(part, ast.Import | ast.ImportFrom):
        return [alias.asname or alias.name for alias in part.names]
    if isinstance(part, ast.FunctionDef | ast.ClassDef):
        return [part.name]
    return [
        n.id for n in ast.walk(part) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    ]


def command_line(about: str, places: Mapping[str, str] | None = None) -> typer.Typer:
    """A command line, whose ``--help`` says what each command does, whole: click cuts it.

    Parameters
    ----------
    about : str, what its ``--help`` begins with
    places : mapping
        Of each command's name, ``module:function``.  A module is loaded when one of its commands
        is run, not for its help, so that it may import what it needs at its top.
    """

    class Group(TyperGroup):
        """The commands at those places, and then those that typer was told of."""

        commands: _Commands

        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            self.commands = _Commands({**(places or {}), **self.commands})

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            """Write the list; called by click."""
            with formatter.section("Commands"):
                about = [one.get_short_help_str(limit=1000) for one in self.commands.values()]
                formatter.write_dl([*zip(self.commands, about, strict=True)])

    return typer.Typer(
        cls=Group,
        help=about,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )


def _say_version(context: typer.Context, asked: bool) -> None:
    if asked:
        print(f"{context.info_name} {__version__}")
        raise typer.Exit


def before_any_command(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """The options of a program itself: its ``app.callback``.

    Parameters
    ----------
    version : bool, whether it is to say its version and leave
    """


def run_program(app: typer.Typer, name: str) -> None:
    """As ``run_command_line``, in a process that ends with it: signals no longer change its code.

    Parameters
    ----------
    app : Typer, the command line with its commands
    name : str, of the program
    """
    try:
        run_command_line(app, name)
    finally:
        ignore_stop_signals()


@interrupted_by_signals()
def run_command_line(app: typer.Typer, name: str) -> None:
    """Run a command line and leave with its exit code; errors become one line on stderr.

    Ctrl-C, SIGTERM and their like stop every command alike, see ``interrupted_by_signals``.

    Parameters
    ----------
    app : Typer, the command line with its commands
    name : str, of the program, as errors and ``--help`` say it
    """
    command = typer.main.get_command(app)
    keep_freed_memory()
    if isinstance(sys.stdout, TextIOWrapper):  # of a code page without "≤", as on Windows
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with long_work_shown(progress_bar):
            code = command.main(prog_name=name, standalone_mode=False)
        sys.stdout.flush()
    except OSError as error:
        if error.filename is not None or error.errno not in _OUTPUT_FAILS:  # a connection's, say
            raise
        # What is left to be printed goes nowhere, or Python would fail once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        _leave(name, f"standard output cannot be written: {error.strerror}", FAILED)
    except LscanError as error:
        message = "; ".join([str(error), *getattr(error, "__notes__", ())])
        _leave(name, message, error.exit_code)
    except MemoryError as error:
        said = f": {error}" if str(error) else ""
        _leave(name, f"there is not enough memory{said}", FAILED)
    except ModuleNotFoundError as error:
        _leave(name, missing_package(error), BAD_INPUT)
    except typer.Abort:
        _leave(name, "aborted", BAD_INPUT)
    except Exception as error:
        # Typer brings its own copy of click in some versions, so what click raises about a
        # command line is known by a method that it has.
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error)
            sys.exit(BAD_INPUT)
        if (format_message := getattr(error, "format_message", None)) is None:
            raise
        _leave(name, " ".join(format_message().split()), BAD_INPUT)
    if code == STOPPED:  # what typer makes of Ctrl-C
        _leave(name, "stopped", STOPPED)
    sys.exit(code if isinstance(code, int) else 0)


@contextmanager
def keep_notes_when_stopped() -> Iterator[None]:
    """Turn a Ctrl-C into an error with its notes: typer drops it, notes and all.

    One that came while another error was dealt with has that one's notes too.
    """
    try:
        yield
    except KeyboardInterrupt as stop:
        said, error = ["stopped"], stop  # type: list[str], BaseException | None
        while error is not None:
            said += getattr(error, "__notes__", ())
            error = error.__context__
        raise Stopped("; ".join(said)) from stop


def _leave(name: str, message: str, code: int) -> NoReturn:
    with on_stop_signals(lambda: None), suppress(OSError):  # the terminal may be gone
        print(f"{name}: {printable(message)}", file=sys.stderr)
    sys.exit(code)


def printable(text: str) -> str:
    """Text from strangers' files as a terminal may show it: control characters as escapes.

    Parameters
    ----------
    text : str, of one line or several
    """
    return "".join(
        one if one == "\n" or one.isprintable() else one.encode("unicode_escape").decode()
        for one in text
    )


def note(message: str) -> None:
    """Print a remark about what a command does on stderr, since stdout may be for JSON.

    Parameters
    ----------
    message : str, one line
    """
    print(f"lscan: note: {printable(message)}", file=sys.stderr)


@contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """A callback (done, total) that draws a bar on a terminal, and says a line a minute elsewhere.

    A bar within another's block is drawn beneath that one, and goes when its own block ends.

    Parameters
    ----------
    title : str, stands before the bar
    """
    with nullcontext(_bars[0]) if _bars else _open_bars() as bars:
        task = bars.add_task(title, total=None)
        said = time.monotonic()

        def show(done: int, total: int) -> None:
            nonlocal said
            bars.update(task, completed=done, total=total)
            if bars.disable and time.monotonic() - said >= SAID_EVERY_S:
                said = time.monotonic()
                note(f"{title}: {done} of {total}")

        try:
            yield show
        finally:
            if len(bars.task_ids) > 1:
                bars.remove_task(task)


@contextmanager
def _open_bars() -> Iterator[rich_progress.Progress]:
    console = Console(stderr=True)
    columns = (
        rich_progress.TextColumn("{task.description}", markup=False),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeRemainingColumn(),
    )
    with rich_progress.Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        _bars.append(bars)
        try:
            yield bars
        finally:
            _bars.remove(bars)


def show(content: object, *lines: str | Table, json: bool) -> None:
    """Print what a command found on stdout.

    Parameters
    ----------
    content : as of ``json_text``, what is printed with --json
    lines : what is printed without: text, and tables of ``table``
    json : bool, whether --json was given
    """
    if json:
        print(json_text(content))
        return
    for line in lines:
        if isinstance(line, str):
            print(line)
        else:
            Console(width=None if sys.stdout.isatty() else 160).print(line)


def table(title: str, headings: Sequence[str], rows: Sequence[Sequence[object]]) -> Table:
    """A table for ``show``: numbers right-aligned, floats with three decimals, NaN as a dash.

    What strangers' files put into it is shown as it is: brackets are no markup.

    Parameters
    ----------
    title : str, stands above the table
    headings : sequence, one a column; the first column is left-aligned
    rows : sequence, cells, one a column
    """
    found = Table(title=Text(printable(title)), title_justify="left", header_style="bold")
    for heading in headings:
        found.add_column(Text(heading), justify="left" if heading == headings[0] else "right")
    for row in rows:
        texts = [f"{one:.3f}" if isinstance(one, float) else printable(str(one)) for one in row]
        found.add_row(*(Text("–" if text in ("nan", "+nan") else text) for text in texts))
    return found


# The arguments that several commands take, and what is checked of them before any work.


EXTRACTORS = (
    "max, centroid, centroid-relative, centroid-squared, gaussian, ml, blais-rioux, smoothed-peak, "
    "steger; or package.module:function."
)
MAPS = (
    "graticule-1, -2, -bspline, each also with -norulers; polynomial-1 to -9; projective, spline, "
    "refractive"
)
Trust = Annotated[
    bool, typer.Option("--trust", help="Run the extractor code that a run folder names.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def one_of(value: str, known: Collection[Named], where: str, fault: str = "not known") -> Named:
    """What is known by the name that an option was given; InputError where nothing is.

    Parameters
    ----------
    value : str, as given
    known : collection of str
    where : str, the option
    fault : str, what the message says of another name
    """
    for one in known:
        if one == value:
            return one
    raise InputError(fault, where=where, value=value, allowed=", ".join(known))


def require_folders(*outputs: Path | None) -> None:
    """Refuse, before any work is done, an output whose folder does not exist.

    Parameters
    ----------
    outputs : Path or None, each a file to be written, None for none
    """
    for output in outputs:
        if output is not None and not os.path.isdir(output.parent):  # noqa: PTH112 - takes any
            raise InputError("the folder to write to does not exist", where=output)
