"""Relative orientation of one measured stereo pair: the one call of the README."""

from collections.abc import Callable
from inspect import signature
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import critical_values, results
from ..adjustment.guarded import root, times
from ..adjustment.least_squares import adjust
from ..adjustment.losses import AbstractLoss
from ..adjustment.normal_equations import GaussNewton
from ..geometry import coplanarity
from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    RelativePose,
    to_pose,
)
from ..geometry.intersection import model_point
from ..geometry.pairs import Coordinates, Pair, cleaned, double
from ..xla.pointwise import pointwise
from ..xla.programs import FAST, QUICK, QUICKEST, Program, loops, traced, whole
from ..xla.reductions import sums
from . import chosen_elements, degeneracy, planes, starts
from .inspection import Inspection, inspect
from .results import RESULTS, is_usable, of_adjustment

WEAK = 0.04
"""Standard deviation (rad) of a local parameter above which the linearised statistics
no longer mean anything."""


class Orientation(eqx.Module):
    """The relative orientation of a pair; for a batch every field has leading axes.

    Per point (zero or False where masked): `parallax` the strict y-parallax q = y1* -
    y2* of the photos turned parallel to the base; `residuals` the whitened residuals
    that were minimised; `redundancy` numbers, which add up to the degrees of freedom;
    `model` (X, Y, Z) in the frame and scale of the elements; `in_front` of both photos.

    `m_q` = sqrt([qq]/(n-5)), `sigma0` = sqrt(Σ r²/(n-5)): the standard deviation of a
    coordinate in its own unit when no sigma was given, else its ratio to the given
    sigma. Both NaN without redundancy. `cofactor`: of the five elements in the order of
    `elements.names`; rad, and the unit of the base.
    """

    pose: RelativePose
    elements: AbstractElements
    cofactor: Float[Array, "*pairs 5 5"]
    parallax: Float[Array, "*pairs point"]
    residuals: Float[Array, "*pairs point"]
    redundancy: Float[Array, "*pairs point"]
    model: tuple[
        Float[Array, "*pairs point"],
        Float[Array, "*pairs point"],
        Float[Array, "*pairs point"],
    ]
    in_front: Bool[Array, "*pairs point"]
    m_q: Float[Array, "*pairs"]
    sigma0: Float[Array, "*pairs"]
    degrees_of_freedom: Int[Array, "*pairs"]
    iterations: Int[Array, "*pairs"]
    result: RESULTS

    @property
    def covariance(self) -> Float[Array, "*pairs 5 5"]:
        """sigma0² times the cofactors (a posteriori)."""
        return times(self.cofactor, self.sigma0[..., None, None] ** 2)

    @property
    def deviations(self) -> Float[Array, "*pairs 5"]:
        """Standard deviations of the elements."""
        return times(
            root(jnp.diagonal(self.cofactor, axis1=-2, axis2=-1)),
            self.sigma0[..., None],
        )

    @property
    def correlation(self) -> Float[Array | np.ndarray, "*pairs 5 5"]:
        """Correlations of the elements."""
        roots = self.cofactor.diagonal(axis1=-2, axis2=-1) ** 0.5
        return self.cofactor / (roots[..., :, None] * roots[..., None, :])

    @property
    def usable(self) -> Bool[Array, "*pairs"]:
        """Whether the elements may be used; `result` says why not, or what to mind."""
        return is_usable(self.result)

    def interval(
        self, confidence: float = 0.95, *, sigma0: ArrayLike | None = None
    ) -> Float[Array, "*pairs 5"]:
        """Half widths of the intervals that hold each element with this probability.

        A posteriori: Student's t of n - 5 degrees of freedom times `deviations`;
        infinite or NaN without any. With the `sigma0` known before the measurement (1
        where the sigmas given are standard deviations): the normal quantile times
        sigma0 sqrt(Q), which exists for five points, too.
        """
        if sigma0 is not None:
            quantile = critical_values.normal(1 - confidence)
            roots = root(jnp.diagonal(self.cofactor, axis1=-2, axis2=-1))
            return times(
                roots, jnp.broadcast_to(sigma0 * quantile, self.sigma0.shape)[..., None]
            )
        return times(
            self.deviations,
            self._quantile(lambda f: critical_values.half_width(confidence, f))[
                ..., None
            ],
        )

    def radius(
        self, confidence: float = 0.95, *, sigma0: ArrayLike | None = None
    ) -> Float[Array, "*pairs"]:
        """Of the joint region that holds the five elements with this probability: d of
        them from the adjusted ones, d' C⁻¹ d <= radius², C the covariance a posteriori
        or, with a known sigma0, sigma0² Q.

        sqrt(5 F) of 5 and n - 5 degrees of freedom, or the root of the chi-squared
        quantile of 5.
        """
        if sigma0 is not None:
            known = jnp.sqrt(critical_values.chi_squared(1 - confidence, 5))
            return jnp.broadcast_to(known, self.sigma0.shape)
        return self._quantile(lambda f: critical_values.radius(confidence, 5, f))

    def _quantile(self, of: Callable[[Array], Array]) -> Float[Array, "*pairs"]:
        """A quantile by the degrees of freedom of every pair."""
        most = max(self.residuals.shape[-1] - 5, 0)
        table = lambda freedom: critical_values.by_count(of, most, freedom)
        return jnp.vectorize(table)(
            jnp.asarray(self.degrees_of_freedom, self.sigma0.dtype)
        )

    def corrections(self, pair: Pair) -> Coordinates:
        """The corrections v of (x_left, y_left, x_right, y_right) of the oriented pair,
        zero where masked."""
        poses_and_pairs = self.pose, pair
        if traced(poses_and_pairs):
            return _corrections_of(poses_and_pairs)
        return Program(_corrections_of, {}, FAST if jnp.ndim(self.sigma0) else QUICK)(
            poses_and_pairs
        )

    def check(self) -> "Orientation":
        """This orientation; raises RuntimeError with advice if any of it is not
        usable."""
        if not bool(jnp.all(self.usable)):
            if jnp.ndim(self.usable) == 0:
                raise RuntimeError(RESULTS[self.result])
            raise RuntimeError(
                f"{int(jnp.sum(~self.usable))} of {self.usable.size} pairs are not "
                "oriented; see result"
            )
        return self


