"""Choosing an LLVM: newest first, tried once in another process, never an abort in this one."""

import importlib.metadata
import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

from sim.render import backend
from sim.render.backend import BackendError, Library, PackageError, ProbeResult, install_first

WORKS = ProbeResult(works=True)
FAILS = ProbeResult(works=False, reason="says no")


class FakeProbe:
    """Works for the given majors, fails for the rest, and keeps count of what it was asked."""

    def __init__(self, *working: int | None, answer: ProbeResult = FAILS) -> None:
        self.working, self.answer = working, answer
        self.asked: list[int | None] = []

    def __call__(self, library: Library) -> ProbeResult:
        self.asked.append(library.major)
        return WORKS if library.major in self.working else self.answer


@pytest.fixture(autouse=True)
def _clean_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.delenv("LSCAN_VARIANT", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def _libraries(folder: Path, *names: str) -> list[Path]:
    folder.mkdir(exist_ok=True)
    files = [folder / name for name in names]
    for file in files:
        file.write_bytes(b"not really a library")
    return files


@pytest.fixture
def crowd(tmp_path: Path) -> list[Path]:
    """LLVM 14, 15, 16 and 19 together, under the names that Debian gives them."""
    names = ("libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1", "libLLVM.so.19.1")
    return _libraries(tmp_path / "lib", *names)


@pytest.mark.parametrize(
    ("name", "major"),
    [
        ("libLLVM-14.0.6.so.1", 14),  # Debian 12's old and new names, and conda's
        ("libLLVM-16.so.1", 16),
        ("libLLVM.so.19.1", 19),
        ("libLLVM-18.so", 18),
        ("libLLVM.so.22.0git", 22),
        ("libLLVM.so", None),
        ("libLLVM-20.dylib", 20),  # Homebrew's old and new names
        ("libLLVM.dylib", None),
    ],
)
def test_the_major_version_is_read_from_the_name(
    tmp_path: Path, name: str, major: int | None
) -> None:
    [library] = backend.newest_first(_libraries(tmp_path / "lib", name))
    assert library.major == major


@pytest.mark.parametrize(
    "name", ["libLLVMSPIRVLib.so.14", "libLLVM-17-rust-1.75.0-stable.so", "libLLVMCore.a"]
)
def test_what_only_looks_like_llvm_is_left_out(tmp_path: Path, name: str) -> None:
    assert backend.newest_first(_libraries(tmp_path / "lib", name)) == []


def test_the_newest_is_chosen_in_whatever_order_they_are_found(crowd: list[Path]) -> None:
    for order in itertools.permutations(crowd):
        probe = FakeProbe(19)
        assert backend.find_llvm(order, probe).major == 19
        assert probe.asked == [19]


def test_one_that_fails_gives_way_to_the_next_older(crowd: list[Path], tmp_path: Path) -> None:
    newer = _libraries(tmp_path / "lib", "libLLVM.so.22.1", "libLLVM.so")
    probe = FakeProbe(19)
    assert backend.find_llvm([*crowd, *newer], probe).major == 19
    assert probe.asked == [22, 19]


def test_too_old_ones_are_never_probed_and_the_line_says_why(crowd: list[Path]) -> None:
    probe = FakeProbe()
    with pytest.raises(BackendError) as caught:
        backend.find_llvm(crowd, probe)
    assert probe.asked == [19, 16, 15]
    assert "libLLVM-14.so.1: too old" in str(caught.value)
    assert "libLLVM-16.so.1: says no" in str(caught.value)


@pytest.mark.parametrize("candidates", [[], ["libLLVM-15.so.1"]])
def test_where_none_serves_one_line_names_the_package(
    tmp_path: Path, candidates: list[str]
) -> None:
    with pytest.raises(BackendError) as caught:
        backend.find_llvm(_libraries(tmp_path / "lib", *candidates), FakeProbe())
    line = str(caught.value)
    assert "\n" not in line
    assert "libllvm19 (Debian 12 and 13, Ubuntu 24.04)" in line
    assert "Ubuntu 22.04" in line
    assert caught.value.exit_code == 2


def test_a_library_named_by_the_user_is_the_only_one_tried(
    crowd: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(crowd[2]))
    probe = FakeProbe(None)
    assert backend.find_llvm(probe=probe).path == crowd[2]
    assert probe.asked == [None]


def test_a_file_named_by_the_user_that_is_no_library_is_called_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dr.Jit would say that the library could not be found."""
    [file] = _libraries(tmp_path / "lib", "compiler.so")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(file))
    with pytest.raises(BackendError, match=r"compiler\.so \(OSError: .*(too short|ELF header)"):
        backend.find_llvm()


def test_a_library_named_by_the_user_that_fails_is_an_error(
    crowd: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(crowd[1]))
    with pytest.raises(BackendError, match=r"DRJIT_LIBLLVM_PATH: .*says no.*17 or newer"):
        backend.find_llvm(probe=FakeProbe(19))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(crowd[1].with_name("missing.so")))
    with pytest.raises(BackendError, match=r"DRJIT_LIBLLVM_PATH: no such file .*missing\.so"):
        backend.find_llvm(probe=FakeProbe(19))


# ---- what is remembered -----------------------------------------------------------------


CRASHED = ProbeResult(works=False, reason="took the process down")


@pytest.mark.parametrize("answer", [WORKS, CRASHED])
def test_a_final_answer_is_asked_for_once(crowd: list[Path], answer: ProbeResult) -> None:
    library, probe = Library(crowd[3], 19), FakeProbe(answer=answer)
    assert [backend.probe_remembered(library, probe) for _ in range(3)] == [answer] * 3
    assert probe.asked == [19]


def test_an_answer_that_is_not_final_is_asked_for_again(crowd: list[Path]) -> None:
    library = Library(crowd[3], 19)
    probe = FakeProbe(answer=ProbeResult(works=False, reason="no answer", final=False))
    for _ in range(2):
        backend.probe_remembered(library, probe)
    assert probe.asked == [19, 19]


def test_another_file_or_another_drjit_is_asked_anew(
    crowd: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    file, probe = crowd[3], FakeProbe(19)
    backend.probe_remembered(Library(file, 19), probe)
    file.write_bytes(b"a library of another size")
    backend.probe_remembered(Library(file, 19), probe)
    os.utime(file, ns=(1, 1))
    backend.probe_remembered(Library(file, 19), probe)
    monkeypatch.setattr(backend, "version", lambda _: "99.0")
    backend.probe_remembered(Library(file, 19), probe)
    assert probe.asked == [19] * 4
    backend.probe_remembered(Library(crowd[0], 14), probe)
    assert probe.asked[-1] == 14


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe", b"[]", b'"x"', b'{"a": 1}', b'{"a": {"works": 1}}']
)
def test_a_garbled_cache_counts_as_empty_and_is_replaced(
    crowd: list[Path], tmp_path: Path, content: bytes
) -> None:
    cache = tmp_path / "cache" / "lscan" / "llvm.json"
    cache.parent.mkdir(parents=True)
    cache.write_bytes(content)
    probe = FakeProbe(19)
    for _ in range(2):
        assert backend.probe_remembered(Library(crowd[3], 19), probe).works
    assert probe.asked == [19]
    assert len(json.loads(cache.read_text())) == 1
    assert [entry.name for entry in cache.parent.iterdir()] == ["llvm.json"]


def test_a_cache_that_cannot_be_written_is_done_without(crowd: list[Path], tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    probe = FakeProbe(19)
    for _ in range(2):
        assert backend.probe_remembered(Library(crowd[3], 19), probe).works
    assert probe.asked == [19, 19]


# ---- the verdict on a process -----------------------------------------------------------


def test_a_crash_is_final_and_a_plain_failure_is_not() -> None:
    abort = backend._judge(-6, "LLVM ERROR: Cannot select: 0x55: f32 = fminimum\n  more\n")
    assert abort == ProbeResult(
        works=False, reason="takes the process down with SIGABRT (LLVM ERROR: Cannot select)"
    )
    killed = backend._judge(-9, "")
    assert (killed.works, killed.final) == (False, False)
    failed = backend._judge(1, "Traceback\nImportError: the LLVM backend is inactive\n")
    assert failed == ProbeResult(
        works=False, reason="ImportError: the LLVM backend is inactive", final=False
    )
    assert backend._judge(0, "a warning") == WORKS


def test_a_library_that_mitsuba_lacks_is_no_fault_of_llvm() -> None:
    """As a bare Debian lacks libatomic: Dr.Jit 1.5.0 ends in a NameError about itself."""
    stderr = (
        "Traceback\nImportError: libatomic.so.1: cannot open shared object file: No such file\n"
        "During handling\nTraceback\nNameError: name '_drjit_ext' is not defined\n"
    )
    with pytest.raises(BackendError, match=r"^mitsuba needs libatomic\.so\.1, .*libatomic1"):
        backend._judge(1, stderr)
    llvms = "OSError: libedit.so.2: cannot open shared object file: No such file"
    assert backend._judge(1, llvms) == ProbeResult(works=False, reason=llvms, final=False)


def test_homebrews_libraries_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On macOS it links none of them into lib; no Mac was at hand, only its names are here."""
    lib = tmp_path / "Cellar" / "llvm" / "21.1.8" / "lib"
    lib.mkdir(parents=True)
    [library] = _libraries(lib, "libLLVM.dylib")
    (tmp_path / "opt").mkdir()
    (tmp_path / "opt" / "llvm").symlink_to(tmp_path / "Cellar" / "llvm" / "21.1.8")
    monkeypatch.setattr(backend, "_ROOTS", (tmp_path,))
    monkeypatch.setenv("PATH", "")
    found = backend.newest_first(backend._installed_libraries())
    assert Library(library.resolve(), None) in found


def test_a_probe_without_an_answer_is_ended(
    crowd: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(backend, "PROBE_TIMEOUT_S", 0.2)
    verdict = backend.probe_library(Library(crowd[3], 19))
    assert (verdict.works, verdict.final) == (False, False)


# ---- the package manager ----------------------------------------------------------------


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine whose apt-cache knows the names in ``known``, after an update those in ``new``.

    apt-get writes what it was asked to do into ``log``.
    """
    programs = tmp_path / "programs"
    programs.mkdir()
    here = f"cd '{tmp_path}'\n"
    _program(programs / "apt-cache", here + 'grep -qx "$2" known')
    _program(
        programs / "apt-get",
        here + 'for word; do verb="$verb $word"; done\n'
        'case "$verb" in *update*) echo update >>log; cat new >>known ;;\n'
        '*) echo "install ${verb##* }" >>log ;; esac',
    )
    for file in ("known", "new", "log"):
        (tmp_path / file).touch()
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    return tmp_path


def _program(file: Path, body: str) -> None:
    file.write_text(f"#!/bin/sh\n{body}\n")
    file.chmod(0o755)


@pytest.mark.parametrize(
    ("known", "new", "done"),
    [
        ("libllvm18\nlibllvm19\nlibllvm20", "", ["install libllvm19"]),
        ("libllvm17\nlibllvm21", "", ["install libllvm21"]),
        ("", "libllvm19", ["update", "install libllvm19"]),
    ],
)
def test_the_best_package_on_offer_is_installed(
    machine: Path, known: str, new: str, done: list[str]
) -> None:
    (machine / "known").write_text(known)
    (machine / "new").write_text(new)
    install_first(backend.PACKAGES)
    assert (machine / "log").read_text().splitlines() == done


def test_ubuntu_22_04_gets_no_install_but_a_line(machine: Path) -> None:
    (machine / "known").write_text("libllvm14\nlibllvm15\n")
    with pytest.raises(PackageError, match="offers none of libllvm19"):
        install_first(backend.PACKAGES)
    assert (machine / "log").read_text().split() == ["update"]


def test_without_the_right_to_install_nothing_is_tried(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (machine / "known").write_text("libllvm19\n")
    _program(machine / "programs" / "sudo", "exit 1")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(PackageError, match="root or a sudo"):
        install_first(backend.PACKAGES)
    assert (machine / "log").read_text() == ""


def test_what_drjit_needs_besides_is_installed_where_it_lacks(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "find_llvm", lambda: Library(Path("libLLVM.so.19.1"), 19))
    (machine / "known").write_text("libatomic1\n")
    backend.find_or_install()
    monkeypatch.setattr(backend, "find_library", lambda name: None)
    backend.find_or_install()
    assert (machine / "log").read_text().splitlines() == ["install libatomic1"]


def test_the_line_after_a_vain_install_says_both(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "_installed_libraries", list)
    with pytest.raises(BackendError, match=r"no usable LLVM.*; apt-get offers none"):
        backend.find_or_install()


# ---- this machine -----------------------------------------------------------------------


def _python(code: str, **settings: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
    )


def test_the_backend_needs_no_mitsuba_to_be_imported_and_refuses_an_unknown_variant() -> None:
    code = (
        "import sys; sys.modules['mitsuba'] = None; import sim.render.backend as b; print('in');"
        "del sys.modules['mitsuba']; b.load_mitsuba()"
    )
    done = _python(code, LSCAN_VARIANT="scalar_rgb")
    assert done.stdout.strip() == "in", done.stderr
    assert "LSCAN_VARIANT: got 'scalar_rgb'" in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="sends a signal of POSIX")
def test_a_signal_while_mitsuba_is_imported_acts_once_it_is() -> None:
    """Mitsuba's libraries, left half loaded, would end the program by SIGABRT."""
    code = (
        "import os, signal, sys\n"
        "from lscan.devices.signals import interrupted_by_signals\n"
        "class Finder:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'mitsuba.mitsuba_ext': os.kill(os.getpid(), signal.SIGTERM)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "try:\n"
        "    with interrupted_by_signals(): import sim.render.backend\n"
        "except KeyboardInterrupt: print('stopped', 'mitsuba' in sys.modules)\n"
    )
    done = _python(code)
    assert (done.stdout.strip(), done.returncode) == ("stopped True", 0), done.stderr


@pytest.mark.parametrize("variant", backend.GPUS)
def test_a_gpu_that_is_not_there_is_named_with_what_it_needs(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LSCAN_VARIANT", variant)
    monkeypatch.delitem(sys.modules, "mitsuba", raising=False)  # as before it is imported
    no_gpu = ProbeResult(works=False, reason="no such GPU", final=False)
    monkeypatch.setattr(backend, "_probe", lambda *asked: no_gpu)
    with pytest.raises(BackendError) as caught:
        backend.load_mitsuba()
    line = f"{variant} needs {backend.GPUS[variant]} (no such GPU); unset it to render with "
    assert str(caught.value).startswith(f"LSCAN_VARIANT: {line}")


def test_the_command_fails_with_one_line_and_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "missing.so")
    assert backend.main([]) == 2
    assert capsys.readouterr() == ("", "DRJIT_LIBLLVM_PATH: no such file (got 'missing.so')\n")


@pytest.mark.parametrize(
    ("name", "found"), [("drjit", "1.4.0"), ("mitsuba", "3.8.0"), ("drjit", "none")]
)
def test_another_mitsuba_or_drjit_than_pinned_is_refused_before_any_library_is_tried(
    name: str, found: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def installed(package: str) -> str:
        if package == name and found == "none":
            raise importlib.metadata.PackageNotFoundError(package)
        return found if package == name else importlib.metadata.version(package)

    backend._require_mitsuba.cache_clear()
    monkeypatch.setattr(backend, "version", installed)
    monkeypatch.setattr(backend, "find_llvm", lambda: pytest.fail("a library was tried"))
    needed = importlib.metadata.version(name)
    assert backend.main([]) == 2
    line = f"{name}: got {found} (needed: {needed}): pip install 'lscan[tank]', or run make test"
    assert capsys.readouterr().err.strip() == line
    with pytest.raises(BackendError, match=f"{name}: got {found}"):
        backend.load_mitsuba()  # which is loaded already where another test has rendered


def test_the_pinned_drjit_is_the_one_that_mitsuba_asks_for() -> None:
    ours, mitsubas = (
        next(line for line in importlib.metadata.requires(name) or [] if line.startswith("drjit"))
        for name in ("lscan", "mitsuba")
    )
    assert ours.partition(";")[0].strip() == mitsubas.partition(";")[0].strip()


@pytest.mark.parametrize("said", ["0", "-1", "two"])
def test_a_number_of_threads_that_is_none_is_refused(
    said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(backend.THREADS, said)
    with pytest.raises(backend.BackendError, match=f"LSCAN_THREADS: got '{said}'"):
        backend._threads(2)


def test_mitsuba_renders_with_the_library_chosen() -> None:
    code = (
        "import os, sim.render.backend as b; mi = b.load_mitsuba(); assert mi is b.load_mitsuba();"
        "import drjit as dr; print(dr.minimum(dr.opaque(mi.Float, 1, 2), mi.Float(2, 0)));"
        "print(mi.variant(), os.environ['DRJIT_LIBLLVM_PATH'] == str(b.find_llvm().path))"
    )
    done = _python(code)
    assert done.stdout.splitlines() == ["[1, 0]", "llvm_ad_mono True"], done.stderr


@pytest.mark.parametrize("threads, others", [(1, 0), (2, 1), (3, 2), (4, 3), (16, 3)])
def test_threads_are_shared_with_processes_and_taken_back(
    threads: int, others: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All get as many, whatever ends the block; half a GB each, so that there are four at most."""
    counts = [threads]
    monkeypatch.setattr("drjit.thread_count", lambda: counts[-1])
    monkeypatch.setattr("drjit.set_thread_count", counts.append)
    with pytest.raises(KeyboardInterrupt), backend.sharing() as environments:
        assert len(environments) == others
        each = {int(one[backend.THREADS]) for one in environments} | {counts[-1]}
        assert each == {threads // (1 + others)}
        raise KeyboardInterrupt
    assert counts[-1] == threads
