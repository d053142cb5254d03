"""How late pictures come is measured by the laser's switching, and is never stated too short."""

from types import SimpleNamespace

import numpy as np
import pytest

from lscan.devices import trials as delay
from lscan.devices.api import Grab
from lscan.devices.trials import SWITCHES, picture_delay
from lscan.errors import DeviceError, MeasurementError

SWITCH_S = 0.004


class Bench:
    """A laser and a camera that sees it ``late_s`` late, on a clock of their own."""

    def __init__(self, late_s: float, period_s: float, exposure_s: float, line_dn: int) -> None:
        self.late_s, self.period_s, self.exposure_s = late_s, period_s, exposure_s
        self.line_dn, self.ended = line_dn, -np.inf
        self.now_s, self.switched = 0.0, [(-np.inf, False)]
        self.held_each = np.inf
        self._generator = np.random.default_rng(2)

    def laser_on(self) -> None:
        self._switch(True)

    def laser_off(self) -> None:
        self._switch(False)

    def _switch(self, lit: bool) -> None:
        self.now_s += SWITCH_S
        self.switched.append((self.now_s, lit))

    def sleep(self, time_s: float) -> None:
        self.now_s += time_s

    def preview(self) -> Grab:
        """The next picture to arrive: exposed up to ``late_s`` before, some three periods more."""
        newest = np.floor((self.now_s - self.late_s) / self.period_s)
        self.ended = max(newest, self.ended) + 1
        held_s = 3 * self.period_s * (self.ended % self.held_each == 0)
        self.now_s = self.ended * self.period_s + self.late_s + held_s
        times_s = self.ended * self.period_s - self.exposure_s * np.linspace(0, 1, 41)
        light = np.mean([self._lit(time_s) for time_s in times_s])
        image = self._generator.integers(10, 14, (24, 32, 3)).astype(np.uint8)
        image[11:13, :, 0] += np.uint8(light * self.line_dn)
        return Grab(image, self.now_s, 1000 * self.exposure_s)

    def _lit(self, time_s: float) -> bool:
        return next(lit for since_s, lit in reversed(self.switched) if since_s <= time_s)


def bench(
    monkeypatch: pytest.MonkeyPatch,
    late_s: float,
    period_s: float = 0.04,
    exposure_s: float = 0.02,
    line_dn: int = 200,
) -> Bench:
    made = Bench(late_s, period_s, exposure_s, line_dn)
    clock = SimpleNamespace(monotonic=lambda: made.now_s, sleep=made.sleep)
    monkeypatch.setattr(delay, "time", clock)
    return made


@pytest.mark.parametrize("late_s", [0.0, 0.13, 2.4])
@pytest.mark.parametrize("period_s", [0.033, 0.1])
def test_no_picture_is_older_than_the_delay_says(
    monkeypatch: pytest.MonkeyPatch, late_s: float, period_s: float
) -> None:
    """A picture that arrives so long after a call was exposed after it, from its beginning on:
    at least the delay and nine tenths of the exposure.  A period and the switch are the most more.
    """
    exposure_s = period_s / 2
    here = bench(monkeypatch, late_s, period_s, exposure_s)
    found = picture_delay(here, here)
    assert 1000 * (late_s + 0.9 * exposure_s) <= found.longest_ms
    assert found.longest_ms <= 1000 * (late_s + exposure_s + period_s + SWITCH_S) + 1e-6
    assert found.median_ms <= found.longest_ms and found.switches == SWITCHES
    assert not here.switched[-1][1]


def test_flush_ms_has_a_margin_for_pictures_that_the_ten_switches_did_not_meet(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One picture in 23 is held back by three periods more than the others."""
    here = bench(monkeypatch, late_s=0.13)
    here.held_each = 23
    found = picture_delay(here, here)
    ages_ms = []
    for _ in range(100):
        here.preview()
        ages_ms.append(1000 * (here.now_s - here.ended * here.period_s + here.exposure_s))
    assert found.longest_ms < max(ages_ms) <= found.flush_ms


@pytest.mark.parametrize(("late_s", "line_dn"), [(0.1, 0), (5.0, 200), (60.0, 200)])
def test_a_laser_that_is_not_seen_in_time_is_no_delay(
    monkeypatch: pytest.MonkeyPatch, late_s: float, line_dn: int
) -> None:
    here = bench(monkeypatch, late_s, line_dn=line_dn)
    if late_s == 5.0:  # later than what is taken for settled: both references show the laser off
        monkeypatch.setattr(delay, "SETTLED_S", 1.0)
    with pytest.raises(MeasurementError, match="delay: "):
        picture_delay(here, here)
    assert not here.switched[-1][1]


def test_the_laser_is_off_after_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    here = bench(monkeypatch, 0.1)

    def fails_once_lit() -> Grab:
        if here.switched[-1][1]:
            raise DeviceError("camera: is gone")
        return Bench.preview(here)

    monkeypatch.setattr(here, "preview", fails_once_lit)
    with pytest.raises(DeviceError, match="is gone"):
        picture_delay(here, here)
    assert not here.switched[-1][1]
