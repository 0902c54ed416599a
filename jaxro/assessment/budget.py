"""Error budget: how much each source of error adds to the variance of a result.

A source is a few independent errors e_k with standard deviations s_k, and a function
that displaces the given measurements by them. Each error adds

    (d result / d e_k)² s_k²

to the variance of a result, with the exact derivative of the finished adjustment. The
weights of the adjustment stay those of the pair: a source says how accurate the
measurements are, `sigma` of the pair how accurate they were assumed to be.

A source of your own subclasses `AbstractSource`, or is a `Source` made of a function.
"""

import abc
from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from ..adjustment.guarded import ratio, root
from ..adjustment.propagation import jacobian
from ..geometry.mock_pairs import plant
from ..geometry.pairs import Pair
from ..orientation.orient import orient
from ..xla.passes import total
from .sensitivity import Quantity, heights, run


class Given(NamedTuple):
    """The measurements of an orientation: the pair, and the length of the base if it is
    given."""

    pair: Pair
    base: Array | None = None


class AbstractSource(eqx.Module):
    """Independent errors of known standard deviations."""

    @abc.abstractmethod
    def deviations(self, pair: Pair) -> PyTree:
        """The standard deviations of the errors."""

    @abc.abstractmethod
    def displace(self, given: Given, errors: PyTree) -> Given:
        """The measurements with errors shaped like `deviations`."""


class LeftCoordinates(AbstractSource):
    """x and y of every point in the left photo: one standard deviation, or one per
    point."""

    deviation: ArrayLike

    def deviations(self, pair):
        return _per_point(self.deviation, pair)

    def displace(self, given, errors):
        return given._replace(
            pair=plant(given.pair, x_left=errors[0], y_left=errors[1])
        )


class RightCoordinates(AbstractSource):
    """x and y of every point in the right photo: one standard deviation, or one per
    point."""

    deviation: ArrayLike

    def deviations(self, pair):
        return _per_point(self.deviation, pair)

    def displace(self, given, errors):
        return given._replace(
            pair=plant(given.pair, x_right=errors[0], y_right=errors[1])
        )


class FocalLength(AbstractSource):
    """The focal length of the camera that took both photos, or of the one that took one
    of them."""

    deviation: ArrayLike
    left: bool = True
    right: bool = True

    def deviations(self, pair):
        return jnp.asarray(self.deviation, pair.x_left.dtype)

    def displace(self, given, errors):
        pair = given.pair
        left = pair.focal_left + errors if self.left else pair.focal_left
        right = pair.focal_right + errors if self.right else pair.focal_right
        focals = lambda p: (p.focal_left, p.focal_right)
        return given._replace(pair=eqx.tree_at(focals, pair, (left, right)))


class PrincipalPoint(AbstractSource):
    """x0 and y0 of the principal point, the same error in both photos, or in one of
    them."""

    deviation: ArrayLike
    left: bool = True
    right: bool = True

    def deviations(self, pair):
        one = jnp.asarray(self.deviation, pair.x_left.dtype)
        return one, one

    def displace(self, given, errors):
        x, y = (-e for e in errors)
        moved = {"x_left": x, "y_left": y} if self.left else {}
        if self.right:
            moved |= {"x_right": x, "y_right": y}
        return given._replace(pair=plant(given.pair, **moved))


class Base(AbstractSource):
    """The given length of the base, which scales the model."""

    deviation: ArrayLike

    def deviations(self, pair):
        return jnp.asarray(self.deviation, pair.x_left.dtype)

    def displace(self, given, errors):
        if given.base is None:
            raise ValueError(
                "error_budget: an error of the base needs its length: give base="
            )
        return given._replace(base=given.base + errors)


class Source(AbstractSource):
    """Any other source: function(given, errors) returns the displaced `Given`; errors
    are shaped like `deviation` (a tree of arrays)."""

    deviation: PyTree
    function: Callable[[Given, PyTree], Given]

    def deviations(self, pair):
        return jax.tree.map(lambda s: jnp.asarray(s, pair.x_left.dtype), self.deviation)

    def displace(self, given, errors):
        return self.function(given, errors)


