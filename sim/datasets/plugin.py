"""Plugin of pytest: pictures of the tank rendered in a test, where the tank is installed.

Loaded by every run of pytest where lscan is, as lscan.testing is.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from lscan.suites import BoardCase, SuiteCase


def pytest_configure() -> None:
    """Refuse to go on where another package's plug-in has the name of one of lscan's."""
    from lscan.testing import refuse_namesakes

    refuse_namesakes()


class TankPictures(Protocol):
    """Renders a scene, or shows it again: each content once in a run of pytest, and process."""

    def __call__(
        self, scene: str, sections: Mapping[str, Mapping[str, Any]] | None = None
    ) -> SuiteCase | BoardCase:
        """The picture that the scene's webcam takes at the start of its plan, and its truth.

        Parameters
        ----------
        scene : str, a name that ``lscan scenes`` lists, or a path
        sections : mapping, optional, by section, keys laid over the scene's own

        Raises
        ------
        InputError
            There is no such scene, or a key or a value is wrong.
        """
        ...


@pytest.fixture(scope="session")
def tank() -> TankPictures:
    """A function that renders a scene: a case of a line, or of the board where that is the target.

    The test is skipped where Mitsuba is not installed.
    """
    pytest.importorskip("mitsuba", reason="rendering needs pip install 'lscan[tank]'")
    from lscan.config.documents import by_content, merge, read_document
    from lscan.config.scenes import included_file
    from sim.datasets.cases import rendered_case

    known: dict[str, SuiteCase | BoardCase] = {}

    def case_shown(
        scene: str, sections: Mapping[str, Mapping[str, Any]] | None = None
    ) -> SuiteCase | BoardCase:
        document = merge(read_document(included_file(Path(), scene)), dict(sections or {}))
        content = json.dumps([scene, by_content(document)], sort_keys=True, default=str)
        if content not in known:
            known[content] = rendered_case(scene, document)
        return known[content]

    return case_shown
