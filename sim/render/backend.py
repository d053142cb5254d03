"""Mitsuba with an LLVM that can render: the one module through which ``sim`` reaches Mitsuba.

Dr.Jit compiles its kernels with whatever libLLVM it finds first.  Version 14 and older are
refused; 15 and 16 load and then abort the whole process at the first render ("Cannot select
... fminimum", measured with Dr.Jit 1.5.0), which no ``except`` can catch.  So every candidate
renders a few pixels once in a process of its own, and the answer is remembered.

``python -m sim.render.backend`` prints the library chosen; with ``--install`` it first asks the
package manager for one where none serves.
"""

import argparse
import ctypes
import importlib
import importlib.util
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from pydantic import TypeAdapter

from lscan.errors import InputError, LscanError
from lscan.files.cache import cache_folder, read_cached
from lscan.files.disk import MOST_TEXT_BYTES, write_atomically

# Numbers below 1e-38 taken for 0, as Dr.Jit's own threads do, in the thread that calls too.
#
# The calling thread keeps them, and with one thread Dr.Jit has no others: light that is read as the
# ratio of two faint numbers would differ with the number of threads, by up to 0.3 %.


CAN_FLUSH = sys.platform == "linux" and platform.machine() == "x86_64"
# Where C's environment of floating point has the register MXCSR, and its bits that take numbers
# below 1e-38 for 0 as results and as operands (System V ABI, AMD64).
_WORDS, _MXCSR, _FLUSH = 8, 7, 0x8040


@contextmanager
def flushing(on: bool = True) -> Iterator[None]:
    """Take numbers below 1e-38 for 0 in this thread, where ``CAN_FLUSH``, until the block ends.

    Parameters
    ----------
    on : bool, False: do not, for code that counts on them
    """
    if not CAN_FLUSH:
        yield
        return
    before = (ctypes.c_uint32 * _WORDS)()
    library = ctypes.CDLL("libm.so.6")
    library.fegetenv(before)
    within = type(before).from_buffer_copy(before)
    within[_MXCSR] = before[_MXCSR] | _FLUSH if on else before[_MXCSR] & ~_FLUSH
    library.fesetenv(within)
    try:
        yield
    finally:
        library.fesetenv(before)


# Packages of Debian and its kin, installed where this process has the right to.


Found = TypeVar("Found")


class PackageError(LscanError):
    """A package could not be installed; the line says what stood in the way."""


def install_first(packages: Sequence[str]) -> None:
    """Install the first of ``packages`` that apt-get offers; its output goes to stderr.

    Parameters
    ----------
    packages : sequence, names of packages, the preferred one first

    Raises
    ------
    PackageError
        apt-get, the right to use it, or such a package is missing.
    """
    admin = _as_root()
    if (package := _offered_package(packages)) is None:
        _apt_get(admin, "update")
        package = _offered_package(packages)
    if package is None:
        raise PackageError(f"apt-get offers none of {', '.join(packages)}")
    if not _apt_get(admin, "install", "-y", "--no-install-recommends", package):
        _apt_get(admin, "update")  # the package list may be older than the archive
        if not _apt_get(admin, "install", "-y", "--no-install-recommends", package):
            raise PackageError(f"apt-get could not install {package}")


def found_or_installed(find: Callable[[], Found], packages: Sequence[str], variable: str) -> Found:
    """What ``find`` finds, the first package on offer installed where it finds nothing.

    Parameters
    ----------
    find : function, raises an LscanError where there is nothing
    packages : sequence, as of ``install_first``
    variable : str, of the environment; where it names a file, nothing is installed

    Raises
    ------
    LscanError
        That of ``find``; where installing failed too, its line says both.
    """
    try:
        return find()
    except LscanError as missing:
        if os.environ.get(variable):
            raise
        try:
            install_first(packages)
        except PackageError as refused:
            raise type(missing)(f"{missing}; {refused}") from refused
    return find()


def _as_root() -> list[str]:
    if not shutil.which("apt-get"):
        raise PackageError("there is no apt-get here to install it with")
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") and _succeeds("sudo", "-n", "true"):
        return ["sudo", "-n"]
    raise PackageError("installing it takes root or a sudo that asks for no password")


def _offered_package(packages: Sequence[str]) -> str | None:
    return next((name for name in packages if _succeeds("apt-cache", "show", name)), None)


def _succeeds(*command: str) -> bool:
    quiet = subprocess.DEVNULL
    return subprocess.run(command, stdin=quiet, stdout=quiet, stderr=quiet).returncode == 0


def _apt_get(admin: list[str], *arguments: str) -> bool:
    quietly = ["env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq"]
    patiently = ["-o", "DPkg::Lock::Timeout=120"]
    command = [*admin, *quietly, *patiently, *arguments]
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=sys.stderr).returncode == 0


