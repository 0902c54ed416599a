"""Which source of error costs how much of the variance of a result.

A source is a few independent errors with standard deviations, and how they displace
what is given. Each e_k of standard deviation s_k adds (d result / d e_k)² s_k² to the
variance of a result, with the exact derivative of the finished adjustment. The weights
of the adjustment stay those of the pair: a source says what is true, `sigma` what was
assumed.
"""

import abc
from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from ..adjustment.guarded import root
from ..geometry.mock_pairs import plant
from ..geometry.pairs import Pair
from ..orientation.orient import orient
from ..xla.passes import total
from .propagation import jacobian
from .sensitivity import Quantity, heights, run


class Given(NamedTuple):
    """What an orientation starts from: the pair, and the length of the base if it is
    given."""

    pair: Pair
    base: Array | None = None


class AbstractSource(eqx.Module):
    """Independent errors of known standard deviations."""

    @abc.abstractmethod
    def deviations(self, pair: Pair) -> PyTree:
        """The standard deviations of the errors."""

    @abc.abstractmethod
    def displaced(self, given: Given, errors: PyTree) -> Given:
        """What is given, with errors shaped like `deviations`."""


class LeftCoordinates(AbstractSource):
    """x and y of every point in the left photo: one standard deviation, or one per
    point."""

    deviation: ArrayLike

    def deviations(self, pair):
        return _per_point(self.deviation, pair)

    def displaced(self, given, errors):
        return given._replace(
            pair=plant(given.pair, x_left=errors[0], y_left=errors[1])
        )


class RightCoordinates(AbstractSource):
    """x and y of every point in the right photo: one standard deviation, or one per
    point."""

    deviation: ArrayLike

    def deviations(self, pair):
        return _per_point(self.deviation, pair)

    def displaced(self, given, errors):
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

    def displaced(self, given, errors):
        focals = [
            f + errors if on else f
            for f, on in (
                (given.pair.focal_left, self.left),
                (given.pair.focal_right, self.right),
            )
        ]
        return given._replace(
            pair=eqx.tree_at(
                lambda p: (p.focal_left, p.focal_right), given.pair, focals
            )
        )


class PrincipalPoint(AbstractSource):
    """x0 and y0 of the principal point, the same error in both photos, or in one of
    them."""

    deviation: ArrayLike
    left: bool = True
    right: bool = True

    def deviations(self, pair):
        one = jnp.asarray(self.deviation, pair.x_left.dtype)
        return one, one

    def displaced(self, given, errors):
        x, y = (-e for e in errors)
        names = (
            *(("x_left", "y_left") if self.left else ()),
            *(("x_right", "y_right") if self.right else ()),
        )
        return given._replace(
            pair=plant(given.pair, **dict(zip(names, (x, y) * 2, strict=False)))
        )


class Base(AbstractSource):
    """The given length of the base, which scales the model."""

    deviation: ArrayLike

    def deviations(self, pair):
        return jnp.asarray(self.deviation, pair.x_left.dtype)

    def displaced(self, given, errors):
        if given.base is None:
            raise ValueError(
                "error_budget: an error of the base needs its length: give base="
            )
        return given._replace(base=given.base + errors)


class Source(AbstractSource):
    """Any other source: function(given, errors) -> Given, errors shaped like
    `deviation` (a tree of arrays)."""

    deviation: PyTree
    function: Callable[[Given, PyTree], Given]

    def deviations(self, pair):
        return jax.tree.map(lambda s: jnp.asarray(s, pair.x_left.dtype), self.deviation)

    def displaced(self, given, errors):
        return self.function(given, errors)


class ErrorBudget(NamedTuple):
    """A result, the standard deviation of each of its numbers from all sources
    together, and by the name of the source its variances and its shares, which add up
    to 1 (all 0 where there is no variance, as at masked points).

    Where the orientation is not usable the standard deviations are infinite and the
    rest is 0.
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
    """How much of the variance of quantity(orient(pair, base=base, **options)) each of
    the independent sources costs.

    Without `base` lengths are relative: the mean x-parallax is taken as its length and
    as free of error. Works under jit and vmap. Raises ValueError without any source,
    and for a standard deviation that is negative or not finite.
    """
    if not sources:
        raise ValueError(
            "error_budget: give the sources of errors, such as {'focal length': "
            "FocalLength(0.01)}"
        )
    for name, source in sources.items():
        for leaf in jax.tree.leaves(source):
            if isinstance(leaf, int | float | np.ndarray) and not np.all(
                np.isfinite(leaf) & (np.asarray(leaf) >= 0)
            ):
                raise ValueError(
                    f"error_budget: the standard deviations of {name!r} are to be "
                    "finite and not negative"
                )
    number = lambda leaf: (
        jnp.asarray(leaf, pair.x_left.dtype)
        if isinstance(leaf, float | np.ndarray)
        else leaf
    )
    more = {"sources": jax.tree.map(number, dict(sources)), "quantity": quantity}
    return run(_error_budget, pair, options | {"base": base}, more)


def _error_budget(pair: Pair, *, sources, quantity, base, **options) -> ErrorBudget:
    deviations = {name: source.deviations(pair) for name, source in sources.items()}

    def of(errors):
        given = Given(pair, base)
        for name, source in sources.items():
            given = source.displaced(given, errors[name])
        found = orient(given.pair, base=given.base, **options)
        value = quantity(found)
        return value, (value, found.usable)

    by, (value, usable) = jacobian(
        of, jax.tree.map(jnp.zeros_like, deviations), has_aux=True
    )
    by = jax.tree.map(lambda d: jnp.where(usable, d, 0.0), by)
    by = jax.tree.transpose(
        jax.tree.structure(value), jax.tree.structure(deviations), by
    )

    def variance(name: str) -> PyTree:
        s, structure = jax.tree.flatten(deviations[name])
        slopes = structure.flatten_up_to(by[name])
        return jax.tree.map(
            lambda *d: sum(_squares(*both) for both in zip(d, s, strict=True)), *slopes
        )

    variances = {name: variance(name) for name in sources}
    whole = jax.tree.map(lambda *v: sum(v), *variances.values())
    share = lambda v, all_: jnp.where(all_ > 0, v / jnp.where(all_ > 0, all_, 1.0), 0.0)
    return ErrorBudget(
        value,
        usable,
        jax.tree.map(lambda v: jnp.where(usable, root(v), jnp.inf), whole),
        variances,
        {name: jax.tree.map(share, v, whole) for name, v in variances.items()},
    )


def _squares(slope: Array, deviation: Array) -> Array:
    """Σ (slope deviation)² over the axes of the deviation, the last ones of the
    slope."""
    lead = slope.shape[: slope.ndim - deviation.ndim]
    return total(
        (slope.reshape(*lead, -1) * deviation.reshape((1,) * len(lead) + (-1,))) ** 2
    )


def _per_point(deviation: ArrayLike, pair: Pair) -> tuple[Array, Array]:
    one = jnp.broadcast_to(jnp.asarray(deviation, pair.x_left.dtype), pair.x_left.shape)
    return one, one
