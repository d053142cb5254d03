"""The rows of the metric route's intervals are measured, on one kind of set."""

import numpy as np
import pytest

from tests.validation.intervals import metric


def test_each_kind_of_set_has_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metric, "FEW_SETS", 2)
    kinds = {name: metric.KINDS[name] for name in ("one board, bent by 0.2 mm",)}
    monkeypatch.setattr(metric, "KINDS", kinds)
    (found,) = metric.metric_rows(quick=True)
    assert found.what.endswith("one board, bent by 0.2 mm: off 95 %")
    assert "0 of 2 sets refused" in found.reference
    assert np.isfinite(found.figure)
