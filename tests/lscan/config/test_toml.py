"""The writer of TOML against the standard library's reader."""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.config.documents import toml_text, write_toml
from lscan.errors import InputError

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
values = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=12,
)


@examples(100)
@given(st.dictionaries(texts, values, max_size=4))
def test_what_is_written_is_read_back(document: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(document, "# Comments\n# stand first.")) == document


def test_comments_stand_first_and_numbers_on_one_line(tmp_path: Path) -> None:
    document = {"sheet": {"apex_mm": [75.0, 0.0, -9e-7]}, "to": ["a, ", ",\n]"]}
    write_toml(tmp_path / "rig.toml", document, "# Found.")
    text = (tmp_path / "rig.toml").read_text(encoding="utf-8")
    assert text.startswith("# Found.\n")
    assert "\napex_mm = [75.0, 0.0, -9e-07]\n" in text
    assert tomllib.loads(text) == document


def test_a_text_that_is_not_unicode_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"rig\.toml: cannot be written as TOML: .*Unicode"):
        write_toml(tmp_path / "rig.toml", {"a": {"b": "\ud800"}})
