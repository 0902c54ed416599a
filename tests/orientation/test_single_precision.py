"""What is done in single precision: how accurate it is, and that nothing of it is left
in a solution."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from workload import FOCAL, aerial

import jaxro
from jaxro.orientation import starts
from jaxro.rejection.hypotheses import Newton


def angles(one: jaxro.RelativePose, other: jaxro.RelativePose) -> np.ndarray:
    """Twice the largest difference of an entry of the quaternion or of b of every pair:
    radians, for small ones."""
    entries = lambda pose: np.stack([np.asarray(a) for a in jax.tree.leaves(pose)])
    return 2 * np.max(np.abs(entries(one) - entries(other)), axis=0)


@pytest.mark.slow
def test_subsets_are_solved_to_their_noise():
    """Five points solved in single precision: 1e-5 rad beside the exact solution, a
    hundredth of what noise does."""
    subset = jaxro.pair(*aerial(200, 5), focal=FOCAL)
    hypotheses = Newton(steps=6)
    poses, fine = problems.jit(jax.vmap(lambda p: hypotheses(p, hypotheses.begin(p))))(
        subset
    )
    exact = problems.jit(jax.vmap(lambda p: jaxro.orient(p, start=starts.Vertical())))(
        subset
    )
    usable = np.asarray(exact.usable) & np.asarray(fine)[:, 0]
    assert usable.mean() > 0.8
    error = angles(jax.tree.map(lambda a: a[:, 0], poses), exact.pose)[usable]
    assert np.median(error) < 1e-5 and np.quantile(error, 0.95) < 1e-3


@pytest.mark.slow
def test_first_steps_leave_nothing_in_the_solution():
    """Two steps in single precision end within 2e-4 rad, and the solution is that
    without them, to its tolerance."""
    pairs = jaxro.pair(*aerial(200, 16), focal=FOCAL)
    solved = {
        steps: problems.jit(
            jax.vmap(lambda p, s=steps: jaxro.orient(p, start=starts.Vertical(s)))
        )(pairs)
        for steps in (0, 2)
    }
    begun = problems.jit(jax.vmap(lambda p: starts.Vertical(2)(p).pose))(pairs)
    assert np.max(angles(begun, solved[0].pose)) < 2e-4
    assert np.max(angles(solved[2].pose, solved[0].pose)) < 1e-9
    assert solved[2].pose.qw.dtype == solved[2].sigma0.dtype == jnp.float64
    np.testing.assert_allclose(solved[2].sigma0, solved[0].sigma0, rtol=1e-9)
