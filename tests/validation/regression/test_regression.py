"""What the theme regression measures by: mutants are extractors that differ, harms are refused."""

import time

import numpy as np
import pytest
from suite_cases import drawn_case, drawn_suite

from lscan.errors import InputError
from lscan.stripe import extract_stripe
from lscan.suites import open_suite, pack_suite, verify_suite
from tests.validation.regression import chapters as run, mutants
from tests.validation.regression.suites import HARMS, harmed


def _lines():
    """A faint line, a clear one and a clipped one, each beside columns of noise alone."""
    rng = np.random.default_rng(3)
    for peak_dn in (12.0, 150.0, 400.0):
        case = drawn_case(1, peak_dn)
        case.picture[:, :10] = rng.normal(4.0, 1.0, (len(case.picture), 10, 1)).round()
        yield case


@pytest.mark.parametrize("name", mutants.MUTANTS)
def test_a_mutant_is_an_extractor_that_differs(name):
    def found(extractor):
        for case in _lines():
            settings = case.settings.model_copy(update={"extractor": extractor})
            stripe = extract_stripe(case.picture, settings)
            yield from (stripe.centre_px, stripe.sigma_px, stripe.status)

    pairs = zip(found(mutants.MUTANTS[name]), found(f"{mutants.__name__}:{name}"), strict=True)
    assert not all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)


def test_the_suite_judged_is_of_this_code(monkeypatch):
    """Not the one that other code of this version may have left in the cache."""
    asked = []
    monkeypatch.setattr(run, "suites_found", dict)
    monkeypatch.setattr(
        run, "make_cached_suite", lambda spec, name, **words: asked.append((name, words))
    )
    assert run._rendered(run.NAME) == []
    assert asked == [(run.NAME, {"afresh": True})]


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("harm") / "drawn"
    folder.mkdir()
    drawn_suite(folder)
    file = folder.with_suffix(".zip")
    pack_suite(folder, file)
    return file


@pytest.mark.parametrize("number", range(len(HARMS)))
def test_what_is_harmed_is_another_and_refused(archive, tmp_path, monkeypatch, number):
    whole = archive.read_bytes()
    data = harmed(open_suite(archive), whole, number)
    assert data != whole
    later = time.time() + 3600.0
    monkeypatch.setattr(time, "time", lambda: later)
    assert data == harmed(open_suite(archive), whole, number)
    file = tmp_path / "harmed.zip"
    file.write_bytes(data)
    with pytest.raises(InputError, match=str(file)):
        verify_suite(file)