def orient(
    pair: Pair,
    *,
    elements: type[AbstractElements] = RelativePose,
    base: ArrayLike | None = None,
    residual: Callable[[Pair], coplanarity.Adjusted] = coplanarity.rigorous,
    loss: AbstractLoss | None = None,
    start: starts.AbstractStart | AbstractElements = starts.Auto(),  # noqa: B008 (frozen)
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int | None = None,
) -> Orientation:
    """Orient the right photo of a pair to the left one by least squares (or a robust
    loss).

    `elements`: the system of the result. `base`: bx of `DependentElements` (its sign
    says on which side the right photo lies), b of `IndependentElements`; if not given
    bx of a known start, or the mean x-parallax. `RelativePose` has a unit base whatever
    is given. `residual`: `coplanarity.rigorous` or `coplanarity.parallax`. `start`: an
    object of `starts`, or known elements, which are then also the parameters that are
    iterated. `max_steps`: 30 if not given, 300 with a loss, whose reweighted steps
    converge linearly. Works under jit, vmap and grad; failures are values of `result`.
    """
    if pair.x_left.ndim != 1:
        raise ValueError(
            "orient takes one pair, but the coordinates have shape "
            f"{pair.x_left.shape}: "
            "use jax.vmap(orient), or orient_batch"
        )
    pair = double(pair)
    base = None if base is None else jnp.asarray(base, float)
    max_steps = _most(max_steps, loss)
    options = dict(
        elements=elements,
        base=base,
        residual=residual,
        loss=loss,
        solver=solver,
        max_steps=max_steps,
    )
    if traced((pair, base, start)):
        return _orient(pair, start=start, **options)
    settings = QUICKEST if pair.x_left.size <= FEW else QUICK

    def run(function: Callable, start: Any, kernel: Callable) -> Any:
        small = (
            kernel if solver is None and pair.x_left.size else None
        )  # the compiler does not survive no points
        return Program(function, options | {"start": start}, settings, kernel=small)(
            pair
        )

    if not isinstance(start, starts.Auto):
        return run(_orient, start, loops)
    # two small programs instead of one large: the general start is compiled when a pair
    # first needs it
    orientation, fits = run(orient_near, start, whole)
    return orientation if bool(fits) else run(_orient, start.general, loops)


