"""Arrays of NumPy's that kernels read: the same numbers, in memory that may be read."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, strategies as st
from places import SUPPORT

from sim.render.plugins.arrays import VECTOR, floats, indices, long_indices, vectors

# A child, for whoever reads what is not there dies.
GUARDED = f"""
import os, sys
sys.path.insert(0, {str(SUPPORT)!r})
from guardedarrays import guard_arrays
import numpy as np
from sim.render.backend import load_mitsuba
mi = load_mitsuba()
from sim.render.plugins.arrays import floats, indices, long_indices
guard_arrays()
"""
ODD = "np.arange(5001, dtype=np.float32)"
RENDERED = """
from sim.scene import load_scene
from sim.render.tank import Tank
from tests.validation.light.gallery import shrunk
for name, light in {cases!r}:
    scene = shrunk(load_scene(name), 8).with_tank(render={{"light": light}})
    Tank(scene).render(0.0)
"""


def ended(code: str) -> int:
    """The status of a child in which a forbidden page lies behind each array of NumPy's."""
    # The child leaves without taking down what NumPy still holds.
    done = subprocess.run(
        [sys.executable, "-c", f"{GUARDED}{code}\nos._exit(0)"], capture_output=True, text=True
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode


@given(count=st.integers(0, 100), seed=st.integers(0, 9))
def test_loops_read_the_same_numbers(count: int, seed: int) -> None:
    """To 24 bits, as Dr.Jit's floats have; integers as they are."""
    numbers = np.random.default_rng(seed).normal(size=(3, count))
    whole = np.random.default_rng(seed).integers(0, 2**32, count)
    assert np.array_equal(np.array(floats(numbers)), numbers.ravel().astype(np.float32))
    assert np.array_equal(np.array(vectors(numbers)), numbers.astype(np.float32))
    assert np.array_equal(np.array(indices(whole)), whole)
    assert np.array_equal(np.array(long_indices(whole << 31)), whole << 31)


@given(count=st.integers(1, 100))
def test_all_begin_where_a_cache_line_does(count: int) -> None:
    assert np.from_dlpack(floats(np.zeros(count))).ctypes.data % (4 * VECTOR) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="pages are forbidden as on Linux")
def test_loops_do_not_read_past_the_end() -> None:
    kinds = ("floats", "indices", "long_indices")
    assert ended("\n".join(f"({kind}({ODD}) + 1).numpy()" for kind in kinds)) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="pages are forbidden as on Linux")
def test_the_guard_notices_who_reads_past_the_end() -> None:
    """What Dr.Jit does with an array of NumPy's itself: without that all this were needless."""
    assert ended(f"(mi.Float({ODD}) + 1).numpy()") == -signal.SIGSEGV


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="pages are forbidden as on Linux")
def test_pictures_do_not_read_past_the_end() -> None:
    cases = [("best/sandwave", "gathered"), ("targets/wet", "gathered")]
    assert ended(RENDERED.format(cases=cases)) == 0
