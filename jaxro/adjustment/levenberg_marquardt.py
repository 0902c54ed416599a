"""Levenberg-Marquardt with scaled damping, for adjustments that plain Gauss-Newton does
not bring to rest.

    (N + λ diag N) dx = h,    N = JᵀJ,  h = Jᵀr

A step that does not reduce the sum of squares is not taken, and λ grows (Marquardt
1963). Near the minimum λ has fallen to nothing, and the steps are those of
Gauss-Newton.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree, ScalarLike

from ..xla.programs import compiled, is_traced
from . import symmetric

Scalar = Float[Array, ""]

INVISIBLE = 1e-10
"""Part of the sum of squares that a step may promise and rounding may hide: such a step
is taken without asking whether it reduced the sum."""

MARGIN = 1e-8
"""Part of the sum of squares by which an invisible step may seem to raise it."""


class DampedStep(NamedTuple):
    """What is subtracted from the parameters; the reduction of the sum of squares that
    the linear model promises (`gain`); and hᵀ dx (`decrement`), which is the squared
    length of the step in standard deviations when λ is small."""

    step: PyTree
    gain: Scalar
    decrement: Scalar


class State(eqx.Module):
    """Where the search stands: the sum of squares, λ, the factor by which λ grows next,
    the last decrement, and whether the end is reached."""

    squares: Scalar
    damping: Scalar
    growth: Scalar
    decrement: Scalar
    done: Bool[Array, ""]


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt; any residual may be infinite where the parameters make no
    sense (a point behind the camera), and such a step is not taken.

    Ends when a step is shorter than `rtol` standard deviations (of one residual, a
    posteriori), or when steps that are rounding errors no longer fall. `damping` is the
    first λ. `args` that know their damped steps (`residuals.Residuals`, `joint.Joint`)
    are asked for them; any other residual function is linearised.
    """

    rtol: ScalarLike = 1e-10
    atol: ScalarLike = 1e-14
    damping: ScalarLike = 1e-3
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        squares = _at_once(_squares, fn(y, args)[0])
        return _at_once(_begin, squares, damping=self.damping)

    def step(self, fn, y, args, options, state, tags):
        known = hasattr(args, "damped")
        found = (
            args.damped(y, state.damping)
            if known
            else _damped(fn, y, args, state.damping)
        )
        back = _at_once(_negative, found.step)
        moved = args.further(y, back) if known else jax.tree.map(jnp.add, y, back)
        squares = _at_once(_squares, fn(moved, args)[0])
        data = state, found, y, moved, squares
        lengths = {"rtol": self.rtol, "atol": self.atol}
        return *_at_once(_decide, data, **lengths), None

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def _at_once(function: Callable, data: PyTree, **options: ScalarLike) -> Any:
    """The function as one program, where the host works between the steps; else as part
    of the caller's."""
    if is_traced(data):
        return function(data, **options)
    return compiled(function)(data, **options)


def _negative(step: PyTree) -> PyTree:
    return jax.tree.map(jnp.negative, step)


def _begin(squares: Scalar, damping: ScalarLike) -> State:
    """The state before the first step."""
    one = jnp.ones_like(squares)
    return State(
        squares=squares,
        damping=jnp.multiply(damping, one),
        growth=2 * one,
        decrement=jnp.inf * one,
        done=jnp.zeros((), bool),
    )


def _decide(
    data: tuple[State, DampedStep, PyTree, PyTree, Scalar],
    rtol: ScalarLike,
    atol: ScalarLike,
) -> tuple[PyTree, State]:
    """Where the search goes on, and how: from the state, the step that is proposed, the
    parameters `y` before and `moved` by it, and the sum of squares there."""
    state, found, y, moved, squares = data
    invisible = found.gain <= INVISIBLE * state.squares
    allowed = jnp.where(invisible, (1 + MARGIN) * state.squares, state.squares)
    taken = squares <= allowed
    ratio = (state.squares - squares) / jnp.maximum(
        found.gain, jnp.finfo(squares.dtype).tiny
    )
    good = invisible | (ratio > 0.5)
    damping = jnp.where(
        taken,
        jnp.where(good, state.damping / 10, state.damping),
        state.damping * state.growth,
    )
    short = found.decrement <= rtol**2 * state.squares + atol**2
    resting = invisible & (found.decrement > state.decrement / 4)
    hopeless = ~taken & invisible
    choose = lambda a, b: jnp.where(taken, a, b)
    further = State(
        squares=choose(squares, state.squares),
        damping=damping,
        growth=jnp.where(taken, 2.0, 2 * state.growth),
        decrement=found.decrement,
        done=(taken & (short | resting)) | hopeless,
    )
    return jax.tree.map(choose, moved, y), further


def promised(step: PyTree, decrement: Scalar, damping: Scalar, spread: Scalar):
    """The `DampedStep` of a step, from hᵀ dx and dxᵀ diag(N) dx: the linear model
    promises hᵀ dx + λ dxᵀ diag(N) dx."""
    return DampedStep(step, decrement + damping * spread, decrement)


def _damped(fn: Callable, y: PyTree, args: Any, damping: Scalar) -> DampedStep:
    """The damped step of any residual function."""
    flat, unravel = ravel_pytree(y)
    residual = lambda flat: ravel_pytree(fn(unravel(flat), args)[0])[0]
    jacobian, r = jax.jacfwd(residual)(flat), residual(flat)
    n, h = jacobian.T @ jacobian, jacobian.T @ r
    diagonal = jnp.diagonal(n)
    step = symmetric.inverse(n + jnp.diag(damping * diagonal)).matrix @ h
    spread = jnp.sum(diagonal * step**2)
    return promised(unravel(step), jnp.sum(h * step), damping, spread)


def _squares(residuals: PyTree) -> Scalar:
    """The sum of the squares of all residuals."""
    return sum(jnp.sum(r**2) for r in jax.tree.leaves(residuals))  # pyright: ignore[reportReturnType]
