"""Programs that run in the thread that calls them, as users have them: not kept on
disk, as those of the other tests are."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro.geometry import mock_pairs
from jaxro.xla import programs
from jaxro.xla.programs import Program, jit_in_this_thread
from jaxro.xla.settings import RUN_FAST


@pytest.fixture
def unkept():
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    programs._compile.cache_clear()
    yield
    jax.config.update("jax_compilation_cache_dir", folder)
    programs._compile.cache_clear()


def long(x):
    """Some hundredth of a second, and more operations than JAX runs in the calling
    thread of itself."""
    return jax.lax.fori_loop(0, 3000, lambda _, x: x * 0.999 + 0.001, x)


def test_a_program_has_run_when_its_call_returns(unkept):
    x = jnp.linspace(0.0, 1.0, 3000)
    for run in (jit_in_this_thread(long), lambda x: Program(long, {}, RUN_FAST)(x)):
        jax.block_until_ready(run(x))
        assert run(x).is_ready()


@pytest.mark.parametrize(
    "first", [0.0, np.nan, np.inf, np.finfo(float).max, -np.finfo(float).max]
)
def test_whatever_the_first_number(unkept, first):
    x = np.array([first, 1.0, 2.0])
    np.testing.assert_array_equal(jit_in_this_thread(lambda x: (-x, x[:0]))(x)[0], -x)


@pytest.mark.parametrize(
    "data",
    [np.zeros((0, 2)), np.arange(3), np.array([True, False]), np.float32([1, 2])],
)
def test_arrays_of_any_kind(unkept, data):
    np.testing.assert_array_equal(
        jit_in_this_thread(lambda x: x[::-1])(data), data[::-1]
    )


def test_batches_from_two_threads_at_once_are_those_of_kept_programs(request):
    vertical = mock_pairs.mock_pair(mock_pairs.standard_layout(16))
    pairs = jax.vmap(lambda key: mock_pairs.noisy(vertical, key, 0.01))(
        jax.random.split(jax.random.key(5), 3000)
    )
    kept = jaxro.orient_batch(pairs)
    request.getfixturevalue("unkept")
    with ThreadPoolExecutor(2) as pool:
        for one in pool.map(jaxro.orient_batch, [pairs] * 4):
            jax.tree.map(np.testing.assert_array_equal, one, kept)


def test_where_jax_keeps_programs_it_keeps_these(tmp_path):
    code = f"""
import jax
jax.config.update("jax_compilation_cache_dir", {str(tmp_path)!r})
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
import jaxro
jaxro.orient(jaxro.pair(*4 * [[1.0, -2.0, 5.0, -6.0, 3.0, 8.0]], focal=100.0))
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert any("orient_near" in file.name for file in tmp_path.iterdir())
