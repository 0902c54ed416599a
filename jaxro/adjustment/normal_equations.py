"""Small normal equations, element by element, and the Gauss-Newton solver built on
them.

For p parameters the p(p+1)/2 + p + 1 sums N = JᵀJ, h = Jᵀr and rᵀr are accumulated by
one variadic reduction over the residuals, so that no Jacobian is ever stored, and the
system is solved by an unrolled Cholesky factorisation. Under `vmap` every operation is
element-wise over the pairs: no LAPACK (which deadlocks from two threads) and no batched
matrix product. Above `UNROLLED` parameters `symmetric` takes over.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree, ScalarLike

from ..xla.kernels import computed_once, kernel_part
from ..xla.passes import sums
from . import symmetric

Scalar = Float[Array, ""]
Scalars = Sequence[Any]
Columns = Sequence[Float[Array, " residual"]]
Lower = Sequence[Sequence[Any]]
"""Lower triangle of a symmetric matrix: row i has i + 1 entries."""

UNROLLED = 12
"""Largest number of parameters that is unrolled: beyond it the compiled program grows
faster than it runs."""

SINGULAR = 1e-12
"""Relative pivot below which a parameter counts as undetermined by those before it."""

LEAST = 0.4
"""Power of the smallest number of a type that is the smallest pivot: 1e-123 in double
precision."""

ROUNDING = 1e-10
"""Relative size of steps that have no use any more where they do not fall."""


def accumulate(
    r: Columns, jacobian: Sequence[Columns], weight: Columns | None = None, *more: Array
) -> tuple[Any, ...]:
    """N = JᵀWJ, h = JᵀWr and rᵀWr, from residuals and columns that may come in several
    arrays each, and in the same pass the sums of more arrays."""
    p = len(jacobian)
    parts = []
    for c, residual in enumerate(r):
        column = [jacobian[k][c] for k in range(p)]
        weighted = (
            [*column, residual]
            if weight is None
            else [weight[c] * a for a in (*column, residual)]
        )
        products = [weighted[i] * column[j] for i in range(p) for j in range(i + 1)]
        products += [weighted[p] * a for a in column] + [weighted[p] * residual]
        parts.append(sums((*products, *(more if c == 0 else ()))))
    total = [
        sum(part[1:], part[0]) for part in itertools.zip_longest(*parts, fillvalue=0)
    ]
    n = [[total.pop(0) for _ in range(i + 1)] for i in range(p)]
    return n, total[:p], *total[p:]


def columns(residual: Callable, x: Scalars) -> tuple[Columns, list[Columns], None]:
    """Residuals r(x) and the columns dr/dx_k of any residual function, by linearising
    it once."""
    r, push = jax.linearize(lambda *y: residual(y), *x)
    unit = jnp.eye(len(x), dtype=r.dtype)
    return (
        [r],
        [[push(*(unit[k, i] for i in range(len(x))))] for k in range(len(x))],
        None,
    )


def slopes(function: Callable, x: Scalars) -> tuple[Any, list[Any]]:
    """function(*x) and its derivatives by x_k, one after the other."""
    value, derivatives = None, []
    for k, at in enumerate(x):
        value, slope = jax.jvp(
            lambda t, k=k: function(*x[:k], t, *x[k + 1 :]), (at,), (jnp.ones_like(at),)
        )
        derivatives.append(slope)
    return value, derivatives


def inner(a: PyTree, b: PyTree) -> Any:
    """Sum of the products of the entries of two trees, numbers or arrays; whole numbers
    have no slopes and take no part."""

    def of(x, y):
        if y.dtype == jax.dtypes.float0:
            return None
        return x * y if jnp.ndim(x) == 0 else jnp.sum(x * y)

    products = jax.tree.leaves(jax.tree.map(of, a, b))
    return sum(products[1:], products[0])


def cholesky(n: Lower) -> tuple[Lower, Float[Array, "..."]]:
    """L with N = L Lᵀ, the *inverses* of its diagonal in place of the diagonal, and the
    smallest relative pivot.

    The relative pivot of a parameter is the part of its diagonal that those before it
    leave over; pivots below the rounding level are lifted to it, so that a singular
    system gives a large but finite solution; where all is zero, to LEAST of the type,
    so that the squares of the inverse and its derivatives are finite, too.
    """
    factor: list[list[Scalar]] = []
    smallest = jnp.ones_like(n[0][0])
    for i, row in enumerate(n):
        new: list[Scalar] = []
        for j in range(i + 1):
            s = row[j]
            for k in range(j):
                s = s - new[k] * (new if i == j else factor[j])[k]
            if i > j:
                new.append(s * factor[j][j])
            else:
                floor = (
                    jnp.finfo(s.dtype).eps * row[i] + jnp.finfo(s.dtype).tiny ** LEAST
                )
                smallest = jnp.minimum(smallest, s / (row[i] + jnp.finfo(s.dtype).tiny))
                new.append(lax.rsqrt(jnp.maximum(s, floor)))
        factor.append(new)
    return factor, smallest


def substitute(factor: Lower, h: Scalars) -> list[Any]:
    """N⁻¹ h by forward and back substitution; of many right-hand sides at once where
    the entries of h are arrays."""
    x: list[Any] = []
    for i, row in enumerate(factor):
        s = h[i]
        for k in range(i):
            s = s - row[k] * x[k]
        x.append(s * row[i])
    for i in reversed(range(len(x))):
        s = x[i]
        for k in range(i + 1, len(x)):
            s = s - factor[k][i] * x[k]
        x[i] = s * factor[i][i]
    return x


def quadratic(q: Lower, a: Sequence[Any]) -> Any:
    """aᵀ Q a of a symmetric matrix, given by its lower triangle; of many a at once
    where their entries are arrays."""
    return sum(
        a[i] * sum((1.0 if i == j else 2.0) * q[i][j] * a[j] for j in range(i + 1))
        for i in range(len(a))
    )


def dense(n: Lower) -> Float[Array, "p p"]:
    """The symmetric matrix as an array."""
    p = len(n)
    return jnp.stack(
        [jnp.stack([n[max(i, j)][min(i, j)] for j in range(p)]) for i in range(p)]
    )


def solve(n: Lower, h: Scalars) -> list[Scalar]:
    """N⁻¹ h."""
    if len(h) > UNROLLED:
        return list(symmetric.inverse(dense(n)).matrix @ jnp.stack(list(h)))
    return computed_once(lambda n, h: substitute(cholesky(n)[0], h))(n, h)


def correction(
    linear: tuple[Columns, Sequence[Columns], Columns | None],
) -> tuple[Scalar, ...]:
    """What Gauss-Newton subtracts from the parameters, from residuals, columns and
    weights."""
    n, h, _ = accumulate(*linear)
    return tuple(solve(n, h))


def inverse(n: Lower) -> tuple[Lower, Float[Array, "..."]]:
    """The lower triangle of N⁻¹ and the smallest relative pivot; of many matrices at
    once where the entries are arrays."""
    p = len(n)
    if p > UNROLLED:
        full, pivots = symmetric.inverse(dense(n))
        return [[full[i, j] for j in range(i + 1)] for i in range(p)], jnp.min(pivots)
    factor, pivot = cholesky(n)
    lower = inverse_of_lower(factor)

    def entry(i: int, j: int) -> Any:
        """Of L⁻ᵀ L⁻¹, i >= j."""
        rows = lower[i:]
        return sum((row[i] * row[j] for row in rows[1:]), rows[0][i] * rows[0][j])

    return [[entry(i, j) for j in range(i + 1)] for i in range(p)], pivot


def inverse_of_lower(factor: Lower) -> Lower:
    """L⁻¹, from L with the inverses of its diagonal."""
    rows: list[list[Scalar]] = []
    for i, row in enumerate(factor):
        new: list[Scalar] = []
        for j in range(i):
            products = [row[k] * rows[k][j] for k in range(j, i)]
            new.append(-row[i] * sum(products[1:], products[0]))
        rows.append([*new, row[i]])
    return rows


class GaussNewton(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton for a few parameters; its loop carries the parameters and four
    numbers of the last steps, nothing else.

    `args` that know their own correction, and how a step follows others
    (`residuals.Residuals`, `joint.Joint`), are asked for it; any other residual
    function is linearised. Ends when the *next* step, predicted from the last two, is
    below atol + rtol |x|, or below ROUNDING in their place if steps no longer fall:
    they are rounding errors then. Where corrections fall slowly and steadily along one
    direction, as they do where the residuals bend or their weights change, a step is as
    long as all that are to come (Aitken). `max_step` bounds the largest component of a
    step (0.5 rad for orientations, where a longer one leaves the range of the
    linearisation).
    """

    rtol: ScalarLike = 1e-12
    atol: ScalarLike = 1e-12
    max_step: ScalarLike = float("inf")
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        dtype = jnp.result_type(*jax.tree.leaves(y))
        none = jnp.zeros((), dtype)
        return jnp.asarray(jnp.inf, dtype), none, none, none

    def step(self, fn, y, args, options, state, tags):
        known = hasattr(args, "correction")
        delta = args.correction(y) if known else _correction(fn, y, args)
        _, previous, *steady = state
        stretch, steady = _stretch(_sum(delta), *steady)
        longest = _largest(delta) * stretch
        shrink = jnp.minimum(
            1.0, self.max_step / jnp.maximum(longest, jnp.finfo(longest.dtype).tiny)
        )
        taken = jax.tree.map(lambda d: -shrink * stretch * d, delta)
        moved = args.further(y, taken) if known else jax.tree.map(jnp.add, y, taken)
        largest = _largest(moved)
        size = longest / (self.atol + self.rtol * largest)
        ratio = jnp.where(
            previous > 0,
            jnp.minimum(1.0, size / jnp.where(previous > 0, previous, 1.0)),
            1.0,
        )
        # a first step tells nothing of how they fall
        rounding = (previous > 0) & (ratio >= 1)
        predicted = size * jnp.where(
            rounding, jnp.minimum(1.0, self.atol / ROUNDING), ratio
        )
        return moved, (predicted, size, *steady), None

    def terminate(self, fn, y, args, options, state, tags):
        return state[0] < 1, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


