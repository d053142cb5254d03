"""Put each mutant of ``lscan.toml`` and ``sim.toml`` into a copy of the project and run its tests.

    python -m tests.mutants [PART ...] [--workers 2]

PART: mutants whose file or words have it in them; all without. Each names the tests that must
fail with it. First they are run as the project is: all pass, and none is marked slow. The exit
code is 1 where a mutant escapes, or where tests could not run. Caches of lscan are not shared with
the user's: a mutant must neither be hidden by a table of before nor leave one of its own.
"""

import argparse
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tests.support.places import ROOT, tracked

LIMIT_S = 120.0
BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}


@dataclass(frozen=True)
class Mutant:
    """What is wrong, the text of one file that becomes another, and the tests that must fail."""

    what: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    @property
    def room(self) -> str:
        """The folder of its package that the file lies in, or the package."""
        return "/".join(Path(self.file).parts[:-1][:2])

    def text(self, source: str) -> str:
        """The file's text with the mistake in it."""
        if source.count(self.old) != 1 or self.old == self.new:
            raise ValueError(f"{self.file}: {self.what}: occurs {source.count(self.old)} times")
        return source.replace(self.old, self.new)


@dataclass(frozen=True)
class Outcome:
    """How the tests ended: "caught", or why it was not; the test that failed; what pytest said."""

    verdict: str
    by: str
    seconds: float
    said: str


def listed(parts: Sequence[str] = ()) -> list[Mutant]:
    """The mutants of the lists whose file or words have one of the parts in them."""
    tables = [
        table
        for path in sorted(Path(__file__).parent.glob("*.toml"))
        for table in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    ]
    mutants = [Mutant(**{**table, "tests": tuple(table["tests"])}) for table in tables]
    return [m for m in mutants if not parts or any(p in f"{m.file} {m.what}" for p in parts)]


def copy_project(folder: Path) -> None:
    """Copy what git tracks, as it is in the working tree, into a folder."""
    for path in tracked(ROOT):
        copy = folder / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)


def run_tests(folder: Path, tests: Iterable[str], *options: str, **environment: str) -> Outcome:
    """Run tests of a copy of the project, with the packages of that copy."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),  # of child processes as well
        "XDG_CACHE_HOME": str(folder / "out" / "cache"),
        "OPENBLAS_NUM_THREADS": "1",
        "LSCAN_THREADS": "1",
        **environment,
    }
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow"]
    command += ["-p", "no:cacheprovider", "-p", "tests.mutants"]
    log, start = folder / "pytest.log", time.monotonic()
    with log.open("wb") as out:
        process = subprocess.Popen(
            [*command, *options, *dict.fromkeys(tests)], cwd=folder, env=environment,
            stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            code: int | None = process.wait(LIMIT_S if options else None)
        except subprocess.TimeoutExpired:
            code = None
        finally:  # and what the tests have left running
            with_all_children(process, signal.SIGKILL)
    said = log.read_text(encoding="utf-8", errors="replace")
    failed = re.search(r"^FAILED \S*?::(\S+)", said, flags=re.MULTILINE)
    verdicts = {None: "took too long", 0: "escaped", 1: "caught" if failed else "no test failed"}
    verdict = verdicts.get(code, "not collected")
    return Outcome(verdict, failed[1] if failed else "", time.monotonic() - start, said)


def with_all_children(process: "subprocess.Popen[bytes]", number: int) -> None:
    """Send a signal to a process and to all of its session."""
    try:
        os.killpg(process.pid, number)
    except ProcessLookupError:
        return
    process.wait()


def try_mutant(mutant: Mutant, folder: Path) -> Outcome:
    """Put a mutant into a copy of the project, run its tests, and take it out again."""
    path = folder / mutant.file
    as_it_was, before = path.read_text(encoding="utf-8"), path.stat()
    shutil.rmtree(folder / "out" / "cache" / "lscan", ignore_errors=True)
    path.write_text(mutant.text(as_it_was), encoding="utf-8")
    try:
        return run_tests(folder, mutant.tests, "-x", **BYTECODE)
    finally:
        path.write_text(as_it_was, encoding="utf-8")
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # what was compiled holds


def try_all(mutants: Sequence[Mutant], workers: int) -> bool:
    """Try mutants in copies of the project, print how each ended; whether all are caught."""
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(workers) as pool:
        copies = [Path(temporary) / str(number) for number in range(workers)]
        free: queue.SimpleQueue[Path] = queue.SimpleQueue()
        tests = list(dict.fromkeys(test for mutant in mutants for test in mutant.tests))

        def unmutated(number: int) -> Outcome:
            copy_project(copies[number])
            free.put(copies[number])
            share = sorted(tests[number::workers])
            return run_tests(copies[number], share) if share else Outcome("escaped", "", 0.0, "")

        for outcome in pool.map(unmutated, range(workers)):
            if outcome.verdict != "escaped" or re.search(r"\d (deselected|skipped)", outcome.said):
                print(f"{outcome.said}\nbefore any mutant: tests fail, are skipped or marked slow")
                return False
            print(f"without any mutant: {outcome.said.strip().splitlines()[-1:]}")

        def tried(mutant: Mutant) -> Outcome:
            folder = free.get()
            try:
                return try_mutant(mutant, folder)
            finally:
                free.put(folder)

        escaped = []
        for mutant, outcome in zip(mutants, pool.map(tried, mutants), strict=True):
            caught = outcome.verdict == "caught"
            by = outcome.by if caught else outcome.verdict.upper()
            print(f"{mutant.room:20} {mutant.what:70} {by:60} {outcome.seconds:5.1f} s", flush=True)
            escaped += [] if caught else [mutant]
    print(f"{len(mutants) - len(escaped)} of {len(mutants)} mutants caught")
    print("".join(f"not caught: {mutant.file}: {mutant.what}\n" for mutant in escaped), end="")
    return not escaped


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    sys.exit(0 if try_all(listed(given.parts), given.workers) else 1)