class ErrorBudget(NamedTuple):
    """The `value` of a result, the standard `deviations` of its numbers from all
    sources together, and by the name of the source its `variances` and `shares`. Shares
    add up to 1 (all are 0 where there is no variance, as at masked points).

    If the orientation is not `usable` the standard deviations are infinite and the rest
    is 0.
    """

    value: PyTree
    usable: Array
    deviations: PyTree
    variances: dict[str, PyTree]
    shares: dict[str, PyTree]


def error_budget(
    pair: Pair,
    sources: Mapping[str, AbstractSource],
    quantity: Quantity = heights,
    *,
    base: ArrayLike | None = None,
    **options,
) -> ErrorBudget:
    """How much each of the independent `sources` adds to the variance of
    quantity(orient(pair, base=base, **options)).

    Without `base` lengths are relative: the mean x-parallax is taken as the length of
    the base, free of error. Works under jit and vmap. Raises ValueError without any source,
    and for a standard deviation that is negative or not finite.
    """
    if not sources:
        raise ValueError(
            "error_budget: give the sources of errors, such as {'focal length': "
            "FocalLength(0.01)}"
        )
    for name, source in sources.items():
        _check_deviations(name, source)

    def as_array(leaf):
        given = isinstance(leaf, float | np.ndarray)
        return jnp.asarray(leaf, pair.x_left.dtype) if given else leaf

    more = {"sources": jax.tree.map(as_array, dict(sources)), "quantity": quantity}
    return run(_error_budget, pair, options | {"base": base}, more)


def _check_deviations(name: str, source: AbstractSource) -> None:
    for leaf in jax.tree.leaves(source):
        if not isinstance(leaf, int | float | np.ndarray):
            continue
        if not np.all(np.isfinite(leaf) & (np.asarray(leaf) >= 0)):
            raise ValueError(
                f"error_budget: the standard deviations of {name!r} are to be finite "
                "and not negative"
            )


def _error_budget(pair: Pair, *, sources, quantity, base, **options) -> ErrorBudget:
    deviations = {name: source.deviations(pair) for name, source in sources.items()}

    def result(errors):
        given = Given(pair, base)
        for name, source in sources.items():
            given = source.displace(given, errors[name])
        found = orient(given.pair, base=given.base, **options)
        value = quantity(found)
        return value, (value, found.usable)

    exact = jax.tree.map(jnp.zeros_like, deviations)
    by, (value, usable) = jacobian(result, exact, has_aux=True)
    by = jax.tree.map(lambda d: jnp.where(usable, d, 0.0), by)
    by = jax.tree.transpose(jax.tree.structure(value), jax.tree.structure(exact), by)
    variances = {name: _variance(by[name], s) for name, s in deviations.items()}
    whole = jax.tree.map(lambda *v: sum(v), *variances.values())
    deviation = lambda v: jnp.where(usable, root(v), jnp.inf)
    share = lambda v, whole: ratio(v, whole, whole > 0)
    return ErrorBudget(
        value=value,
        usable=usable,
        deviations=jax.tree.map(deviation, whole),
        variances=variances,
        shares={n: jax.tree.map(share, v, whole) for n, v in variances.items()},
    )


def _variance(slopes: PyTree, deviations: PyTree) -> PyTree:
    """The variance of every number of the result from one source; `slopes` has a tree
    like the result for every error."""
    s, structure = jax.tree.flatten(deviations)

    def of_number(*slopes: Array) -> Array:
        return sum(_squares(*both) for both in zip(slopes, s, strict=True))  # pyright: ignore[reportReturnType]

    return jax.tree.map(of_number, *structure.flatten_up_to(slopes))


def _squares(slope: Array, deviation: Array) -> Array:
    """Σ (slope deviation)² over the axes of the deviation, the last ones of the
    slope."""
    lead = slope.shape[: slope.ndim - deviation.ndim]
    errors = deviation.reshape((1,) * len(lead) + (-1,))
    return total((slope.reshape(*lead, -1) * errors) ** 2)


def _per_point(deviation: ArrayLike, pair: Pair) -> tuple[Array, Array]:
    one = jnp.broadcast_to(jnp.asarray(deviation, pair.x_left.dtype), pair.x_left.shape)
    return one, one