# Mitsuba with an LLVM that can render: the one module through which ``sim`` reaches Mitsuba.


LLVM = "llvm_ad_mono"
GPUS = {
    "cuda_ad_mono": "an NVIDIA GPU with OptiX",
    "metal_ad_mono": "a Mac whose GPU knows Metal",
}
"""The variants that render on a GPU, and what each needs."""
OLDEST_MAJOR = 15  # Dr.Jit itself refuses whatever lacks opaque pointers
ATOMIC = "libatomic1"  # Dr.Jit's threads are linked to it; a bare Debian or Ubuntu has none
PACKAGES = ("libllvm19", "libllvm20", "libllvm21", "libllvm18", "libllvm17")
THREADS = "LSCAN_THREADS"  # environment variable: Dr.Jit's threads, if not one for each core
LEAST_THREADS = 2
MOST_PROCESSES = 4  # of half a GB each
PROBE_TIMEOUT_S = 120.0  # a probe takes about 1 s; this is for a machine under heavy load

_NAME = re.compile(r"libLLVM(?:-(\d+)[\w.]*?)?\.(?:so(?:\.(\d+)[\w.]*)?|dylib)")
_ROOTS = ("/usr", "/usr/local", "/opt/homebrew", "/", sys.prefix)
# Beneath these; the last are of Homebrew, which links no LLVM into lib.
_PLACES = ("lib*", "lib/*-linux-gnu*", "lib/llvm-*/lib", "lib64/llvm*/lib", "opt/llvm*/lib")
_PROBE = """
import ctypes, os, resource, sys
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
if "DRJIT_LIBLLVM_PATH" in os.environ and sys.argv[1].startswith("llvm"):
    # Dr.Jit says of whatever it cannot use that it is not there: the linker says more.
    library = ctypes.CDLL(os.environ["DRJIT_LIBLLVM_PATH"])
    assert hasattr(library, "LLVMPointerTypeInContext"), "no libLLVM of version 15 or newer"
import drjit as dr, mitsuba as mi
mi.set_variant(sys.argv[1])
mi.set_log_level(mi.LogLevel.Error)
low = dr.minimum(dr.opaque(mi.Float, 1.0, 4), dr.opaque(mi.Float, 2.0, 4))
assert dr.all(low == 1.0)
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "path"},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
    "light": {"type": "constant"},
    "target": {"type": "sphere", "center": [0, 0, 5]},
})
assert dr.all(mi.render(scene, spp=1).array > 0.0)
"""


class BackendError(LscanError):
    """Mitsuba cannot render on this machine; the line says what to install."""

    exit_code = 2


@dataclass(frozen=True)
class Library:
    """A libLLVM by its resolved path; ``major`` is that of its name, None where it does not say."""

    path: Path
    major: int | None


@dataclass(frozen=True)
class ProbeResult:
    """Whether Mitsuba rendered; ``final`` where asking again would give the same answer."""

    works: bool
    reason: str = ""
    final: bool = True


Probe = Callable[[Library], ProbeResult]
ANSWERS = TypeAdapter(dict[str, ProbeResult])


def load_mitsuba() -> ModuleType:
    """The module ``mitsuba`` with its variant set, safe to render with.

    The variant is ``llvm_ad_mono``, or one of GPUS where the environment variable LSCAN_VARIANT
    asks for it, with LSCAN_THREADS threads, or one for each core.  Sets DRJIT_LIBLLVM_PATH for
    this process and its children.
    Raises BackendError where Mitsuba is missing or nothing on this machine can run it.
    """
    _require_mitsuba()
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is not None and mitsuba.variant() in (LLVM, *GPUS):
        return mitsuba
    variant = os.environ.get("LSCAN_VARIANT") or LLVM
    if variant == LLVM:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(find_llvm().path)
    elif variant in GPUS:
        verdict = _probe(variant, {})
        if not verdict.works:
            raise BackendError(
                f"LSCAN_VARIANT: {variant} needs {GPUS[variant]} ({verdict.reason}); "
                f"unset it to render with {LLVM}"
            )
    else:
        allowed = ", ".join((LLVM, *GPUS))
        raise BackendError(f"LSCAN_VARIANT: got {variant!r} (allowed: {allowed})")
    mitsuba = importlib.import_module("mitsuba")
    mitsuba.set_variant(variant)
    drjit = importlib.import_module("drjit")
    drjit.set_thread_count(_threads(drjit.thread_count()))
    return mitsuba


