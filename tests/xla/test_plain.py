"""Every public batch call gives inside of `xla.plain()` what it gives outside."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import losses
from jaxro.batches import batch
from jaxro.geometry import mock_pairs
from jaxro.rejection import PROCEDURES
from jaxro.xla import Trick, plain
from jaxro.xla.programs import Program
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
        {},
        {"elements": jaxro.DependentElements},
        {"elements": jaxro.IndependentElements, "base": 70.0},
        {"loss": losses.Huber(0.02)},
    ],
    ids=["relative", "dependent", "independent", "loss"],
)
def test_orient_batch(pairs, options):
    check(lambda: jaxro.orient_batch(pairs, **options))


def test_pairs_in_any_position():
    anywhere, _ = mock_pairs.random_pairs(jax.random.key(1), 2, POINTS)
    noisy = jax.vmap(lambda pair, key: mock_pairs.noisy(pair, key, 0.01))
    pairs = noisy(anywhere, jax.random.split(jax.random.key(3), 2))
    check(lambda: jaxro.orient_batch(pairs))


def test_one_loop_of_points(pairs, monkeypatch):
    monkeypatch.setattr(batch, "ALONE", 0)
    monkeypatch.setattr(batch, "MOMENT", 0)
    check(lambda: jaxro.orient_batch(pairs))


@pytest.mark.parametrize(
    "name", ["two-stage", "data-snooping", "danish", "recommended"]
)
def test_clean_batch(pairs, name):
    check(lambda: jaxro.clean_batch(pairs, PROCEDURES[name]))


def test_map_batch(pairs):
    def assess(pair):
        oriented = jaxro.orient(pair, start=jaxro.starts.Vertical())
        return jaxro.assess(pair, oriented, sigma0=0.01)

    check(lambda: jaxro.map_batch(assess, pairs))


def test_ragged(pairs):
    """Two sizes, so that two batches overlap in threads of their own."""
    each = jaxro.unstack(pairs)
    short = jax.tree.map(lambda a: a[:8] if a.ndim else a, each[2])
    ragged = jaxro.join([*each, short])
    vertical = jaxro.starts.Vertical()
    check(lambda: jaxro.orient_ragged(ragged, start=vertical))
    check(lambda: jaxro.clean_ragged(ragged, PROCEDURES["three-sigma"]))


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
            Program(shared_program, {"shared": shared})(np.ones(2))
    assert sorted(seen) == [False] * 2 + [True] * 4


def shared_program(data, *, shared):
    return shared(data)


def test_a_program_of_plain_is_plain_in_any_thread():
    seen = []

    def function(data):
        seen.append(is_plain(Trick.SUMS))
        return data

    with plain():
        program = Program(function, {})
    with ThreadPoolExecutor(1) as pool:
        pool.submit(program, np.ones(3)).result()
    Program(function, {})(np.ones(3))
    assert seen == [True, False]


def test_no_memory_is_no_refusal_of_a_kernel():
    def kernel(function):
        def within(data):
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

        return within

    program = Program(lambda data: data, {}, kernel=kernel)
    with pytest.raises(jax.errors.JaxRuntimeError, match="Out of memory"):
        program(np.ones(3))
    assert not program.refused
