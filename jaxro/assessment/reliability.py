"""What a finished orientation can tell of errors in its measurements: which would be
seen, what hidden ones would do.

Of the Gauss-Helmert model A x + B v + g = 0 with one condition per point, D = B Q Bᵀ
its variance for sigma0 = 1, h = a N⁻¹ aᵀ / D its leverage (Baarda 1968; Pope 1976;
Förstner 1979, 1987; Caspary 1988):

    redundancy number         r = 1 - h                                    Σ r = n - 5
    Baarda's w                g / (sigma0 sqrt(D r))                       normal
    internally studentised    tau: the estimated sigma0 in its place       tau distribution of n - 5
    externally studentised    t: sigma0 estimated without this point       Student's t of n - 6
    of a coordinate           r_k = r B_k² Q_k / D
    detectable error          delta0 sigma0 sqrt(Q_k / r_k) = delta0 sigma0 sqrt(D / r) / |B_k|
    effect on the elements    N⁻¹ aᵀ / D times the error of g, delta0 sigma0 sqrt(D / r)
    external reliability      delta0 sqrt(h / r): no function of the elements moves by more
                              of its standard deviations

The four coordinates of a point enter one condition: an error in any of them gives the
same w, and where it is just detectable the same effect on the elements. All is of first
order, at the measured coordinates.
"""

from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammainc, gammaincc, ndtr
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import critical_values as critical
from ..adjustment.guarded import root
from ..adjustment.normal_equations import accumulate, inverse
from ..geometry.linear import Linear, linearised
from ..geometry.pairs import Coordinates, Pair, mask_unusable
from ..orientation.result import Orientation
from ..xla.kernels import computed_once
from ..xla.passes import count
from ..xla.programs import Program, is_traced
from ..xla.settings import COMPILE_FAST
from .external_reliability import effects

PerPoint = Float[Array, "*pairs point"]
PerPair = Float[Array, "*pairs"]
PerElement = Float[Array, "*pairs 5"]

Derived = Float[Array | np.ndarray, "*pairs point"]
"""Of JAX, or of NumPy where the reading is, as in reports."""

Decided = Bool[Array | np.ndarray, "*pairs point"]

UNTESTABLE = 1e-6
"""Redundancy number below which an observation is not checked by the others."""

CONTROL = ("not", "poorly", "sufficiently", "well")
"""How an observation is controlled, by the class of its redundancy number."""

BOUNDS = (0.01, 0.1, 0.3)
"""Redundancy numbers that part the classes (Förstner 1979)."""


