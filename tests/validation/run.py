"""``make validate``: the tank and the instrument held to their figures, theme by theme.

Each theme is a module with a function ``chapters`` that says what is measured for a request: a
mapping of names to callables, each of which returns rows or a topic of the page.
"""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from importlib.metadata import version
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Annotated

import typer

from lscan.acquisition.scan import cores
from lscan.cli.console import progress_bar, show, table
from lscan.config.scenes import scenes_folder
from lscan.figures.page import page_template
from lscan.files.disk import list_names, make_folder, write_atomically
from lscan.records import Progress
from sim.render.backend import THREADS
from tests.validation.rows import (
    HEADINGS,
    Chapters,
    Request,
    RowFile,
    Topic,
    all_passed,
    number,
    rows_of,
    table_cells,
    topic_of,
)

SOFTWARE = ("lscan", "mitsuba", "drjit", "numpy", "scipy")


@dataclass(frozen=True)
class Theme:
    """What a theme asks, and the module of its chapters.

    side_by_side: as many chapters at a time as there are processors, for none is timed.
    """

    question: str
    module: str
    side_by_side: bool = False


THEMES: Mapping[str, Theme] = {
    "light": Theme("Can the tank be believed?", "light.chapters"),
    "instrument": Theme(
        "How near to the truth does the instrument measure?", "instrument.chapters", True
    ),
    "surfaces": Theme(
        "Does it hold for other pictures, waters and surfaces?", "surfaces.chapters", True
    ),
    "robustness": Theme("What do faults, kills and load do?", "robustness.chapters"),
    "intervals": Theme("Do stated intervals hold?", "intervals.chapters", True),
    "studies": Theme("Do studies say where errors come from?", "studies.chapters"),
    "regression": Theme("Do suites notice what changes?", "regression.chapters"),
    "roughness": Theme("How well is roughness known?", "roughness.chapters", True),
    "speed": Theme("How long does it take, side by side?", "speed"),
}


def run_theme(
    name: str, request: Request, output: Path, progress: Progress | None = None
) -> list[Topic]:
    """The topics of a theme; its rows are written as they are measured.

    A chapter that ends with an error is a failed row.

    Parameters
    ----------
    name : str, of the theme
    request : Request
    output : Path, folder of NAME.json and of what else the theme writes, in a folder NAME
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        A scene file is wrong, the folder of photographs is not there, or the disk refuses.
    """
    if request.photographs is not None:
        list_names(request.photographs)  # refuses a folder that is not there
    theme, request = THEMES[name], replace(request, folder=output / name)
    chapters: Chapters = import_module(f"tests.validation.{theme.module}").chapters(request)
    make_folder(request.folder)
    file = RowFile(output / f"{name}.json", request.quick)
    # In turn where a chapter would spoil what another measures of time; and in a quick run, for
    # to import and load the renderer anew takes longer than most of its chapters.
    if theme.side_by_side and not request.quick:
        return _side_by_side(name, chapters, file, progress)
    topics = []
    for done, (chapter, measure) in enumerate(chapters.items(), start=1):
        topic = topic_of(chapter, measure)
        topics.append(replace(topic, rows=tuple(file.add(topic.rows))))
        print(f"{name}, {chapter}: {topic.seconds:.0f} s", flush=True)
        if progress is not None:
            progress(done, len(chapters))
    return topics


def _side_by_side(
    theme: str, chapters: Chapters, file: RowFile, progress: Progress | None = None
) -> list[Topic]:
    """The topics of all chapters in their order, each measured in a process of its own."""
    names, topics = list(chapters), dict[str, Topic]()
    workers = max(1, min(len(chapters), cores()))
    with processes(workers) as pool:
        futures: dict[Future[Topic], str] = {
            pool.submit(topic_of, name, chapter): name for name, chapter in chapters.items()
        }
        for done, future in enumerate(as_completed(futures), start=1):
            name = futures[future]
            topic = topic_of(name, future.result)  # a process that died has no topic
            rows = file.add(topic.rows, names.index(name))
            topics[name] = replace(topic, rows=tuple(rows))
            print(f"{theme}, {name}: {topic.seconds:.0f} s", flush=True)
            if progress is not None:
                progress(done, len(chapters))
    return [topics[name] for name in names]


