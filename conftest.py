"""What holds for all tests: one thread for the matrices, and hardware only for who asks for it.

More threads cost small matrices, as they are here, more time than they save, all the more where
pytest-xdist runs as many tests at a time as there are cores.  NumPy reads the setting when it is
imported, which pytest does not do before it reads this file.  It lies above ``tests``, because
pytest puts the folder of a conftest first where Python looks for modules: from ``tests`` its
folder ``lscan`` would hide the package.

Tests marked ``hardware`` open a real camera and move a real track, those of a rig file:

    pytest -m hardware --rig my-rig.toml

Anything less, or several processes that would share one track, skips them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from sim.testing.browser import Chromium

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rig",
        default=os.environ.get("LSCAN_RIG"),
        help="rig file of the hardware for -m hardware (default: what LSCAN_RIG says)",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    reason = _why_not(config)
    if reason is None:
        return
    for item in items:
        if item.get_closest_marker("hardware") is not None:
            item.add_marker(pytest.mark.skip(reason=reason))


def _why_not(config: pytest.Config) -> str | None:
    """Why tests of hardware are skipped; None where they are to run."""
    if "hardware" not in config.getoption("-m") or config.getoption("--rig") is None:
        return "moves a real track: pytest -m hardware --rig my-rig.toml"
    if "PYTEST_XDIST_WORKER" in os.environ:
        return "there is one track for all: pytest -m hardware --rig my-rig.toml, without -n"
    return None


@pytest.fixture(scope="session")
def rig_path(pytestconfig: pytest.Config) -> Path:
    """The rig file of the hardware under test."""
    path: str = pytestconfig.getoption("--rig")
    return Path(path).absolute()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Chromium]:
    """A headless Chromium for the tests of a module, which skip where there is none.

    Not for the session: as long as it lasts, Playwright's event loop is that of this thread.
    """
    from sim.testing.browser import BrowserMissing, headless_chromium

    try:
        with headless_chromium() as browser:
            yield browser
    except BrowserMissing as missing:
        pytest.skip(str(missing))
