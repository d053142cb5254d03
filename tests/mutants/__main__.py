"""Put each mutant of ``lscan.toml`` and ``sim.toml`` into a copy of the project and run its tests.

    python -m tests.mutants [PART ...] [--workers 2]

PART: only mutants whose file or words have it in them.  First all tests that they name are run in
the copies as they are, and pass.  Then each mutant must make one of its own fail that is not marked
slow.  The exit code is 1 where one escapes.

Each has a cache of lscan of its own, in which no table of before hides it, and leaves none.
"""

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

from tests.support.places import ROOT, tracked

LIMIT_S = 120.0  # of a mutant's tests; one that takes longer is not caught
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "LSCAN_THREADS": "1"}
PYTEST = (sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider")


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
    """Copy what git tracks, as it is in the working tree, and the compiled loops into a folder."""
    for path in (*tracked(ROOT), *ROOT.glob("lscan/**/__pycache__/*.nb[ci]")):
        copy = folder / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)


def run_tests(
    folder: Path, tests: Iterable[str], limit_s: float | None = None, **environment: str
) -> Outcome:
    """Run tests of a copy of the project, with the packages of that copy, until one fails."""
    places = {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(folder / "out" / "cache")}
    log, begun_s = folder / "pytest.log", time.monotonic()
    with log.open("wb") as out:
        process = subprocess.Popen(
            [*PYTEST, "-p", "tests.mutants", "-x", *dict.fromkeys(tests)], cwd=folder, stdout=out,
            env=os.environ | ENVIRONMENT | places | environment, stderr=out, start_new_session=True,
        )  # fmt: skip
        try:
            code: int | None = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            with suppress(ProcessLookupError):  # nothing that the tests started is left
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    said = log.read_text(encoding="utf-8", errors="replace")
    failed = re.search(r"^FAILED \S*?::(\S+)", said, flags=re.MULTILINE)
    verdicts = {None: "took too long", 0: "escaped", 1: "caught" if failed else "no test failed"}
    verdict = verdicts.get(code, "not collected")
    return Outcome(verdict, failed[1] if failed else "", time.monotonic() - begun_s, said)


def try_mutant(mutant: Mutant, folder: Path) -> Outcome:
    """Put a mutant into a copy of the project, run its tests, and take it out again."""
    path = folder / mutant.file
    as_it_was, before = path.read_text(encoding="utf-8"), path.stat()
    shutil.rmtree(folder / "out" / "cache" / "lscan", ignore_errors=True)
    path.write_text(mutant.text(as_it_was), encoding="utf-8")
    # Another time, in whole seconds: or what was compiled of a file as large would hold.
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 2 * 10**9))
    try:
        return run_tests(folder, mutant.tests, LIMIT_S, PYTHONDONTWRITEBYTECODE="1")
    finally:
        path.write_text(as_it_was, encoding="utf-8")
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # what was compiled holds


def try_all(mutants: Sequence[Mutant], workers: int = 2) -> bool:
    """Try mutants in copies of the project and print how each ended; whether all are caught."""
    tests = sorted({test for mutant in mutants for test in mutant.tests})
    free: SimpleQueue[Path] = SimpleQueue()
    with TemporaryDirectory() as temporary, ThreadPoolExecutor(workers) as pool:

        def run_unmutated(number: int) -> Outcome:
            folder = Path(temporary, str(number))
            copy_project(folder)
            free.put(folder)
            return run_tests(folder, tests[number::workers] or tests)

        def run_mutated(mutant: Mutant) -> Outcome:
            folder = free.get()
            try:
                return try_mutant(mutant, folder)
            finally:
                free.put(folder)

        for outcome in pool.map(run_unmutated, range(workers)):
            if outcome.verdict != "escaped" or re.search(r"\d skipped", outcome.said):
                print(f"{outcome.said}\nwithout a mutant: tests fail or are skipped")
                return False
        escaped = []
        for mutant, outcome in zip(mutants, pool.map(run_mutated, mutants), strict=True):
            if outcome.verdict != "caught":
                escaped.append(f"{mutant.file}: {mutant.what}: {outcome.verdict}\n")
            ended = outcome.by or outcome.verdict.upper()
            print(
                f"{mutant.room:18} {mutant.what:72} {ended:70} {outcome.seconds:5.1f} s", flush=True
            )
    print(f"{len(mutants) - len(escaped)} of {len(mutants)} mutants caught")
    print("".join(escaped), end="")
    return not escaped


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    sys.exit(0 if try_all(listed(given.parts), given.workers) else 1)
