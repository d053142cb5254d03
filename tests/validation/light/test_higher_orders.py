"""What verify says of light of higher orders: nothing where it is right, and what is wrong."""

from functools import partial

import numpy as np
import pytest

from lscan.records import Floats
from sim.render.layers import Layers
from sim.scene import Scene
from sim.truth import stripe_truth
from tests.validation.light import higherorders
from tests.validation.light.higherorders import LightEffort, target_rows
from tests.validation.light.judge import Judged
from tests.validation.rows import Row

# Pixels of the judge scatter by 1 %: sums over some 30 and more of them, in 8 batches, by less than
# 0.1 %, and no part may be off by more than the interval's half, 2.4 of these, beyond its bar.
NOISE, BATCHES = 0.01, 8
NAMES = "core", "halo", "veil", "centre", "pixel"


class FakeTank:
    """A line and a halo about the true line, and a veil; higher orders by faults of one's own."""

    def __init__(self, scene: Scene, *, veil: float = 1.0, halo: float = 1.0, off_px: float = 0.0):
        self.scene, self.veil, self.halo, self.off_px = scene, veil, halo, off_px

    def profile(self, position_mm: float, off_px: float, width_px: float) -> Floats:
        centre = np.nan_to_num(stripe_truth(self.scene, position_mm).centre_px, nan=-1e3)
        rows = np.arange(self.scene.rig.camera.height_px)[:, np.newaxis]
        return np.exp(-0.5 * ((rows - centre - off_px) / width_px) ** 2)

    def higher_orders(self, position_mm: float) -> dict[str, Floats]:
        light = 0.3 * self.profile(position_mm, self.off_px, 2.0)
        halo = 0.05 * self.halo * self.profile(position_mm, 0.0, 30.0)
        return {"surfaces": light + halo, "veil": np.full(light.shape, 0.01 * self.veil)}

    def render(self, position_mm: float, scatter_samples: int) -> Layers:
        assert scatter_samples == 0
        direct = self.profile(position_mm, 0.0, 1.5).astype(np.float32)
        return Layers(direct, 0 * direct, 0 * direct)


def judge(
    tank: FakeTank,
    position_mm: float,
    window: tuple[int, int, int, int],
    *_: object,
    noise: float = NOISE,
) -> Judged:
    """The light without faults, and noise."""
    left, top, width, height = window
    generator = np.random.default_rng(7)
    right = FakeTank(tank.scene).higher_orders(position_mm)
    inside = {name: light[top : top + height, left : left + width] for name, light in right.items()}
    return Judged(
        {
            name: light * generator.normal(1.0, noise, (BATCHES, height, width))
            for name, light in inside.items()
        }
    )


def rows_with(
    monkeypatch: pytest.MonkeyPatch, noise: float = NOISE, **faults: float
) -> dict[str, Row]:
    monkeypatch.setattr(higherorders, "Tank", partial(FakeTank, **faults))
    monkeypatch.setattr(higherorders, "judge", partial(judge, noise=noise))
    rows = target_rows("board", 1, LightEffort(columns=32))
    return dict(zip(NAMES, rows[-5:], strict=True))


@pytest.mark.parametrize(
    ("faults", "beyond"),
    [
        ({}, set()),
        ({"veil": 1.03}, {"veil"}),
        ({"halo": 1.03}, {"halo"}),
        # A third of the light 0.2 px off moves the centre by some 0.05 px, and pixels on the
        # flanks by 0.2 of 200 DN x 0.25 x 0.3.
        ({"off_px": 0.2}, {"centre", "pixel"}),
    ],
)
def test_what_is_off_is_shown(
    faults: dict[str, float], beyond: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = rows_with(monkeypatch, **faults)
    assert {name for name, row in found.items() if row.passed is False} == beyond
    assert all(row.bar is not None and np.isfinite(row.figure) for row in found.values())


def test_a_judge_too_noisy_decides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred times the noise hides twice what is required; means of more pixels show it."""
    found = rows_with(monkeypatch, noise=100 * NOISE)
    assert {name for name, row in found.items() if not row.decides} == set(NAMES) - {"pixel"}
    assert {name for name, row in found.items() if row.passed} == {"pixel"}
    assert all(row.passed is None for name, row in found.items() if name != "pixel")
    assert "means of 26 neighbours" in found["pixel"].reference
    assert "means of 8 neighbours" in rows_with(monkeypatch)["pixel"].reference
