"""What a finished orientation tells of errors in its measurements: which errors the
tests would find, and what those that stay hidden would do.

Of the Gauss-Helmert model A x + B v + g = 0 with one condition per point, D = B Q Bᵀ
its variance for sigma0 = 1, h = a N⁻¹ aᵀ / D its leverage (Baarda 1968; Pope 1976;
Förstner 1979, 1987; Caspary 1988):

    redundancy number         r = 1 - h                                    Σ r = n - 5
    Baarda's w                g / (sigma0 sqrt(D r))                       normal
    internally studentised    tau: the estimated sigma0 in its place       tau distribution of n - 5
    externally studentised    t: sigma0 estimated without this point       Student's t of n - 6
    of a coordinate           r_k = r B_k (Q Bᵀ)_k / D, r B_k² Q_k / D without covariances
    detectable error          delta0 sigma0 sqrt(Q_k / r_k) = delta0 sigma0 sqrt(D / r) / |B_k|
    effect on the elements    N⁻¹ aᵀ / D times the error of g, delta0 sigma0 sqrt(D / r)
    external reliability      delta0 sqrt(h / r): no function of the elements moves by more
                              of its standard deviations

The four coordinates of a point enter one condition: an error in any of them gives the
same w, and where it is just detectable the same effect on the elements. Everything is
of first order, at the measured coordinates.
"""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import critical_values as critical
from ..adjustment.critical_values import UNTESTABLE
from ..adjustment.guarded import ratio
from ..geometry.linear import Linear, Values, linearise, namespace
from ..geometry.pairs import Coordinates, Pair, mask_unusable, quickly
from ..orientation.orient import Orientation
from ..xla.kernels import computed_once
from ..xla.programs import compiled, is_traced
from .external_reliability import Effects, effects
from .internal_reliability import Checks, check, normalised_residuals, tests

PerPoint = Float[Array, "*pairs point"]
PerPair = Float[Array, "*pairs"]
PerElement = Float[Array, "*pairs 5"]

Derived = Float[Array | np.ndarray, "*pairs point"]
"""Arrays of NumPy if the fields are, as in reports, else of JAX."""

Decided = Bool[Array | np.ndarray, "*pairs point"]

CONTROL = ("not", "poorly", "sufficiently", "well")
"""How an observation is controlled, by the class of its redundancy number."""

BOUNDS = (0.01, 0.1, 0.3)
"""Redundancy numbers between the classes (Förstner 1979)."""


