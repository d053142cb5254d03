"""What holds for all tests: one thread for the matrices, and hardware only for who asks for it.

More threads cost small matrices, as they are here, more time than they save, all the more where
pytest-xdist runs as many tests at a time as there are cores.  NumPy reads the setting when it is
imported, which pytest does not do before it reads this file.  It lies above ``tests``, because
pytest puts the folder of a conftest first where Python looks for modules: from ``tests`` its
folder ``lscan`` would hide the package.

Tests marked ``hardware`` open a real camera and move a real track, those of a rig file:

    pytest -m hardware --rig my-rig.toml

Anything less, or several processes that would share one track, skips them.

The folder says what a test is, and it is marked so: ``hardware``, ``system`` (several rooms
together, as a command line or a browser uses them), or ``unit`` for all others.

Property tests draw the same examples each time: a quarter of those they state, and all of them by
``make test-all`` (the profile "full").  ``make soak`` draws others (the profile "soak", with a seed
of its own for each round).
"""

import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from chromium import Chromium

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if "PYTEST_XDIST_WORKER" in os.environ:  # as many of them render as there are cores
    os.environ.setdefault("LSCAN_THREADS", "1")
# Tests send them.  A shell without job control begins with SIGINT and SIGQUIT ignored what it runs
# by "&", and nohup with SIGHUP.
for name, usual in (
    ("SIGINT", signal.default_int_handler), ("SIGQUIT", signal.SIG_DFL), ("SIGHUP", signal.SIG_DFL)
):  # fmt: skip
    number = getattr(signal, name, None)  # Windows lacks two of them
    if number is not None and signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, usual)
# Tables of scattered light are made quickly; tests that judge them ask for photons of their own.
os.environ.setdefault("LSCAN_PHOTONS", "131072")

# No deadline: a test that is slow on a busy machine is no wrong test.
settings.register_profile("quick", deadline=None, derandomize=True, max_examples=25)
settings.register_profile("full", deadline=None, derandomize=True)
settings.register_profile("soak", deadline=None, derandomize=False, print_blob=True)
settings.load_profile("quick")

UNTIL_S = pytest.StashKey[float | None]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rig",
        default=os.environ.get("LSCAN_RIG"),
        help="rig file of the hardware for -m hardware (default: what LSCAN_RIG says)",
    )
    parser.addoption(
        "--minutes",
        type=float,
        help="skip what has not begun by then, in an order of its own each time (make soak)",
    )


def pytest_configure(config: pytest.Config) -> None:
    minutes = config.getoption("--minutes")
    config.stash[UNTIL_S] = None if minutes is None else time.monotonic() + 60 * minutes


@pytest.hookimpl(tryfirst=True)  # before -m chooses by the marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    tests = Path(__file__).parent / "tests"
    for item in items:
        folder = item.path.relative_to(tests).parts[0] if item.path.is_relative_to(tests) else ""
        item.add_marker(folder if folder in ("system", "hardware") else "unit")
    if config.getoption("--minutes") is not None:
        _shuffle_modules(items, config.getoption("--hypothesis-seed"))
    elif "PYTEST_XDIST_WORKER" in os.environ:
        _longest_first(items)
    reason = _why_not(config)
    if reason is None:
        return
    for item in items:
        if item.get_closest_marker("hardware") is not None:
            item.add_marker(pytest.mark.skip(reason=reason))


def _shuffle_modules(items: list[pytest.Item], seed: str | None) -> None:
    """Put the test modules in the seed's order; each keeps its own, for the fixtures it shares."""
    modules = sorted({item.path for item in items})
    random.Random(seed).shuffle(modules)
    items.sort(key=lambda item: modules.index(item.path))


def _longest_first(items: list[pytest.Item]) -> None:
    """Put the modules with slow tests first: one that begins last leaves the other workers idle.

    Those of an xdist_group are sent out before all others by pytest-xdist itself.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow") is not None}
    items.sort(key=lambda item: item.path not in slow)


def pytest_runtest_setup(item: pytest.Item) -> None:
    until_s = item.config.stash[UNTIL_S]
    if until_s is not None and time.monotonic() > until_s:
        pytest.skip("the minutes are over")


def _why_not(config: pytest.Config) -> str | None:
    """Why tests of hardware are skipped; None where they are to run."""
    if "hardware" not in config.getoption("-m") or config.getoption("--rig") is None:
        return "moves a real track: pytest -m hardware --rig my-rig.toml"
    if "PYTEST_XDIST_WORKER" in os.environ:
        return "there is one track for all: pytest -m hardware --rig my-rig.toml, without -n"
    return None


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk() -> Iterator[None]:
    """What is written is not waited for: that it is on the disk, only a loss of power could show.

    A descriptor that is not open is refused as before.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)
        yield


@pytest.fixture(scope="session")
def rig_path(pytestconfig: pytest.Config) -> Path:
    """The rig file of the hardware under test."""
    path: str = pytestconfig.getoption("--rig")
    return Path(path).absolute()


@pytest.fixture(scope="module")
def chromium() -> Iterator["Chromium"]:
    """A headless Chromium for the tests of a module, which skip where there is none.

    Not for the session: as long as it lasts, Playwright's event loop is that of this thread.
    """
    from tests.validation.browser import BrowserMissing, headless_chromium

    try:
        with headless_chromium() as browser:
            from chromium import Chromium  # needs Playwright

            yield Chromium(browser)
    except BrowserMissing as missing:
        pytest.skip(str(missing))


@pytest.fixture(scope="session")
def examples_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that examples in docstrings run in: small scans of the paper's board and block.

    board.toml, groove.toml, runs/board, runs/groove, calibration.json and surface.nc.
    """
    import lscan

    folder = tmp_path_factory.mktemp("examples")
    plans = {"board": "", "groove": "[plan]\nframes = 2\nstep_mm = 1.0\n"}
    for name, plan in plans.items():
        text = f'include = "paper/{name}"\n{plan}[render]\nsamples = 1\nscatter_samples = 0\n'
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
        lscan.scan(lscan.load_rig(folder / f"{name}.toml"), folder / "runs" / name)
    calibration = lscan.calibrate_run(lscan.open_run(folder / "runs" / "board"), "graticule-2")
    lscan.save_calibration(folder / "calibration.json", calibration)
    run = lscan.open_run(folder / "runs" / "groove")
    surface = lscan.reconstruct(run, calibration.plane_map).surface
    lscan.save_surface(folder / "surface.nc", surface)
    return folder


@pytest.fixture(autouse=True)
def _where_examples_run(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if isinstance(request.node, pytest.DoctestItem):  # pytest --doctest-modules FILE
        monkeypatch.chdir(request.getfixturevalue("examples_folder"))