def _threads(usual: int) -> int:
    """How many threads Dr.Jit gets: pictures are the same with any number of them."""
    said = os.environ.get(THREADS) or str(usual)
    if not said.isdecimal() or int(said) < 1:
        raise BackendError(f"{THREADS}: got {said!r} (allowed: a number of threads, 1 or more)")
    return _enough(int(said))


def _enough(threads: int) -> int:
    """A lone thread would keep numbers below 1e-38, which Dr.Jit's own threads take for 0."""
    return threads if CAN_FLUSH else max(LEAST_THREADS, threads)


@contextmanager
def sharing() -> Iterator[list[dict[str, str]]]:
    """Leave Dr.Jit's threads to more processes, which render side by side, until the block ends.

    A picture takes one thread little longer than two, so that each process gets one where there
    are no more than MOST_PROCESSES.  Gives the environment's variables of each other process,
    none where there is no thread for one.
    """
    mitsuba, drjit = load_mitsuba(), importlib.import_module("drjit")
    threads = drjit.thread_count()
    processes = min(MOST_PROCESSES, threads) if mitsuba.variant() == LLVM else 1
    each = threads // processes
    drjit.set_thread_count(_enough(each))
    try:
        yield [{THREADS: str(each)}] * (processes - 1)
    finally:
        drjit.set_thread_count(threads)


def find_llvm(candidates: Iterable[Path] | None = None, probe: Probe | None = None) -> Library:
    """The newest libLLVM that Mitsuba renders with.

    candidates: the files to choose from, by default DRJIT_LIBLLVM_PATH alone, whatever its name,
    where the user has set it, else all that this machine holds.  probe: tries one out, by default
    in a process of its own, once.  Raises BackendError naming each candidate and its fault.
    """
    probe = probe or probe_remembered
    if candidates is None and (named := os.environ.get("DRJIT_LIBLLVM_PATH")):
        return _named_llvm(named, probe)
    faults = []
    for library in newest_first(_installed_libraries() if candidates is None else candidates):
        if library.major is not None and library.major < OLDEST_MAJOR:
            faults.append(f"{library.path.name}: too old, Dr.Jit needs {OLDEST_MAJOR} or newer")
            continue
        verdict = probe(library)
        if verdict.works:
            return library
        faults.append(f"{library.path.name}: {verdict.reason}")
    tried = f"tried {'; '.join(faults)}" if faults else "found no libLLVM at all"
    raise BackendError(
        "no usable LLVM: install the package libllvm19 (Debian 12 and 13, Ubuntu 24.04), "
        "llvm-libs (Fedora, Arch) or llvm (macOS, by Homebrew); Ubuntu 22.04 has nothing newer "
        "than libllvm15: add the LLVM project's own apt repository for jammy and install "
        "libllvm19 from there, or move to 24.04; or name another libLLVM in DRJIT_LIBLLVM_PATH; "
        f"{tried}"
    )


def _named_llvm(named: str, probe: Probe) -> Library:
    """The library at the path that the user names, once Mitsuba has rendered with it."""
    library = Library(Path(named).resolve(), None)
    if not library.path.is_file():
        fault = "is a folder, not a libLLVM" if library.path.is_dir() else "no such file"
        raise BackendError(f"DRJIT_LIBLLVM_PATH: {fault} (got {named!r})")
    verdict = probe(library)
    if verdict.works:
        return library
    raise BackendError(
        f"DRJIT_LIBLLVM_PATH: cannot render with {named} ({verdict.reason}); "
        "name a libLLVM of version 17 or newer, or unset it"
    )


def newest_first(paths: Iterable[Path]) -> list[Library]:
    """The libraries behind ``paths``, links resolved, each once, newest major version first.

    Files that are not libLLVM itself are left out; those of unknown version come last.
    """
    libraries = set()
    for path in paths:
        resolved = path.resolve()
        if match := _NAME.fullmatch(resolved.name):
            major = match[1] or match[2]
            libraries.add(Library(resolved, int(major) if major else None))
    return sorted(libraries, key=lambda found: (-(found.major or 0), str(found.path)))


