"""The project's commands, run as processes of their own beside what is measured."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from lscan.errors import MeasurementError


@contextmanager
def command_running(
    module: Sequence[str], ready: str, log: Path
) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A command of this project while it runs: the line that it got ready by, and its process.

    Parameters
    ----------
    module : sequence of str, of its module and its arguments
    ready : str, what the line begins with
    log : Path, where its stderr goes

    Raises
    ------
    MeasurementError
        It ends before it is ready.
    """
    with log.open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", *module], stdout=subprocess.PIPE, stderr=stderr, text=True
        )
    assert process.stdout is not None
    try:
        line = next((line for line in process.stdout if line.startswith(ready)), None)
        if line is None:
            said = log.read_text(errors="replace").strip().splitlines() or ["nothing on stderr"]
            raise MeasurementError(f"{' '.join(module[:2])} does not start: {said[-1]}")
        yield line, process
    finally:
        process.terminate()
        try:
            process.wait(timeout=60.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()