SLOW, SLOWEST, STEADY = 0.3, 0.97, 0.05
"""The part of a correction that the next one keeps: from where, and up to where, steps
are stretched, and how much it may change from one to the next."""


def _stretch(
    along: Scalar, last: Scalar, before: Scalar
) -> tuple[Scalar, tuple[Scalar, Scalar]]:
    """By what a step is longer than its correction, which has the component `along`
    some direction; `last`: that of the last correction, and `before` the part of it
    that was kept. And these two for the next step: nothing was kept after a longer
    one."""
    kept = along / jnp.where(last != 0, last, jnp.inf)
    steady = jnp.abs(kept - before) < STEADY
    stretched = steady & (kept > SLOW) & (kept < SLOWEST)
    whole = jnp.where(stretched, kept, 0.0)
    return 1 / (1 - whole), (along, jnp.where(stretched, 0.0, kept))


def _sum(tree: PyTree) -> Scalar:
    """The sum of the leaves, numbers or arrays: a component along a direction at right
    angles to few others."""
    return jax.tree.reduce(jnp.add, jax.tree.map(jnp.sum, tree))


def _correction(fn: Callable, y: PyTree, args: PyTree) -> PyTree:
    """What Gauss-Newton subtracts from the parameters of any residual function."""
    leaves, structure = jax.tree.flatten(y)
    if any(jnp.ndim(leaf) for leaf in leaves):
        flat, unravel = ravel_pytree(y)
        residual = lambda flat: ravel_pytree(fn(unravel(flat), args)[0])[0]
        jacobian = jax.jacfwd(residual)(flat)
        return unravel(
            symmetric.inverse(jacobian.T @ jacobian).matrix
            @ (jacobian.T @ residual(flat))
        )
    residual = lambda *x: ravel_pytree(fn(jax.tree.unflatten(structure, x), args)[0])[0]
    return jax.tree.unflatten(structure, correction(columns(residual, leaves)))