def _installed_libraries() -> list[Path]:
    """Every file named like a libLLVM that the dynamic linker or the usual folders hold."""
    paths = []
    if ldconfig := shutil.which("ldconfig", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"):
        listed = subprocess.run([ldconfig, "-p"], capture_output=True, text=True).stdout
        paths += [Path(name) for name in re.findall(r"=> (\S*libLLVM\S*)", listed)]
    for root in _ROOTS:
        for place in _PLACES:
            found = Path(root).glob(f"{place}/libLLVM*")
            paths += [path for path in found if ".so" in path.name or path.suffix == ".dylib"]
    return [path for path in paths if path.is_file()]


def probe_library(library: Library) -> ProbeResult:
    """Whether Mitsuba renders with this libLLVM, tried in a process of its own."""
    return _probe(LLVM, {"DRJIT_LIBLLVM_PATH": str(library.path)})


def _probe(variant: str, settings: Mapping[str, str]) -> ProbeResult:
    # A fresh home, so that no kernel out of Dr.Jit's disk cache answers for the compiler.
    with tempfile.TemporaryDirectory(prefix="lscan-probe-") as home:
        try:
            done = subprocess.run(
                [sys.executable, "-c", _PROBE, variant],
                env={**os.environ, **settings, "HOME": home},
                cwd=home,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=PROBE_TIMEOUT_S,
            )
        except subprocess.TimeoutExpired:
            reason = f"no answer within {PROBE_TIMEOUT_S:.0f} s"
            return ProbeResult(works=False, reason=reason, final=False)
    return _judge(done.returncode, done.stderr)


def _judge(code: int, stderr: str) -> ProbeResult:
    """A crash is the library's doing; a plain failure may not be and is not held against it.

    Raises BackendError where Mitsuba is not even loaded, with any LLVM, for want of a library.
    """
    if code == 0:
        return ProbeResult(works=True)
    if lacking := re.search(r"ImportError: (\S+): cannot open shared object file", stderr):
        raise BackendError(
            f"mitsuba needs {lacking[1]}, which this system lacks: install its package "
            f"(of libatomic.so.1, {ATOMIC} on Debian and Ubuntu, libatomic elsewhere)"
        )
    lines = [line.strip() for line in stderr.splitlines() if line.strip()] or ["no message"]
    fatal = [line for line in lines if "LLVM ERROR" in line]
    reason = re.sub(r":? 0x.*", "", (fatal or lines[-1:])[0])[:120]  # without its addresses
    if code > 0:
        return ProbeResult(works=False, reason=reason, final=False)
    crashed = -code in (signal.SIGABRT, signal.SIGSEGV, signal.SIGILL)
    reason = f"takes the process down with {signal.Signals(-code).name} ({reason})"
    return ProbeResult(works=False, reason=reason, final=crashed)


def probe_remembered(library: Library, probe: Probe = probe_library) -> ProbeResult:
    """What ``probe`` says of this library, or said before of the same file and Dr.Jit.

    Answers are kept in ``llvm.json`` of the user's cache; a file that cannot be read
    counts as empty, and one that cannot be written is done without.
    """
    folder = cache_folder()
    cache = folder and folder / "llvm.json"
    answers: dict[str, ProbeResult] = {}
    with suppress(ValueError):
        kept = cache and read_cached(cache, MOST_TEXT_BYTES)
        answers = ANSWERS.validate_json(kept or b"", strict=True)
    facts = library.path.stat()
    key = f"{library.path} {facts.st_mtime_ns} {facts.st_size} drjit-{version('drjit')}"
    if key in answers:
        return answers[key]
    verdict = probe(library)
    if verdict.final and cache:
        with suppress(InputError):
            write_atomically(cache, ANSWERS.dump_json({**answers, key: verdict}, indent=1))
    return verdict


@cache
def _require_mitsuba() -> None:
    """Raise BackendError where Mitsuba or Dr.Jit is not there as this version of lscan pins it.

    Another Dr.Jit than Mitsuba was built with, or another Mitsuba, may fail as a library that is
    missing, as anything else, or not at all, with other pictures.
    """
    remedy = "pip install 'lscan[tank]', or run make test"
    if importlib.util.find_spec("mitsuba") is None:
        raise BackendError(f"mitsuba is not installed: {remedy}")
    for line in requires("lscan") or []:
        pin = re.match(r"(mitsuba|drjit)==([\w.]+)", line)
        if pin and (found := _installed_version(pin[1])) != pin[2]:
            raise BackendError(f"{pin[1]}: got {found} (needed: {pin[2]}): {remedy}")


def _installed_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def find_or_install() -> Library:
    """The libLLVM to render with, installed first where none serves, as what Dr.Jit needs besides.

    Raises BackendError; where installing failed too, its line says both.
    """
    if find_library("atomic") is None:
        with suppress(PackageError):  # the probe says what is lacking
            install_first((ATOMIC,))
    return found_or_installed(find_llvm, PACKAGES, "DRJIT_LIBLLVM_PATH")


def main(arguments: list[str] | None = None) -> int:
    """The exit code of ``python -m sim.render.backend [--install]``: 0, or 2 after one line."""
    parser = argparse.ArgumentParser(prog="python -m sim.render.backend", description=main.__doc__)
    parser.add_argument("--install", action="store_true", help="install an LLVM if none serves")
    options = parser.parse_args(arguments)
    try:
        _require_mitsuba()
        library = find_or_install() if options.install else find_llvm()
    except BackendError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(library.path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