class Reliability(eqx.Module):
    """The reliability of an orientation; for a batch every field has leading axes.
    Masked points are zero and False.

    Per point: `used`; `redundancy`; `w`, `tau`, `t` with the sign of g; `testable`:
    whether errors in it show at all. Where not, w, tau and t are 0 and the errors that
    could hide are infinite. `effect` of the detectable error on the elements (in their
    order and unit) and `effect_m_q` on m_q; `external`, their bound in standard
    deviations. Per coordinate (x_left, y_left, x_right, y_right):
    `coordinate_redundancy`; the `detectable` error in the unit of the coordinates,
    whose standard deviation is sigma0 `sigma`; `effect_height`: how the model height Z
    of the point changes by it. Per pair: the `largest` effects on the elements, on m_q,
    and of `external`; `significance`, element over standard deviation (0 for
    `RelativePose`, whose local parameters have no values).

    `sigma0` is the a-priori standard deviation of unit weight if it is `known`, else
    the estimated one, and w is then tau. `limit`: without an error |w| exceeds it with
    probability `level`; `delta0`: the error that is found with the wanted `power`, in
    standard deviations of w. Numbers that follow from others are properties, so that a
    batch does not store them. `shown`: where the coordinates of a point are not equally
    accurate, how much of an error of a coordinate shows, r B_k² sigma² / D; else it is
    `coordinate_redundancy`. With covariances between x and y a coordinate may have a
    redundancy number below 0 or above 1; only the sum has its usual meaning.
    """

    used: Bool[Array, "*pairs point"]
    sigma: PerPoint
    w: PerPoint
    coordinate_redundancy: Coordinates
    effect: tuple[PerPoint, ...]
    effect_m_q: PerPoint
    effect_height: Coordinates
    largest: PerElement
    largest_m_q: PerPair
    significance: PerElement
    sigma0: PerPair
    estimated: PerPair
    degrees_of_freedom: Int[Array, "*pairs"]
    level: PerPair
    limit: PerPair
    delta0: PerPair
    known: bool = eqx.field(static=True)
    power: float = eqx.field(static=True)
    shown: Coordinates | None = None

    @property
    def redundancy(self) -> Derived:
        """Redundancy number of every point, the sum of those of its coordinates."""
        first, *others = self.coordinate_redundancy
        return sum(others, start=first)

    @property
    def testable(self) -> Decided:
        """The points in which an error shows."""
        able = (self.degrees_of_freedom > (0 if self.known else 1)) & (self.sigma0 > 0)
        return self.used & (self.redundancy > UNTESTABLE) & able[..., None]

    @property
    def tau(self) -> Derived:
        """w with the estimated sigma0."""
        if not self.known:
            return self.w
        xp, there = namespace(self.w), self.estimated > 0
        ratio = self.sigma0 / xp.where(there, self.estimated, 1.0)
        return self.w * xp.where(there, ratio, 0.0)[..., None]

    @property
    def t(self) -> Derived:
        """w with sigma0 estimated from the other points, tau sqrt((f - 1) / (f -
        tau²)); 0 with f = 1."""
        xp, tau = namespace(self.w), self.tau
        f = self.degrees_of_freedom[..., None].astype(self.w.dtype)
        rest = xp.maximum(f - tau**2, 1e-12)
        others = xp.where(f > 1, f - 1, 1.0)
        return xp.where(f > 1, tau * xp.sqrt(others / rest), 0.0)

    @property
    def detectable(self) -> tuple[Derived, ...]:
        """Error of each coordinate that is found with the wanted power, delta0 sigma0
        sigma / sqrt(r)."""
        xp, testable = namespace(self.w), self.testable
        size = (self.delta0 * self.sigma0)[..., None] * self.sigma

        def error(r: Derived) -> Derived:
            seen = testable & (r > UNTESTABLE)
            finite = size / xp.sqrt(xp.where(seen, r, 1.0))
            return xp.where(self.used, xp.where(seen, finite, xp.inf), 0.0)

        shown = self.coordinate_redundancy if self.shown is None else self.shown
        return tuple(error(r) for r in shown)

    @property
    def external(self) -> Derived:
        """Standard deviations by which the detectable error moves an element at most,
        delta0 sqrt((1 - r) / r)."""
        xp, testable = namespace(self.w), self.testable
        r = xp.where(testable, self.redundancy, 1.0)
        size = self.delta0[..., None] * xp.sqrt(xp.maximum(1 - r, 0.0) / r)
        return xp.where(self.used, xp.where(testable, size, xp.inf), 0.0)

    @property
    def suspicious(self) -> Decided:
        """The points whose |w| exceeds the limit. Only the largest |w| is evidence of
        an error in its own point."""
        return self.testable & (abs(self.w) > self.limit[..., None])

    @property
    def control(self) -> tuple[Int[Array, "*pairs point"], ...]:
        """Class of every coordinate, an index of `CONTROL`."""
        return tuple(controllability(r) for r in self.coordinate_redundancy)

    def p_values(self) -> PerPoint:
        """The probability of a larger |w| in a point without an error; 1 where it
        cannot be tested. By the normal distribution if sigma0 is known, else by t."""
        if not self.known:
            return self.p_student()
        return jnp.where(self.testable, 2 * ndtr(-jnp.abs(self.w)), 1.0)

    def p_student(self) -> PerPoint:
        """The probability of a larger |t|, which needs no sigma0 and two degrees of
        freedom; 1 with fewer."""
        freedom = (self._freedom - 1)[..., None]
        p = critical.student_p(self.t, freedom)
        return jnp.where(self.testable & (freedom > 0), p, 1.0)

    def global_p(self) -> PerPair:
        """The probability of the two-sided chi-squared test of the estimated sigma0
        against the known one; 1 without a test: no degree of freedom, or sigma0 not
        known."""
        there = self.known & (self.degrees_of_freedom > 0)
        f = jnp.where(there, self._freedom, 1.0)
        ratio = jnp.where(there, self.estimated / self.sigma0, 1.0)
        return jnp.where(there, critical.global_p(f * ratio**2, f), 1.0)

    def b_level(self) -> PerPair:
        """The level at which the one-sided global test has the power of the tests of
        points (Baarda's B-method)."""
        freedom = jnp.where(self._freedom > 0, self._freedom, 1.0)
        return jnp.asarray(critical.b_method(self.level, self.power, freedom))

    def significance_p(self) -> PerElement:
        """The probability that an element whose true value is zero appears as large as
        this one; 1 where nothing can be said."""
        size = jnp.abs(self.significance)
        if self.known:
            p = 2 * ndtr(-size)
        else:
            f = jnp.where(self._freedom > 0, self._freedom, 1.0)[..., None]
            p = critical.student_p(size, f)
        return jnp.where(size > 0, p, 1.0)

    @property
    def _freedom(self) -> PerPair:
        dtype = jnp.asarray(self.estimated).dtype  # reports hold arrays of NumPy
        return jnp.asarray(self.degrees_of_freedom).astype(dtype)


