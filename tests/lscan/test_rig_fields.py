"""A rig file with any one field wrong is refused by its key, and reaches no device."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path

import pytest

from sim.hardware.fields import (
    crossed_rigs,
    devices_guarded,
    shortcoming,
    try_all,
    wrong_fields,
)
from sim.hardware.goodrigs import CAMERAS, TRACKS, good_rigs, write_beside

EVERY = 40
"""One wrong field of so many is tried in the quick test."""


def test_every_driver_has_its_options_listed() -> None:
    assert set(CAMERAS) == set(entry_points(group="lscan.cameras").names)
    assert set(TRACKS) == set(entry_points(group="lscan.tracks").names)


def test_one_wrong_field_of_many_and_every_broken_rule(tmp_path: Path) -> None:
    rigs = good_rigs()
    write_beside(tmp_path)
    wrongs = [wrong for rig in rigs for wrong in wrong_fields(rig)][::EVERY]
    wrongs += crossed_rigs(rigs)
    with devices_guarded() as touched:
        faults = {wrong.what: shortcoming(wrong, tmp_path / "rig.toml") for wrong in wrongs}
    assert {what: fault for what, fault in faults.items() if fault} == {}
    assert touched == []


def test_a_reader_that_accepts_is_noticed(tmp_path: Path) -> None:
    wrong = next(wrong_fields(good_rigs()[0]))
    assert shortcoming(wrong, tmp_path / "rig.toml", read=lambda file: None) == "is accepted"


@pytest.mark.slow
def test_every_wrong_field_is_refused() -> None:
    verdicts, touched = try_all()
    assert [verdict for verdict in verdicts if verdict.fault] == []
    assert touched == []