def _largest(tree: PyTree) -> Scalar:
    """The largest absolute value of the leaves, numbers or arrays."""
    leaves = [
        jnp.abs(a) if jnp.ndim(a) == 0 else jnp.max(jnp.abs(a))
        for a in jax.tree.leaves(tree)
    ]
    largest = leaves[0] * 0
    for leaf in leaves:
        largest = jnp.maximum(largest, leaf)
    return largest


class SmallCholesky(lx.AbstractLinearSolver):
    """The solution of the positive definite system of implicit differentiation, as a
    lineax solver."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        return operator.as_matrix()

    def compute(self, state, vector, options):
        flat, unravel = ravel_pytree(vector)
        p = flat.shape[0]
        if p > UNROLLED:
            x = symmetric.inverse((state + state.T) / 2).matrix @ flat
        else:
            lower = [
                [(state[i, j] + state[j, i]) / 2 for j in range(i + 1)]
                for i in range(p)
            ]
            x = jnp.stack(solve(lower, [flat[i] for i in range(p)]))
        # lineax would stop the whole batch for one pair without a derivative
        return unravel(jnp.where(jnp.isfinite(x), x, 0.0)), lx.RESULTS.successful, {}

    def transpose(self, state, options):
        return state, options

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True


def minimise(
    residuals: Any,
    origin: PyTree,
    solver: optx.AbstractLeastSquaresSolver | None,
    max_steps: int,
) -> Any:
    """The optimistix solution for `residuals.Residuals` or `joint.Joint`,
    differentiable by all that these hold."""
    return optx.least_squares(
        lambda x, residuals: residuals(x),
        GaussNewton() if solver is None else solver,
        origin,
        args=residuals,
        max_steps=max_steps,
        adjoint=optx.ImplicitAdjoint(linear_solver=SmallCholesky()),
        throw=False,
    )


def steps(
    residuals: Any, x: tuple[Scalar, ...], count: int, max_step: ScalarLike
) -> tuple[Scalar, ...]:
    """A fixed number of Gauss-Newton steps on `residuals.Residuals`, for starts that
    need no convergence test."""
    solver = GaussNewton(max_step=max_step)

    def body(_, x):
        zero = jnp.zeros_like(x[0])
        return solver.step(
            lambda x, residuals: (residuals(x), None),
            x,
            residuals,
            {},
            (x[0], x[0], zero, zero),
            frozenset(),
        )[0]

    return kernel_part(
        lambda x: body(0, x) if count == 1 else lax.fori_loop(0, count, body, x)
    )(x)
