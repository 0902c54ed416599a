"""The absolute orientation of one model: the seven parameters that place it on the
ground, from control in plan, in height or in both.

    s R (x + v_x) + T = X + v_X,    Σ vᵀ C⁻¹ v = min

over the errors of the ground coordinates and, where it has any, those of the model. The
model of an oriented pair with its full covariance gives what the bundles of its two
photos give.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import results
from ..adjustment.guarded import ratio, root, times
from ..geometry import rotations as rot
from ..xla.programs import compiled, is_traced
from ..xla.settings import MOMENT, settings_for
from .absolute_model import MeasuredModel, Units, units_of
from .absolute_problem import linearise, solve, sum_squares
from .absolute_result import AbsoluteOrientation, values_of
from .absolute_starts import is_apart, search
from .absolute_verdict import EXACT, RESULTS, Evidence, missing, moments_of, verdict
from .similarity import Similarity

LEAST_ROOM = 16
"""Points for which programs are compiled at least; further ones double it, so that
models of different lengths share their programs."""

PER_POINT = (
    *("points", "point_cofactors", "residuals", "redundancy", "ratios", "known"),
    *("slopes", "own"),
)
"""What an `AbsoluteOrientation` holds of every point."""

UNTESTABLE = 1e-6
"""Redundancy below which a coordinate counts as not checked by the others."""


def orient_model(measured: MeasuredModel) -> AbsoluteOrientation:
    """Place a model on the ground: least squares by the control that it has.

    No approximate values are needed. Failures are values of `result`, never exceptions.
    Works under jit, vmap (`MeasuredModel` with one more axis) and grad.
    """
    return _solution(_orient(measured), 0)


def solutions(measured: MeasuredModel) -> list[AbsoluteOrientation]:
    """What `orient_model` finds and, with the result `two_solutions`, the other
    solution."""
    both = _orient(measured)
    first, second = _solution(both, 0), _solution(both, 1)
    return [first, second] if bool(first.result == RESULTS.two_solutions) else [first]


def _orient(measured: MeasuredModel) -> AbsoluteOrientation:
    """The best solution and the next one, on the first axis of each array."""
    if is_traced(measured):
        return _fit_and_describe(measured)
    controlled = np.flatnonzero(np.any(np.asarray(measured.known), axis=1))
    control, whole = _with_room(measured.rows(controlled)), _with_room(measured)
    both = describe(whole, fit(control))
    shown = lambda a: jnp.asarray(np.asarray(a)[:, : len(measured.points)])
    of_points = lambda o: [getattr(o, name) for name in PER_POINT]
    return eqx.tree_at(of_points, both, replace_fn=shown)


@compiled
def _fit_and_describe(measured: MeasuredModel) -> AbsoluteOrientation:
    return describe(measured, fit(measured))


def _with_room(measured: MeasuredModel) -> MeasuredModel:
    room = LEAST_ROOM
    while room < len(measured.points):
        room *= 2
    return measured.pad(room)


def _solution(both: AbsoluteOrientation, k: int) -> AbsoluteOrientation:
    # by NumPy, which compiles nothing, where it can
    take = lambda a: a[k] if is_traced(a) else jnp.asarray(np.asarray(a)[k])
    return jax.tree.map(take, both)


# -------------------------------------------------------------------------------------
# the solution


class Solved(NamedTuple):
    """One solution in the units of the adjustment.

    The cofactors are those of the local parameters of the similarity and of the errors
    in common; `about_mean`: the sum of squares of the control itself about its middle;
    `exact`: whether some control has no error at all.
    """

    similarity: Similarity
    common: Float[Array, "*solution common"]
    cofactor: Float[Array, "*solution p p"]
    squares: Float[Array, "*solution"]
    about_mean: Float[Array, "*solution"]
    exact: Bool[Array, "*solution"]
    ended: results.RESULTS


class Fit(NamedTuple):
    """Two solutions, the better one first, and what is said of them. `sigma0` is that
    of the given standard deviations."""

    units: Units
    solved: Solved
    sigma0: Float[Array, " solution"]
    degrees_of_freedom: Int[Array, ""]
    missing: Bool[Array, "5"]
    result: RESULTS


def _by_size(measured: MeasuredModel, *_: Any) -> dict[str, Any]:
    return settings_for(len(measured.points), MOMENT)


@compiled(settings=_by_size)
def fit(measured: MeasuredModel) -> Fit:
    """Adjust a model to its control, from the two best starts."""
    units = units_of(measured)
    within = measured.within(units)
    found = search(jax.lax.stop_gradient(within))
    both = jax.lax.map(partial(_solve_from, within), found.starts)
    apart = is_apart(*both.similarity.quaternion)
    order = jnp.where(apart & _is_second_better(both), jnp.array([1, 0]), jnp.arange(2))
    both = jax.tree.map(lambda a: a[order], both)
    coordinates = jnp.sum(within.known)
    freedom = coordinates - 7
    checked = freedom > 0
    divisor = jnp.where(checked, freedom, 1).astype(both.squares.dtype)
    sigma0 = jnp.where(checked, root(both.squares / divisor), jnp.nan)
    moments = moments_of(within.points, within.known)
    is_open = missing(within.known)

    def conclude(one: Solved, other: Float[Array, ""], sigma0: Float[Array, ""]):
        variances = jnp.diagonal(one.cofactor)[:7]
        return verdict(
            Evidence(
                coordinates=coordinates,
                missing=is_open,
                deviations=times(root(variances), sigma0),
                squares=one.squares,
                other=other,
                mirrored=found.mirrored,
                about_mean=one.about_mean,
                apart=apart,
                moments=moments,
                exact=one.exact,
                ended=one.ended,
            )
        )

    result = jax.vmap(conclude)(both, both.squares[::-1], sigma0)
    return Fit(
        units=units,
        solved=both,
        sigma0=sigma0 / units.sigma,
        degrees_of_freedom=freedom,
        missing=is_open,
        result=result,
    )


def _solve_from(within: MeasuredModel, start: Similarity) -> Solved:
    found = solve(within, start)
    similarity = jax.tree.map(lambda a: a[0], found.parameters["model"])
    errors = found.parameters.get("common")
    common = jnp.zeros(0) if errors is None else errors[0]
    linear = jax.vmap(lambda one: linearise(similarity, common, one))(within)
    ground = within.ground
    spread = jnp.diagonal(linear.own, axis1=1, axis2=2) + within.variance
    return Solved(
        similarity=similarity,
        common=common,
        cofactor=found.cofactor,
        squares=sum_squares(found),
        about_mean=jnp.einsum("ni,nij,nj->", ground, linear.weights, ground),
        exact=jnp.any(within.known & (spread <= 0)),
        ended=found.result,
    )


def _is_second_better(both: Solved) -> Bool[Array, ""]:
    """Whether the second of two solutions fits better or, where both fit exactly, has
    the z axis of the model further up."""
    exact = jnp.max(both.squares) <= EXACT * jnp.max(both.about_mean)
    up = jax.vmap(lambda similarity: similarity.rotation[2][2])(both.similarity)
    return jnp.where(exact, up[1] > up[0], both.squares[1] < both.squares[0])


# -------------------------------------------------------------------------------------
# what is read from it


@compiled(settings=_by_size)
def describe(measured: MeasuredModel, found: Fit) -> AbsoluteOrientation:
    """Elements and all points of a model by both solutions."""
    within, (frame, sigma) = measured.within(found.units), found.units

    def one(solved: Solved, sigma0: Array, result: RESULTS) -> AbsoluteOrientation:
        similarity = frame.without(solved.similarity)
        read = jax.vmap(partial(_read_point, solved))(within)
        by_step = jax.jacfwd(
            lambda step: values_of(frame.without(solved.similarity.move(step)))
        )(jnp.zeros(7))
        size, whole = frame.ground_size, frame.ground_size * sigma
        return AbsoluteOrientation(
            frame=frame,
            within=solved.similarity,
            values=values_of(similarity),
            rotation=rot.as_array(similarity.rotation),
            cofactor=by_step @ solved.cofactor[:7, :7] @ by_step.T * sigma**2,
            points=read.place * size + frame.ground_centre[None],
            point_cofactors=read.cofactor * whole**2,
            residuals=read.residual * size,
            redundancy=read.redundancy,
            ratios=read.ratio / sigma,
            known=measured.known,
            slopes=read.slopes * size,
            own=read.own * whole**2,
            cofactors=solved.cofactor * sigma**2,
            sigma0=sigma0,
            degrees_of_freedom=found.degrees_of_freedom,
            missing=found.missing,
            result=result,
        )

    return jax.vmap(one)(found.solved, found.sigma0, found.result)


class Read(NamedTuple):
    """What is read of one point: its adjusted place with its cofactors, the derivatives
    of this by all unknowns and the cofactors by errors of its own; and of each ground
    coordinate residual, redundancy and residual over its deviation."""

    place: Float[Array, "*point 3"]
    cofactor: Float[Array, "*point 3 3"]
    slopes: Float[Array, "*point 3 p"]
    own: Float[Array, "*point 3 3"]
    residual: Float[Array, "*point 3"]
    redundancy: Float[Array, "*point 3"]
    ratio: Float[Array, "*point 3"]


def _read_point(solved: Solved, one: MeasuredModel) -> Read:
    """The own errors of a point take the part K = E P of its misclosure, E their
    covariance on the ground and P the weights of the misclosure:

        x = f + K g,    Q_x = (1 - K) J Q Jᵀ (1 - K)ᵀ + E - K E
    """
    linear = linearise(solved.similarity, solved.common, one)
    p, g = linear.weights, linear.misclosure
    gain = linear.own @ p
    slopes = linear.slopes - gain @ linear.slopes
    own = linear.own - gain @ linear.own
    by_unknowns = p @ linear.slopes
    checked = p - by_unknowns @ solved.cofactor @ by_unknowns.T
    weight, left = jnp.diagonal(p), jnp.diagonal(checked)
    part = ratio(left, weight, weight > 0)
    testable = part > UNTESTABLE
    return Read(
        place=linear.place + gain @ g,
        cofactor=slopes @ solved.cofactor @ slopes.T + own,
        slopes=slopes,
        own=own,
        residual=-g,
        redundancy=jnp.clip(part, 0.0, 1.0),
        ratio=-ratio(p @ g, root(left, testable), testable),
    )