def controllability(redundancy: ArrayLike) -> Int[Array, "..."]:
    """0 to 3 (see `CONTROL`): below 0.01, below 0.1, below 0.3, above."""
    return sum(jnp.where(jnp.asarray(redundancy) < bound, 0, 1) for bound in BOUNDS)  # pyright: ignore


def assess(
    pair: Pair,
    orientation: Orientation,
    *,
    sigma0: ArrayLike | None = None,
    sigma: float | None = None,
    level: float = 0.001,
    power: float = 0.80,
    familywise: bool = False,
) -> Reliability:
    """The reliability of one pair at its orientation (rigorous residuals, no loss).

    `sigma0`: the a-priori standard deviation of unit weight: 1 if pair.sigma are the
    true standard deviations; the standard deviation of a coordinate if the pair has
    unit sigma; None if it is not known: the estimated one then takes its place,
    detectable errors are those of the t test, and nothing is testable with less than
    two degrees of freedom. `sigma`: in its place the standard deviation of all
    coordinates, as `--sigma` of the command line, of a pair that was made without one.
    `level` of the test of each point, or (`familywise`) of all together by Šidák;
    `power` with which detectable errors are found. In a pair whose orientation is not
    usable nothing is testable. Works under jit and vmap. Raises ValueError for a batch
    without vmap, and for a second standard deviation.
    """
    if pair.x_left.ndim != 1:
        raise ValueError(
            "assess takes one pair, but the coordinates have shape "
            f"{pair.x_left.shape}: use jax.vmap"
        )
    if sigma is not None:
        sigma0 = _unit_of(pair, sigma0, sigma)
    sigma0 = None if sigma0 is None else jnp.asarray(sigma0, pair.x_left.dtype)
    tables = tests(pair.mask.shape[0], sigma0 is not None, level, power, familywise)
    found = _assess(pair, orientation, sigma0, tables)
    return dataclasses.replace(found, power=power)


def _unit_of(pair: Pair, sigma0: ArrayLike | None, sigma: float) -> float:
    """The standard deviation of unit weight where all coordinates have this one. Raises
    ValueError where another is told."""
    own = pair.roots is not None
    own = own or (not is_traced(pair.sigma) and np.any(np.asarray(pair.sigma) != 1))
    if sigma0 is not None or own:
        told = "the pair has its own" if own else "sigma0 is given too"
        raise ValueError(
            f"assess: sigma is that of the coordinates of a pair made without one, but "
            f"{told}; leave out one of the two"
        )
    return sigma


