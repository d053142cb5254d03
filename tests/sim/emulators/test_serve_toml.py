"""The writer of TOML against the standard library's reader."""

from __future__ import annotations

import math
import tomllib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lscan.errors import InputError
from sim.emulators.toml import toml_text

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
values = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=12,
)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.dictionaries(texts, values, max_size=4))
def test_what_is_written_is_read_back(document: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(document)) == document


@pytest.mark.parametrize(
    ("value", "allowed"),
    [(math.nan, "finite"), (math.inf, "finite"), (None, "tables"), ("\ud800", "Unicode")],
)
def test_what_cannot_be_read_back_is_refused(value: object, allowed: str) -> None:
    with pytest.raises(InputError, match=rf"a\.b: cannot be written .*{allowed}"):
        toml_text({"a": {"b": value}})


def test_keys_are_texts() -> None:
    with pytest.raises(InputError, match="keys that are texts"):
        toml_text({"a": {1: 2}})
