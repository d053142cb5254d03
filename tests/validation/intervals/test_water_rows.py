"""The rows of lengths in other water see what they are for."""

import numpy as np
import pytest

from lscan.calibration.maps.refractive import Refractive
from tests.validation.intervals.water import carried_ratios


@pytest.mark.slow
def test_a_map_without_what_moves_it_elsewhere_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the modes alone that move the map as it is, lengths are many sigmas off."""
    assert np.abs(carried_ratios("refractive", "vague", 2, 1)).max() < 4
    whole = Refractive.in_water

    def pruned(self: Refractive, known: tuple[float, float]) -> Refractive:
        modes, count = self._modes_by_effect()
        return whole(self.model_copy(update={"modes": modes[:, : count - 1]}), known)

    monkeypatch.setattr(Refractive, "in_water", pruned)
    assert np.abs(carried_ratios("refractive", "vague", 2, 1)).max() > 4
