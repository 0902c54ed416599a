"""Every public batch call gives inside of `xla.plain()` what it gives outside."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import losses
from jaxro.batches import batch, padding
from jaxro.geometry import mock_pairs
from jaxro.rejection import PROCEDURES
from jaxro.xla import Trick, plain
from jaxro.xla.programs import compiled
from jaxro.xla.settings import is_plain

POINTS = 12


@pytest.fixture(scope="module")
def pairs():
    """Four near-vertical pairs, a wrong point in two of them."""
    elements = jaxro.IndependentElements(
        *(jnp.asarray(a) for a in (0.01, -0.02, 0.015, 0.02, 0.01))
    )
    near = mock_pairs.mock_pair(
        mock_pairs.standard_layout(POINTS),
        elements,
        focal=100.0,
        heights=jnp.linspace(-8.0, 8.0, POINTS),
    )
    keys = jax.random.split(jax.random.key(3), 4)
    pairs = jax.vmap(lambda key: mock_pairs.noisy(near, key, 0.01))(keys)
    wrong = np.zeros((4, POINTS))
    wrong[0, 3], wrong[1, 7] = 0.4, -1.0
    return mock_pairs.plant(pairs, y_right=jnp.asarray(wrong))


def check(call: Callable[[], object]) -> None:
    """The same numbers; rounding may decide whether a last step is taken."""
    usual = call()
    with plain():
        without = call()
    for (path, one), other in zip(
        jax.tree.leaves_with_path(usual), jax.tree.leaves(without), strict=True
    ):
        if "iterations" in jax.tree_util.keystr(path):
            continue
        if np.issubdtype(np.asarray(one).dtype, np.floating):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
        else:
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "options",
    [
        {"loss": losses.Huber(0.02)},
        pytest.param(
            {"elements": jaxro.IndependentElements, "base": 70.0},
            marks=pytest.mark.slow,
        ),
        pytest.param({"elements": jaxro.DependentElements}, marks=pytest.mark.slow),
    ],
    ids=["loss", "independent", "dependent"],
)
def test_orient_batch(pairs, options):
    vertical = jaxro.starts.Vertical()
    check(lambda: jaxro.orient_batch(pairs, start=vertical, **options))


@pytest.mark.slow
def test_near_vertical_pairs_and_pairs_in_any_position(pairs):
    anywhere, _ = mock_pairs.random_pairs(jax.random.key(1), 2, POINTS)
    noisy = jax.vmap(lambda pair, key: mock_pairs.noisy(pair, key, 0.01))
    anywhere = noisy(anywhere, jax.random.split(jax.random.key(3), 2))
    both = jax.tree.map(lambda *a: np.concatenate(a), pairs, anywhere)
    check(lambda: jaxro.orient_batch(both))


@pytest.mark.slow
def test_one_loop_of_points(pairs, monkeypatch):
    monkeypatch.setattr(batch, "ALONE", 0)
    monkeypatch.setattr(batch, "MOMENT", 0)
    check(lambda: jaxro.orient_batch(pairs))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["recommended", "data-snooping", "two-stage", "danish"],
)
def test_clean_batch(pairs, name):
    check(lambda: jaxro.clean_batch(pairs, PROCEDURES[name]))


@pytest.mark.slow
def test_map_batch(pairs):
    def assess(pair):
        oriented = jaxro.orient(pair, start=jaxro.starts.Vertical())
        return jaxro.assess(pair, oriented, sigma0=0.01)

    check(lambda: jaxro.map_batch(assess, pairs))


@pytest.mark.slow
def test_ragged(pairs):
    """Two sizes, so that two batches overlap in threads of their own."""
    each = jaxro.unstack(pairs)
    short = jax.tree.map(lambda a: a[:8] if a.ndim else a, each[2])
    ragged = jaxro.join([*each, short])
    vertical = jaxro.starts.Vertical()
    check(lambda: jaxro.orient_ragged(ragged, start=vertical))
    one_size = padding.Plan((POINTS,), (4,), (POINTS,))
    three_sigma = PROCEDURES["three-sigma"]
    check(lambda: jaxro.clean_ragged(ragged, three_sigma, plan=one_size))


def test_what_was_compiled_in_the_other_mode_is_not_used():
    seen = []

    @jax.jit
    def shared(x):
        seen.append(is_plain(Trick.SUMS))
        return x + 1

    call = jax.jit(lambda x: shared(x))
    for mode in (plain(Trick(0)), plain(), plain(Trick(0)), plain(Trick.SUMS)):
        with mode:
            call(1.0)
            shared(1.0)
            compiled(shared_program)(np.ones(2), shared=shared)
    assert sorted(seen) == [False] * 2 + [True] * 4


def shared_program(data, *, shared):
    return shared(data)


def test_a_program_of_plain_is_plain_in_any_thread():
    seen = []

    def function(data):
        seen.append(is_plain(Trick.SUMS))
        return data

    with plain():
        program = compiled(function).bind()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(program, np.ones(3)).result()
    compiled(function)(np.ones(3))
    assert seen == [True, False]


def test_no_memory_is_no_refusal_of_a_kernel():
    def kernel(function):
        def within(data):
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

        return within

    run = compiled(lambda data: data, kernel=kernel)
    for _ in range(2):  # after a refusal the second call would do without the kernel
        with pytest.raises(jax.errors.JaxRuntimeError, match="Out of memory"):
            run(np.ones(3))
