"""Reads the columns of `columns` from oriented pairs, for compiled programs: one function
of a pair and its orientation. Angles become degrees.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..adjustment.guarded import root
from ..assessment.likelihood import curvature
from ..assessment.reliability import Reliability, assess, controllability
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    RelativePose,
    convert,
)
from ..geometry.pairs import Coordinates, Pair
from ..orientation.orient import Orientation
from ..orientation.results import RESULTS
from ..xla.programs import compiled
from .columns import columns_of

Columns = dict[str, Array]


class Reader(NamedTuple):
    """read(pair, orientation) -> columns of the pair, {table: columns of its points}:
    all `tables` but reliability, for which there is an `Assessor`.

    `sigma_known`: whether the sigmas of the pairs are true standard deviations;
    `all_parallaxes`: whether y-parallaxes of points that take no part are wanted.
    """

    system: type[AbstractElements]
    tables: tuple[str, ...]
    sigma_known: bool = False
    all_parallaxes: bool = False

    def __call__(
        self, pair: Pair, orientation: Orientation
    ) -> tuple[Columns, dict[str, Columns]]:
        """The columns by name."""
        told = Told(
            pair,
            orientation,
            sigma_known=self.sigma_known,
            all_parallaxes=self.all_parallaxes,
        )
        read = lambda table: _read(table, told)
        of_points = [t for t in self.tables if t not in ("elements", "reliability")]
        return read("elements"), {table: read(table) for table in of_points}


class Oriented(NamedTuple):
    """A pair with what its reliability depends on of the columns that are read of its
    orientation; batches of them have leading axes. `z`: model heights, where they
    matter."""

    pair: Pair
    usable: Bool[Any, "*pairs"]
    degrees_of_freedom: Int[Any, "*pairs"]
    pose: Float[Any, "*pairs 7"]
    base: Float[Any, "*pairs"]
    z: Float[Any, "*pairs point"]

    @property
    def x_left(self) -> Float[Any, "*pairs point"]:
        """Of the pair, by which batches are split."""
        return self.pair.x_left


class Assessor(NamedTuple):
    """assess(oriented) -> the columns of the reliability of its points.

    A program of its own: together with the orientation it takes much longer to compile.
    `sigma_known`: whether the sigmas of the pairs are true standard deviations.
    """

    system: type[AbstractElements]
    sigma_known: bool

    def __call__(self, oriented: Oriented) -> Columns:
        """The columns by name."""
        pair, pose = oriented.pair, RelativePose(*oriented.pose)
        nothing, none = jnp.zeros_like(pair.x_left), jnp.zeros_like(oriented.base)
        orientation = Orientation(
            pose=pose,
            elements=convert(pose, self.system, oriented.base),
            cofactor=jnp.zeros((5, 5)),
            parallax=nothing,
            residuals=nothing,
            redundancy=nothing,
            model=(nothing, nothing, oriented.z),
            in_front=pair.mask,
            m_q=none,
            sigma0=none,
            degrees_of_freedom=oriented.degrees_of_freedom,
            iterations=oriented.degrees_of_freedom,
            result=RESULTS.where(oriented.usable, RESULTS.successful, RESULTS.diverged),  # pyright: ignore[reportArgumentType]
        )
        return _read(
            "reliability", Told(pair, orientation, sigma_known=self.sigma_known)
        )


def _read(table: str, told: "Told") -> Columns:
    """The columns of a table that come from an orientation."""
    columns = columns_of(table, type(told.orientation.elements))
    return {c.name: jnp.asarray(c.of(told)) for c in columns if c.of is not None}


def report_elements(
    found: AbstractElements, cofactor: Array, sigma0: Array
) -> tuple[list[Array], list[Array]]:
    """The numbers that are reported of elements and their standard deviations,
    sqrt(diag(J C Jᵀ)): angles in degrees. What is given has the deviation 0."""
    numbers, angles = _numbers(found)
    if not isinstance(found, RelativePose):
        zero = [jnp.zeros_like(sigma0)] * (len(numbers) - 5)
        deviations = [*zero, *(sigma0 * root(cofactor[i, i]) for i in range(5))]
        return _in_degrees(numbers, angles), _in_degrees(deviations, angles)

    values = lambda *step: _numbers(found.move(step))[0]
    origin = (jnp.zeros_like(sigma0),) * 5
    slopes = jax.jacfwd(values, argnums=tuple(range(5)))(*origin)
    jacobian = jnp.stack([jnp.stack(row) for row in slopes])
    products = jacobian[:, :, None] * jacobian[:, None, :] * cofactor[None]
    deviations = sigma0 * root(jnp.sum(products, axis=(1, 2)))
    return _in_degrees(values(*origin), angles), _in_degrees(list(deviations), angles)


@compiled
def report_all(
    elements: AbstractElements, cofactor: Array, sigma0: Array
) -> tuple[list[Array], list[Array]]:
    """`report_elements` of many pairs."""
    return jax.vmap(report_elements)(elements, cofactor, sigma0)


def report_numbers(centre: AbstractElements, elements: AbstractElements) -> Array:
    """The numbers that are reported of elements, in degrees where they are angles, as a
    `likelihood.Quantity`."""
    del centre
    return jnp.stack(_in_degrees(*_numbers(elements)))


def _numbers(elements: AbstractElements) -> tuple[list[Array], tuple[bool, ...]]:
    """The numbers that are reported, and which of them are angles: of a `RelativePose`
    the base and the angles of M = R3(kappa) R2(phi) R1(omega), of `DependentElements`
    bx first."""
    if isinstance(elements, RelativePose):
        rotation, base = elements.relative()
        angles = rot.omega_phi_kappa(rot.transpose(rotation))
        return [*base, *angles], (False,) * 3 + (True,) * 3
    bx = [elements.bx] if isinstance(elements, DependentElements) else []
    return [*bx, *elements.values()], (False,) * len(bx) + elements.angles


def _in_degrees(numbers: Sequence[Array], angles: Sequence[bool]) -> list[Array]:
    both = zip(numbers, angles, strict=True)
    return [jnp.rad2deg(n) if angle else n for n, angle in both]


class Told:
    """One oriented pair and what is calculated of it once for several columns."""

    def __init__(
        self,
        pair: Pair,
        orientation: Orientation,
        *,
        sigma_known: bool = False,
        all_parallaxes: bool = False,
    ):
        self.pair, self.orientation = pair, orientation
        self._sigma_known, self._all_parallaxes = sigma_known, all_parallaxes

    def where_testable(self, values: Array) -> Float[Array, "point"]:
        """The values of points in which an error would show, of others NaN."""
        return jnp.where(self.reliability.testable, values, jnp.nan)

    @cached_property
    def parallax(self) -> Array:
        """y-parallaxes: of points that were rejected, too, where pairs are cleaned."""
        if self._all_parallaxes:
            return coplanarity.parallaxes(self.pair, self.orientation.pose)
        return self.orientation.parallax

    @cached_property
    def corrections(self) -> Coordinates:
        """Corrections of the four coordinates."""
        return self.orientation.corrections(self.pair)

    @cached_property
    def elements(self) -> tuple[list[Array], list[Array]]:
        """The elements that are reported, and their standard deviations."""
        o = self.orientation
        return report_elements(o.elements, o.cofactor, o.sigma0)

    @property
    def _known(self) -> Array | None:
        """sigma0 where it is known before the measurement."""
        sigma0 = self.orientation.sigma0
        return jnp.ones_like(sigma0) if self._sigma_known else None

    @cached_property
    def curvature(self) -> Array:
        """How far the deviations of the elements are from being all there is to say."""
        return curvature(self.pair, self.orientation, sigma0=self._known)

    @cached_property
    def reliability(self) -> Reliability:
        """What the measurements tell of errors in each other."""
        return assess(self.pair, self.orientation, sigma0=self._known)

    @cached_property
    def control(self) -> tuple[Array, ...]:
        """Class of every coordinate, a place in `CONTROL`."""
        return tuple(map(controllability, self.reliability.coordinate_redundancy))
