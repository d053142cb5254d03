"""The intervals of indices hold their level."""

from tests.validation.studies.coverage import coverage_rows


def test_rows_are_made_of_each_function_and_kind() -> None:
    rows = coverage_rows(seed=3, base=32, repeats=4)
    assert [row.seed for row in rows] == [3] * 8
    assert rows[0].what == "95 % intervals of first-order Sobol' indices, Ishigami: off 95 %"
    assert rows[3].what == "95 % intervals of total Sobol' indices, Sobol' G: off 95 %"
    assert rows[7].what.startswith("95 % intervals of total Sobol' indices from two tiers, nearly")
    assert all("4 studies" in row.reference and row.bar == 2 for row in rows)