DEFAULTS = {
    name: option.default
    for name, option in signature(orient).parameters.items()
    if option.kind is option.KEYWORD_ONLY
}
"""What `orient` takes for the options it is not given."""

FEW = 32
"""Points up to which a program that compiles quickly, without a first step of its own,
outweighs a quicker one."""

NEAR_STEPS = 10
"""Steps allowed from the vertical without a loss: near-vertical photos take four or
five."""


def _most(max_steps: int | None, loss: AbstractLoss | None) -> int:
    return max_steps if max_steps is not None else 30 if loss is None else 300


def orient_near(
    pair: Pair,
    *,
    start: starts.Auto,
    loss: AbstractLoss | None = None,
    max_steps: int | None = None,
    **options,
) -> tuple[Orientation, Array]:
    """The first part of an `Auto` start as an orientation of its own: from the
    vertical, and whether that fits."""
    max_steps = _most(max_steps, loss)
    most = min(max_steps, NEAR_STEPS) if loss is None else max_steps
    first_order = loss is None and pair.x_left.shape[0] > FEW
    options = (
        DEFAULTS
        | options
        | dict(start=starts.Vertical(steps=int(first_order)), loss=loss, max_steps=most)
    )
    near, inspected = _inspected(pair, **options)
    # asks for the count, not for the result, which would cost the statistics where only
    # the pose is wanted
    return near, start.fits(near.pose, inspected) & (
        (near.iterations < most) | (most == max_steps)
    )


def _orient(pair: Pair, **options) -> Orientation:
    return _inspected(pair, **options)[0]