SPAWNED = get_context("spawn")  # not forked: Dr.Jit's threads do not survive a fork


@contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end at once where this one is stopped, whatever they measure.

    Parameters
    ----------
    workers : int
    """
    with ProcessPoolExecutor(workers, SPAWNED, partial(share_threads, workers)) as pool:
        try:
            yield pool
        except BaseException:  # without its processes the pool is broken, and waits for none
            for process in active_children():
                process.terminate()
            raise


def share_threads(workers: int) -> None:
    """Leave Dr.Jit's threads of the other processes to them, before it is loaded."""
    os.environ.setdefault(THREADS, str(max(1, cores() // workers)))


def run_themes(
    names: Sequence[str], request: Request, output: Path, progress: Progress | None = None
) -> dict[str, list[Topic]]:
    """The topics of several themes; those of a quick run side by side.

    Parameters
    ----------
    names, request, output : as of :func:`run_theme`
    progress : Progress or None, called with (done, all) after each theme
    """
    found: dict[str, list[Topic]] = {}
    workers = min(len(names), cores()) if request.quick else 1
    if workers == 1:
        for name in names:
            with progress_bar(name) as of_theme:
                found[name] = run_theme(name, request, output, of_theme)
        return found
    with processes(workers) as pool:
        futures = {pool.submit(run_theme, name, request, output): name for name in names}
        for done, future in enumerate(as_completed(futures), start=1):
            found[futures[future]] = future.result()
            if progress is not None:
                progress(done, len(names))
    return {name: found[name] for name in names}


def page_of(found: Mapping[str, Sequence[Topic]], seconds: float = 0.0) -> str:
    """The page as HTML text; it loads nothing from anywhere."""
    template = page_template(
        "tests.validation", "report.html.j2", number=number, share=share_of_bar
    )
    return template.render(
        themes=[(name, THEMES[name].question, topics) for name, topics in found.items()],
        seconds=seconds,
        rows=[row for topics in found.values() for row in rows_of(topics)],
        versions={name: version(name) for name in SOFTWARE},
    )


def share_of_bar(figure: float, bar: float | None) -> float:
    """How much of its bar a figure uses, in percent, for the gauge: 100 where it is beyond."""
    if bar is None or not figure <= bar:
        return 100.0
    return 100.0 * figure / bar if bar > 0 else 0.0


def validate(
    names: Annotated[
        list[str] | None, typer.Argument(help=f"Themes, all if none is named: {', '.join(THEMES)}.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the figures and the page.")
    ] = Path("out/validate"),
    scenes: Annotated[
        Path | None, typer.Option(help="Folder of scene files; lscan's own if left out.")
    ] = None,
    photographs: Annotated[
        Path | None,
        typer.Option(
            envvar="LSCAN_PHOTOGRAPHS",
            help="Folder of real pictures, whose rows are left out without it.",
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Every row with the least effort, in minutes.")
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="More random rigs and less noise for light: an hour.")
    ] = False,
) -> None:
    """Hold tank and instrument to their figures; exit code 1 where one is beyond its bar."""
    if full and quick:
        raise typer.BadParameter("--full and --quick exclude each other")
    for name in names or ():
        if name not in THEMES:
            raise typer.BadParameter(
                f"there is no theme {name}: the themes are {', '.join(THEMES)}"
            )
    started = time.perf_counter()
    request = Request(scenes or scenes_folder(), output, quick, full, photographs)
    with progress_bar("validate") as progress:
        found = run_themes(names or list(THEMES), request, output, progress)
    page = page_of(found, time.perf_counter() - started)
    write_atomically(output / "report.html", page.encode("utf-8"))
    for name, topics in found.items():
        show(None, table(name, HEADINGS, table_cells(rows_of(topics))), json=False)
        print(output / f"{name}.json")
    rows = [row for topics in found.values() for row in rows_of(topics)]
    if photographs is None:
        print("left out: the rows of real photographs, which need --photographs FOLDER")
    if quick:
        print("a quick run: figures marked - were measured with too little effort to be judged")
    print(output / "report.html")
    if not all_passed(rows):
        raise typer.Exit(1)
