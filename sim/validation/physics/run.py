"""The whole run: measure every chapter, writing its figures, then show them on a page."""

import time
from dataclasses import replace
from pathlib import Path

from lscan.files.disk import make_folder, write_atomically
from lscan.records import Progress
from sim.validation.physics.chapters import FULL, NORMAL, QUICK, Measure, chapters
from sim.validation.physics.gallery import gallery, scene_files
from sim.validation.physics.report import render_page
from sim.validation.physics.topics import topic
from sim.validation.rows import Row, RowFile, Topic, failed_row


def run_verify(
    folder: Path,
    scenes: Path,
    quick: bool = False,
    progress: Progress | None = None,
    full: bool = False,
) -> list[Row]:
    """All rows of the evidence, also written to ``folder`` as verify.json and report.html.

    The rows are written as they are measured; a chapter or a scene that ends with an error is
    a failed row with its message.

    Parameters
    ----------
    folder : Path
        Where the files go; it is made.
    scenes : Path
        Folder of scene files, one picture of each.
    quick : bool
        Every row and every picture, but each with the least effort; what noise could spoil is
        then not judged.
    progress : callable, optional
        Called with (done, all) after each chapter.
    full : bool
        With all the effort there is, which takes an hour.

    Raises
    ------
    InputError
        Where the disk refuses, or ``scenes`` is not there.
    """
    scene_files(scenes)  # refuses a folder that is not there before minutes of work
    make_folder(folder)
    file = RowFile(folder / "verify.json", quick)
    started = time.perf_counter()
    checks = []
    measures = chapters(QUICK if quick else FULL if full else NORMAL)
    for done, (name, measure) in enumerate(measures.items(), start=1):
        check = _measured(name, measure)
        checks.append(replace(check, rows=tuple(file.add(check.rows))))
        if progress is not None:
            progress(done, len(measures) + 1)
    plates, rows = gallery(scenes, quick)
    checks.append(topic("gallery", file.add(rows)))
    page = render_page(checks, plates, time.perf_counter() - started)
    write_atomically(folder / "report.html", page.encode("utf-8"))
    return file.rows


def _measured(name: str, measure: Measure) -> Topic:
    """The chapter's check; one that says so where it ends with an error."""
    try:
        return measure()
    except Exception as error:  # whatever it is, the other chapters are still wanted
        key = name.replace(" ", "-")
        text = "This chapter ended with an error and has no figures."
        return Topic(key, name.capitalize(), text, (failed_row(name, error),))
