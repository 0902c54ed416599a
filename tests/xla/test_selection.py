"""What only some of many pairs need: given to them alone, in little memory, however
deep the batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro.xla.selection import where_needed

MOST = 7


def roots(data):
    """Square roots by Newton's rule, in a loop as long as each needs, and the sum with
    what is the same for all."""
    value, same = data
    closer = lambda x: (x + value / x) / 2
    far = lambda x: jnp.abs(x * x - value) > 1e-12 * value
    return {
        "root": jax.lax.while_loop(far, closer, value),
        "sum": value + jnp.sum(same),
    }


def chosen(needed, value):
    return where_needed(
        roots, needed, (value, jnp.ones(3)), {"root": -value, "sum": -value}, MOST
    )


def check(out, needed, value):
    np.testing.assert_allclose(
        out["root"], np.where(needed, np.sqrt(value), -value), rtol=1e-10
    )
    np.testing.assert_allclose(
        out["sum"], np.where(needed, value + 3, -value), rtol=1e-12
    )


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("size", [MOST + 1, 5 * MOST, 5 * MOST + 3])
def test_only_those_that_need_it(size, share):
    rng = np.random.default_rng(size)
    needed, value = rng.random(size) < share, rng.uniform(0.5, 100, size)
    out = jax.jit(jax.vmap(chosen))(needed, value)
    check(out, needed, value)


def test_a_few_are_done_together():
    value = np.array([4.0, 9.0, 2.0])
    out = jax.vmap(chosen)(np.array([True, True, True]), value)
    check(out, True, value)


def test_a_batch_of_batches_and_what_is_the_same_for_all():
    rng = np.random.default_rng(1)
    needed, value = rng.random((11, 13)) < 0.3, rng.uniform(0.5, 100, (11, 13))
    check(jax.jit(jax.vmap(jax.vmap(chosen)))(needed, value), needed, value)
    check(
        jax.jit(jax.vmap(chosen, in_axes=(None, 0)))(np.array(True), value[:, 0]),
        True,
        value[:, 0],
    )
    check(
        jax.jit(jax.vmap(chosen, in_axes=(0, None)))(needed[0], np.array(3.0)),
        needed[0],
        np.full(13, 3.0),
    )


def test_memory_is_that_of_a_few():
    """A function that takes 8 MB each, of 1,000."""

    def large(seed):
        table = jnp.sin(seed + jnp.arange(1000.0))
        product = jnp.sort((table[:, None] * table[None, :]).ravel())
        return product[0]

    one = lambda needed, seed: where_needed(large, needed, seed, seed, MOST)
    program = jax.jit(jax.vmap(one)).lower(np.ones(1000, bool), np.ones(1000)).compile()
    assert program.memory_analysis().temp_size_in_bytes < 10 * MOST * 8e6