@compiled(settings=quickly)
def _assess(
    pair: Pair,
    orientation: Orientation,
    sigma0: Array | None,
    tables: tuple[Array, Array, Array],
) -> Reliability:
    """All but the power. `tables`: those of `internal_reliability.tests`."""
    pair, _ = mask_unusable(pair)
    linear = linearise(pair, orientation.pose)
    checks = check(pair, orientation, linear, sigma0)
    use, known = checks.use, sigma0 is not None
    delta, limit, each = (critical.look_up(table, checks.points) for table in tables)
    factors = [b**2 * pair.sigma**2 * linear.weight for b in linear.gradient]
    parts = shown = tuple(factor * checks.redundancy for factor in factors)
    if pair.roots is not None:
        parts = _redundancy_of_coordinates(pair, linear, checks)
    hidden = _hidden(pair, orientation, linear, checks, shown, delta)
    usable = orientation.usable
    most = lambda value: jnp.where(usable, jnp.max(value, axis=-1), jnp.inf)
    return Reliability(
        used=use,
        sigma=jnp.where(use, pair.sigma, 0.0),
        w=normalised_residuals(linear, checks),
        coordinate_redundancy=parts,
        effect=tuple(hidden.elements),
        effect_m_q=hidden.m_q,
        effect_height=hidden.height,
        largest=jnp.stack([most(e) for e in hidden.elements]),
        largest_m_q=most(hidden.m_q),
        significance=_significance(orientation, checks.unit),
        sigma0=checks.unit,
        estimated=checks.estimated,
        degrees_of_freedom=checks.freedom.astype(int),
        level=each,
        limit=limit,
        delta0=delta,
        shown=None if pair.roots is None else shown,
        known=known,
        power=math.nan,
    )


def _redundancy_of_coordinates(
    pair: Pair, linear: Linear, checks: Checks
) -> Coordinates:
    """r B_k (Q Bᵀ)_k / D of every coordinate: the diagonal of Q_v Q⁻¹."""
    factor = pair.sigma**2 * linear.weight * checks.redundancy
    both = zip(linear.gradient, linear.lever, strict=True)
    return tuple(factor * b * along for b, along in both)


def _hidden(
    pair: Pair,
    orientation: Orientation,
    linear: Linear,
    checks: Checks,
    shown: Coordinates,
    delta: Array,
) -> Effects:
    """The effects of errors that are just detectable; infinite where an error does not
    show, zero where a point is not used. `shown`: r B_k² sigma² / D."""
    size = delta * checks.unit * checks.spread / checks.divisor
    size = jnp.where(checks.testable, size, 0.0)
    jump, shift = computed_once(_displace)(checks.shifts, linear.weight, size)
    found = effects(pair, orientation, linear, shift, jump, checks.redundancy)

    def bound(value: Values, seen: Bool[Array, "point"]) -> Values:
        return jnp.where(checks.use, jnp.where(seen, value, jnp.inf), 0.0)

    return Effects(
        elements=[bound(e, checks.testable) for e in found.elements],
        m_q=bound(found.m_q, checks.testable),
        height=tuple(
            bound(z, checks.testable & (part > UNTESTABLE))
            for z, part in zip(found.height, shown, strict=True)
        ),
    )


def _displace(shifts: list[Array], weight: Array, jump: Array):
    """The errors of g, and the shifts of the local parameters of the pose by them."""
    return jump, [-entry * weight * jump for entry in shifts]


def _significance(orientation: Orientation, unit: Array) -> Float[Array, "5"]:
    values = jnp.stack(orientation.elements.values())
    deviations = unit * jnp.sqrt(jnp.diagonal(orientation.cofactor))
    sure = orientation.usable & (deviations > 0)
    return ratio(values, deviations, sure)