class Reliability(eqx.Module):
    """The reliability of an orientation; for a batch every field has leading axes.
    Masked points are zero and False.

    Per point: whether it is `used`; `redundancy`; `w`, `tau`, `t` with the sign of g;
    whether it is `testable`: errors in it show at all. Where it is not, w, tau and t
    are 0 and what could hide is infinite. `effect` of the detectable error on the
    elements (in their order and unit), `effect_m_q`, and `external`, their bound in
    standard deviations. Per coordinate (x_left, y_left, x_right, y_right):
    `coordinate_redundancy`, the `detectable` error in the unit of the coordinates,
    whose standard deviation is sigma0 `sigma`, and `effect_height`: what it does to the
    model height Z of its point. Per pair: the `largest` effects on the elements, on
    m_q, and of `external`; `significance`, element over standard deviation (0 for
    `RelativePose`, whose local parameters have no values).

    `sigma0` is the a-priori standard deviation of unit weight where it is `known`, else
    the estimated one, and w is then tau. `limit`: what |w| exceeds with probability
    `level` when a point has no error; `delta0`: the error that is found with the power
    wanted, in standard deviations of w. What follows from other numbers is a property,
    so that a batch does not write it.
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
        """w by the estimated sigma0."""
        if not self.known:
            return self.w
        xp, there = namespace(self.w), self.estimated > 0
        return (
            self.w
            * xp.where(there, self.sigma0 / xp.where(there, self.estimated, 1.0), 0.0)[
                ..., None
            ]
        )

    @property
    def t(self) -> Derived:
        """w by sigma0 estimated from the other points, tau sqrt((f - 1) / (f - tau²));
        0 with f = 1."""
        xp, tau, f = (
            namespace(self.w),
            self.tau,
            self.degrees_of_freedom[..., None].astype(self.w.dtype),
        )
        rest = xp.maximum(f - tau**2, 1e-12)
        return xp.where(f > 1, tau * xp.sqrt(xp.where(f > 1, f - 1, 1.0) / rest), 0.0)

    @property
    def detectable(self) -> tuple[Derived, ...]:
        """Error of each coordinate that is found with the power wanted, delta0 sigma0
        sigma / sqrt(r)."""
        xp, size, testable = (
            namespace(self.w),
            (self.delta0 * self.sigma0)[..., None] * self.sigma,
            self.testable,
        )

        def of(r: Derived) -> Derived:
            seen = testable & (r > UNTESTABLE)
            return xp.where(
                self.used,
                xp.where(seen, size / xp.sqrt(xp.where(seen, r, 1.0)), xp.inf),
                0.0,
            )

        return tuple(of(r) for r in self.coordinate_redundancy)

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
        """The points whose |w| exceeds the limit. Only the largest is evidence of an
        error in its own point."""
        return self.testable & (abs(self.w) > self.limit[..., None])

    @property
    def control(self) -> tuple[Int[Array, "*pairs point"], ...]:
        """Class of every coordinate, an index of `CONTROL`."""
        return tuple(controllability(r) for r in self.coordinate_redundancy)

    def p_values(self) -> PerPoint:
        """Of every point: how often |w| is larger when no point has an error; 1 where
        it cannot be tested.

        Normal where sigma0 is known, else of t.
        """
        return (
            jnp.where(self.testable, 2 * ndtr(-jnp.abs(self.w)), 1.0)
            if self.known
            else self.p_student()
        )

    def p_student(self) -> PerPoint:
        """The same by t, which needs no sigma0 and two degrees of freedom; 1 with
        fewer."""
        freedom = (self._freedom - 1)[..., None]
        return jnp.where(self.testable & (freedom > 0), student_p(self.t, freedom), 1.0)

    def global_p(self) -> PerPair:
        """Of the two-sided chi-squared test of the estimated sigma0 against the known
        one; 1 where there is no test: no degree of freedom, or sigma0 not known."""
        there = self.known & (self.degrees_of_freedom > 0)
        f = jnp.where(there, self._freedom, 1.0)
        half = f * jnp.where(there, self.estimated / self.sigma0, 1.0) ** 2 / 2
        below, above = gammainc(f / 2, half), gammaincc(f / 2, half)
        return jnp.where(there, jnp.where(below < above, 2 * below, 2 * above), 1.0)

    def b_level(self) -> PerPair:
        """The level at which the one-sided global test has the power of the tests of
        points (Baarda's B-method)."""
        return critical.b_method(
            self.level, self.power, jnp.where(self._freedom > 0, self._freedom, 1.0)
        )

    def significance_p(self) -> PerElement:
        """How often an element that is zero appears as large as this one; 1 where
        nothing can be said."""
        size = jnp.abs(self.significance)
        f = jnp.where(self._freedom > 0, self._freedom, 1.0)[..., None]
        return jnp.where(
            size > 0, 2 * ndtr(-size) if self.known else student_p(size, f), 1.0
        )

    @property
    def _freedom(self) -> PerPair:
        return jnp.asarray(self.degrees_of_freedom).astype(
            jnp.asarray(self.estimated).dtype
        )  # of NumPy in reports


def namespace(values: Any) -> Any:
    """NumPy for its arrays, as reports hold them, else jax.numpy."""
    return np if isinstance(values, np.ndarray) else jnp


def controllability(redundancy: ArrayLike) -> Int[Array, "..."]:
    """0 to 3 (see `CONTROL`): below 0.01, below 0.1, below 0.3, above."""
    return sum(jnp.where(jnp.asarray(redundancy) < bound, 0, 1) for bound in BOUNDS)  # pyright: ignore


def student_p(t: ArrayLike, freedom: ArrayLike) -> Float[Array, "..."]:
    """How often |t| is larger by chance, `freedom` broadcast to t."""
    t = jnp.asarray(t)
    f = jnp.broadcast_to(jnp.where(jnp.asarray(freedom) > 0, freedom, 1.0), t.shape)
    return betainc(f / 2, jnp.full_like(t, 0.5), f / (f + t**2))


def assess(
    pair: Pair,
    orientation: Orientation,
    *,
    sigma0: ArrayLike | None = None,
    level: float = 0.001,
    power: float = 0.80,
    familywise: bool = False,
) -> Reliability:
    """The reliability of one pair at its orientation (by `coplanarity.rigorous`,
    without a loss).

    `sigma0`: the a-priori standard deviation of unit weight: 1 where pair.sigma are the
    true standard deviations, that of a coordinate where the pair has unit sigma. None
    where it is not known: the estimated one then stands in its place, detectable errors
    are those of the t test, and nothing is testable with less than two degrees of
    freedom. `level` of the test of each point, or (`familywise`) of all together by
    Šidák; `power` with which detectable errors are found. Works under jit and vmap. A
    pair whose orientation is not usable has nothing testable.
    """
    if pair.x_left.ndim != 1:
        raise ValueError(
            "assess takes one pair, but the coordinates have shape "
            f"{pair.x_left.shape}: use jax.vmap"
        )
    sigma0 = None if sigma0 is None else jnp.asarray(sigma0, pair.x_left.dtype)
    options = {
        "sigma0": sigma0,
        "level": level,
        "power": power,
        "familywise": familywise,
    }
    if is_traced((pair, orientation, sigma0)):
        return _assess((pair, orientation), **options)
    return Program(_assess, options, COMPILE_FAST)((pair, orientation))


def _assess(
    read: tuple[Pair, Orientation],
    *,
    sigma0: Array | None,
    level: float,
    power: float,
    familywise: bool,
):
    pair, orientation = mask_unusable(read[0])[0], read[1]
    use = pair.mask & orientation.usable
    linear = linearised(pair, orientation.pose)
    z, h, squares = computed_once(_solved)(linear)
    r = jnp.where(use, 1 - h, 0.0)
    points = count(use)
    freedom = jnp.where(points > 5, points - 5, 0.0)
    estimated = root(squares / jnp.where(freedom > 0, freedom, 1.0), freedom > 0)
    known = sigma0 is not None
    unit = estimated if sigma0 is None else sigma0
    testable = use & (r > UNTESTABLE) & (freedom > (0 if known else 1)) & (unit > 0)

    safe = jnp.where(testable, r, 1.0)
    spread = jnp.where(
        testable, jnp.sqrt(safe / jnp.where(testable, linear.weight, 1.0)), 1.0
    )  # sqrt(r D)
    tests = _tests(pair.mask.shape[0], known, level, power, familywise)
    delta, limit, each = (critical.looked_up(table, points) for table in tests)
    # of g: delta sigma0 sqrt(D / r), and what it does to the local parameters of the
    # pose
    jump, shift = computed_once(_moved)(
        z, linear.weight, jnp.where(testable, delta * unit * spread / safe, 0.0)
    )
    parts = tuple(b**2 * pair.sigma**2 * linear.weight * r for b in linear.gradient)
    hidden = lambda value, seen: jnp.where(use, jnp.where(seen, value, jnp.inf), 0.0)

    done = effects(pair, orientation, linear, shift, jump, r)
    effect = tuple(hidden(e, testable) for e in done.elements)
    effect_m_q = hidden(done.m_q, testable)
    most = lambda value: jnp.where(orientation.usable, jnp.max(value, axis=-1), jnp.inf)

    deviations = jnp.sqrt(jnp.diagonal(orientation.cofactor))
    values = jnp.stack(orientation.elements.values())
    spread_of = unit * deviations
    sure = orientation.usable & (spread_of > 0)
    return Reliability(
        use,
        jnp.where(use, pair.sigma, 0.0),
        jnp.where(testable, linear.g * linear.weight * spread / safe, 0.0)
        / jnp.where(unit > 0, unit, 1.0),
        parts,
        effect,
        effect_m_q,
        tuple(
            hidden(z, testable & (part > UNTESTABLE))
            for z, part in zip(done.height, parts, strict=True)
        ),
        jnp.stack([most(e) for e in effect]),
        most(effect_m_q),
        jnp.where(sure, values / jnp.where(sure, spread_of, 1.0), 0.0),
        unit,
        estimated,
        freedom.astype(int),
        each,
        limit,
        delta,
        known,
        power,
    )


def _solved(linear: Linear):
    """N⁻¹ aᵀ and leverage of every point, and Σ g² / d."""
    n, _, squares = accumulate(
        [linear.g], [[c] for c in linear.columns], [linear.weight]
    )
    # five products a point by the inverse, where every entry of a substitution would
    # repeat those before it
    q, _ = computed_once(inverse)(n)
    z = [
        sum(q[max(i, j)][min(i, j)] * c for j, c in enumerate(linear.columns))
        for i in range(5)
    ]
    return (
        z,
        linear.weight * sum(a * b for a, b in zip(linear.columns, z, strict=True)),
        squares,
    )


def _moved(z: list[Array], weight: Array, jump: Array):
    """The jumps, and the shifts of the local parameters by them."""
    return jump, [-entry * weight * jump for entry in z]


@lru_cache(maxsize=64)
def _tests(
    most: int, known: bool, level: float, power: float, familywise: bool
) -> tuple[Any, ...]:
    """delta0, limit of |w| and level of the test of a point, for pairs of 0 to `most`
    points. Raises ValueError."""
    for name, probability in (("level", level), ("power", power)):
        if not 0 < probability < 1:
            raise ValueError(
                f"{name} is a probability, between 0 and 1, got {probability}"
            )
    with jax.ensure_compile_time_eval():
        n = jnp.asarray(critical.counts(most))
        alone = critical.sidak(level, n) if familywise else jnp.full_like(n, level)
        if known:
            delta, limit = critical.delta_normal(alone, power), critical.normal(alone)
        else:
            freedom = jnp.maximum(n - 5, 2.0)
            delta, limit = (
                critical.delta_student(alone, power, freedom - 1),
                critical.tau(alone, freedom),
            )
        return np.asarray(delta), np.asarray(limit), np.asarray(alone)