def _inspected(
    pair: Pair, *, elements, base, residual, loss, start, solver, max_steps
) -> tuple[Orientation, Inspection]:
    """The orientation, and what its pose looks like from the points."""
    pair, bad_input = cleaned(pair)
    if isinstance(start, AbstractElements):
        known = jax.tree.map(
            lambda element: jnp.asarray(element, pair.x_left.dtype), start
        )
        begin = starts.Begin(known, jnp.asarray(False), jnp.asarray(False))
        if (
            base is None
            and elements is DependentElements
            and isinstance(known, DependentElements)
        ):
            base = lax.stop_gradient(known.bx)  # a choice of scale, not a measurement
    else:
        begin = start(
            lax.stop_gradient(pair)
        )  # the optimum does not depend on where it is sought
    prepare, condition, observations, cofactor = residual(pair)
    # rounding decides where the general start ends, in a batch elsewhere than alone:
    # the solution has to forget it. An `Auto` comes here under a caller's jit, for whom
    # a tenth of the time is worth more than a step below 1e-10.
    tolerance = {starts.General: 1e-14, starts.Auto: 1e-10}.get(type(start), 1e-12)
    own = GaussNewton(tolerance, tolerance, max_step=0.5)
    adjustment = adjust(
        condition,
        begin.pose,
        observations,
        cofactor,
        pair.mask,
        prepare=prepare,
        loss=loss,
        solver=own if solver is None else solver,
        max_steps=max_steps,
    )
    solved = adjustment.parameters
    pose = to_pose(solved)
    inspected = inspect(pair, pose)
    pose, flipped = chosen_elements.facing(
        pose, inspected, isinstance(solved, RelativePose)
    )
    length = chosen_elements.length(pair, elements, base, pose)
    chosen, q = chosen_elements.chosen(
        solved, adjustment.cofactor, flipped, elements, length
    )

    unit = pose.bx, pose.by, pose.bz
    freedom = adjustment.degrees_of_freedom
    checked, free = freedom > 0, freedom.astype(adjustment.sigma0.dtype)
    estimated = jnp.where(checked, adjustment.sigma0, 0.0)
    noise = degeneracy.noise(estimated, free, inspected.sigma, pair.focal_left)

    q_of = coplanarity.parallax_of(pair, pose)
    meet = model_point(pair, pose, chosen, elements.scale(unit, length), noise.size)
    of_point = lambda point, sigma, use: (
        jnp.where(use, q_of(point), 0.0),
        *meet(point, sigma, use),
    )
    parallax, model, in_front, behind = pointwise(
        of_point, pair.coordinates, pair.sigma, pair.mask
    )

    qq, behind = sums((parallax**2, (behind & ~pair.coarse).astype(parallax.dtype)))
    m_q = jnp.where(
        checked,
        root(qq / jnp.where(checked, freedom, 1).astype(parallax.dtype)),
        jnp.nan,
    )

    fair = adjustment.result == results.RESULTS.successful
    result = of_adjustment(adjustment.result)
    worst, worst_chosen = (
        jnp.max(jnp.diagonal(degeneracy.in_radians(of, cofactor)[0]))
        for of, cofactor in ((solved, adjustment.cofactor), (chosen, q))
    )
    direction = degeneracy.worst_direction(pair, solved, adjustment.cofactor)
    second, undivided = degeneracy.folded(direction, noise)
    # what fits as well if the points lie in a plane; whether they do, Σ r² of it tells
    asked = inspected.twin & (freedom > 0) & ~begin.ambiguous & fair
    fixed_pair, fixed_pose = lax.stop_gradient((pair, pose))
    other = planes.second_squares(fixed_pair, fixed_pose, asked)
    rounding = (
        planes.ROUNDING
        * pair.count
        * (pair.focal_left / jnp.where(inspected.sigma > 0, inspected.sigma, 1.0)) ** 2
    )
    second = second | (other <= noise.tolerated(free * estimated**2) + rounding)
    for condition_holds, code in (
        (freedom == 0, RESULTS.no_redundancy),
        (begin.ambiguous | second, RESULTS.two_solutions),
        (behind > 0, RESULTS.points_behind_camera),
        (chosen_elements.wrong_side(elements, base, pose), RESULTS.photos_swapped),
        (
            ~elements.exist(unit, length)
            | (noise.size**2 * worst_chosen > WEAK**2)
            | (
                degeneracy.ROUNDING**2 * worst_chosen > worst
            ),  # without redundancy there is no noise to judge by
            RESULTS.elements_undefined,
        ),
        (
            (noise.size**2 * worst > WEAK**2)
            | (direction.margin < noise.least_margin)
            | undivided,
            RESULTS.weakly_determined,
        ),
    ):
        result = RESULTS.where(fair & condition_holds, code, result)
    rotated = degeneracy.pure_rotation(inspected, free, estimated) | begin.pure_rotation
    result = RESULTS.where(rotated, RESULTS.zero_base, result)
    result = RESULTS.where(freedom < 0, RESULTS.too_few_points, result)
    result = RESULTS.where(bad_input, RESULTS.non_finite_input, result)
    return Orientation(
        pose,
        chosen,
        q,
        parallax,
        adjustment.residuals,
        adjustment.redundancy,
        model,
        in_front,
        m_q,
        adjustment.sigma0,
        jnp.maximum(freedom, 0),
        adjustment.iterations,
        result,
    ), inspected


def _corrections_of(poses_and_pairs: tuple[RelativePose, Pair]) -> Coordinates:
    if poses_and_pairs[0].qw.ndim:
        return jax.vmap(_corrections_of)(poses_and_pairs)
    pose, pair = poses_and_pairs
    pair, _ = cleaned(pair)
    f = coplanarity.fundamental_matrix(
        *pose.relative(), pair.focal_left, pair.focal_right
    )
    return jax.vmap(lambda point, use: coplanarity.corrections(f, point, use))(
        pair.coordinates, pair.mask
    )
