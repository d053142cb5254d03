"""Distributions of a cause's number: their quantiles against mean, spread and each other."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import example, given, strategies as st
from scipy import stats

from lscan.config.documents import Document, check
from lscan.errors import InputError
from sim.studies.studyfile import Distribution

STATED: list[Document] = [
    {"fixed": 3.0},
    {"normal": (2.0, 0.5)},
    {"uniform": (-1.0, 3.0)},
    {"triangular": (0.0, 1.0, 4.0)},
    {"triangular": (2.0, 2.0, 2.0)},
    {"lognormal": (5.0, 0.2)},
    {"values": (1.0, 2.0, 7.0)},
    {"values": (1.0, 2.0), "weights": (3.0, 1.0)},
]
COUNT = 1 << 16


@pytest.mark.parametrize("stated", STATED, ids=str)
def test_mean_and_deviation_are_those_of_the_quantiles(stated: Document) -> None:
    """The midpoint rule over COUNT quantiles; of a normal tail cut off at 1/(2 COUNT) 1e-3."""
    one = Distribution.model_validate(stated)
    drawn = np.array([one.quantile((k + 0.5) / COUNT) for k in range(0, COUNT, 16)])
    assert drawn.mean() == pytest.approx(one.mean, rel=2e-3, abs=1e-12)
    assert drawn.std() == pytest.approx(one.deviation, rel=5e-3, abs=1e-12)


@pytest.mark.parametrize(
    ("stated", "reference"),
    [
        ({"normal": (2.0, 0.5)}, stats.norm(2.0, 0.5)),
        ({"uniform": (-1.0, 3.0)}, stats.uniform(-1.0, 4.0)),
        ({"triangular": (0.0, 1.0, 4.0)}, stats.triang(0.25, 0.0, 4.0)),
        ({"lognormal": (5.0, 0.2)}, stats.lognorm(0.2, scale=5.0)),
    ],
    ids=["normal", "uniform", "triangular", "lognormal"],
)
def test_quantiles_are_scipys(stated: Document, reference: stats.rv_continuous) -> None:
    one = Distribution.model_validate(stated)
    shares = np.linspace(0.001, 0.999, 97)
    found = [one.quantile(float(share)) for share in shares]
    np.testing.assert_allclose(found, reference.ppf(shares), rtol=1e-12, atol=1e-12)


@examples(60)
@example({"triangular": (0.0, 1.0, 4.0)}, 0.0)
@given(st.sampled_from(STATED), st.floats(0.0, 3.0))
def test_drawn_in_the_spread_is_in_proportion(stated: Document, factor: float) -> None:
    """But of a log-normal number, whose logarithm's is."""
    spread = Distribution.model_validate(stated)
    drawn = spread.scaled(factor)
    assert drawn.kind == spread.kind
    if spread.lognormal is not None:
        assert drawn.lognormal == (5.0, pytest.approx(0.2 * factor))
    else:
        assert drawn.deviation == pytest.approx(factor * spread.deviation, abs=1e-12)
        assert drawn.mean == pytest.approx(spread.mean)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({}, "exactly one of fixed"),
        ({"uniform": (1.0, 0.0)}, "the lower end"),
        ({"triangular": (0.0, 5.0, 4.0)}, "must rise"),
        ({"values": (1.0, 2.0), "weights": (1.0,)}, "one for each"),
    ],
    ids=str,
)
def test_what_is_no_distribution_is_refused(stated: Document, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check(Distribution, stated, "study.toml")


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"fixed": 35.0}, "35"),
        ({"normal": (0.0, 0.02)}, "normal 0 ± 0.02"),
        ({"uniform": (0.0, 35.0)}, "uniform 0 to 35"),
    ],
)
def test_in_words(stated: Document, words: str) -> None:
    assert Distribution.model_validate(stated).in_words == words
