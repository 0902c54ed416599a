"""Measured stereo pairs: image coordinates, their standard deviations, a mask, two
focal lengths.

Photo coordinates are right-handed, x along the flight, y up, origin at the principal
point, in mm (or in px with the focal length in px); the image vector is p = (x, y, -f).
Left and right x and y are separate arrays, points last, so that a batch of pairs is
arithmetic on flat arrays. Points that do not exist are zeros with mask False, never
NaN.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..xla.passes import count, total
from ..xla.programs import is_traced
from ..xla.settings import settings_for
from . import cofactor_roots
from .cofactor_roots import UNIT, CofactorRoots
from .copies import find_copies, repeated

Coordinates = tuple[Float[Array, "*pairs point"], ...]
"""x_left, y_left, x_right, y_right"""


Values = ArrayLike | Sequence
"""Anything that makes an array"""


class Camera(eqx.Module):
    """From measured image coordinates to photo coordinates; used at the edge, never
    inside the engine.

        x = (u - u0) * pixel_size,    y = ±(v - v0) * pixel_size

    (minus where rows count downwards).

    `focal` is in photo units (mm, or px when pixel_size is 1); `principal_point` in
    measured units.
    """

    focal: float
    principal_point: tuple[float, float] = (0.0, 0.0)
    pixel_size: float = 1.0
    y_down: bool = False

    def __check_init__(self):
        for name, value in (("focal", self.focal), ("pixel_size", self.pixel_size)):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(
                    f"Camera: {name} must be a positive number, got {value!r}"
                )
        if len(self.principal_point) != 2 or not np.all(
            np.isfinite(self.principal_point)
        ):
            raise ValueError(
                "Camera: principal_point must be two numbers, got "
                f"{self.principal_point!r}"
            )

    def to_photo(
        self, u: ArrayLike, v: ArrayLike
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Photo coordinates (x right, y up, origin at the principal point) of measured
        ones."""
        sign = -1.0 if self.y_down else 1.0
        u0, v0 = self.principal_point
        return (jnp.asarray(u) - u0) * self.pixel_size, sign * (
            jnp.asarray(v) - v0
        ) * self.pixel_size


COARSE = 10.0
"""Standard deviation, of the weighted mean of all, above which a point says nothing of
where the photos stand."""


class Pair(eqx.Module):
    """One measured stereo pair, or a batch of them (leading axes on every field).

    `sigma` is the standard deviation of each of the four coordinates of a point; 1
    means unit weight, and sigma0 is then the standard deviation of a coordinate in the
    unit of the coordinates.

    `roots`: where the coordinates of a point are not equally accurate, or depend on
    each other. sigma² then is the mean of their variances. None for all other pairs.
    `score`: how likely each match is right for whoever matched the photos, the higher the
    likelier, in any unit; only its order counts. NaN where it is not known; None of pairs
    without scores.
    """

    x_left: Float[Array, "*pairs point"]
    y_left: Float[Array, "*pairs point"]
    x_right: Float[Array, "*pairs point"]
    y_right: Float[Array, "*pairs point"]
    sigma: Float[Array, "*pairs point"]
    mask: Bool[Array, "*pairs point"]
    focal_left: Float[Array, "*pairs"]
    focal_right: Float[Array, "*pairs"]
    roots: CofactorRoots | None = None
    score: Float[Array, "*pairs point"] | None = None

    @property
    def coordinates(self) -> Coordinates:
        """(x_left, y_left, x_right, y_right)"""
        return self.x_left, self.y_left, self.x_right, self.y_right

    @property
    def count(self) -> Float[Array, "*pairs"]:
        """Number of points that take part, as a float."""
        return total(self.mask.astype(self.x_left.dtype))

    @property
    def coarse(self) -> Bool[Array, "*pairs point"]:
        """Points that are measured more than COARSE times less accurately than the
        weighted mean of all."""
        weight = jnp.where(self.mask, 1 / self.sigma**2, 0.0)
        mean = total(weight) / jnp.maximum(self.count, 1.0)
        return self.mask & (weight * COARSE**2 < mean[..., None])

    @property
    def covariances(self) -> tuple[Float[np.ndarray, "*pairs point 2 2"], ...]:
        """The covariance matrices of (x, y) of every point, left and right, in
        NumPy."""
        roots = with_roots(self).roots
        assert roots is not None
        variance = np.asarray(self.sigma, float)[..., None, None] ** 2
        left, right = roots.cofactors
        return left * variance, right * variance

    def with_mask(self, mask: Values) -> "Pair":
        """The same pair with other points taking part. Raises ValueError where the
        shapes do not agree."""
        new = mask if is_traced(mask) else jax.device_put(np.array(mask, bool))
        if np.shape(new) != np.shape(self.mask):
            raise ValueError(
                f"with_mask: the mask has shape {np.shape(new)}, the pair "
                f"{np.shape(self.mask)}"
            )
        return eqx.tree_at(lambda pair: pair.mask, self, new)

    def with_sigma(self, sigma: ArrayLike) -> "Pair":
        """The same pair with other standard deviations, of all points or of each; with
        `roots` they are those of the mean variances."""
        new = jnp.broadcast_to(
            jnp.asarray(sigma, self.sigma.dtype), jnp.shape(self.sigma)
        )
        return eqx.tree_at(lambda pair: pair.sigma, self, new)


def pair(
    x_left: Values,
    y_left: Values,
    x_right: Values,
    y_right: Values,
    *,
    focal: ArrayLike | Sequence,
    sigma: Values | None = None,
    weight: Values | None = None,
    mask: Values | None = None,
    covariances: tuple[Values, Values] | None = None,
    score: Values | None = None,
    copies: bool = False,
) -> Pair:
    """A `Pair` from four equally long coordinate arrays (leading batch axes allowed).

    `focal`: one focal length, or (left, right). `sigma`: standard deviation of a
    coordinate, per point or for all (default 1). `weight`: relative weights, sigma /
    sqrt(weight); weight 0 leaves the point out. `covariances`, in place of sigma: the
    covariance matrices of (x, y) in the left photo and in the right one, (..., point,
    2, 2) each or one for all. `score` of each match: the higher the likelier it is right;
    searches for wrong points use it (`rejection.search`). A point that repeats another
    one (`geometry.copies`) is masked: the two are one measurement. With `copies` it
    takes part, as in a layout that is only planned. Raises ValueError where the shapes
    do not agree, and for what are no real numbers.
    """
    dtype = jnp.result_type(float)
    if covariances is not None and sigma is not None:
        raise ValueError(
            "pair: sigma and covariances are given; the variances of the coordinates "
            "are in the covariances, leave out sigma"
        )
    if isinstance(focal, tuple | list) and len(focal) != 2:
        raise ValueError(
            f"pair: focal must be one focal length, or (left, right), got {len(focal)} "
            "of them"
        )
    left, right = focal if isinstance(focal, tuple | list) else (focal, focal)
    given = x_left, y_left, x_right, y_right, left, right, sigma, weight, mask, score
    names = (
        "x_left",
        "y_left",
        "x_right",
        "y_right",
        "focal",
        "focal",
        "sigma",
        "weight",
        "mask",
        "score",
    )
    for name, values in zip(names, given, strict=True):
        if isinstance(values, np.ma.MaskedArray):
            raise ValueError(
                f"pair: {name} is a masked array of NumPy: give values, and what takes "
                "part as mask="
            )
        if values is not None and np.iscomplexobj(values):
            raise ValueError(f"pair: {name} must be real numbers, not complex ones")
    xp = _library(given)
    coordinates = [xp.array(c, dtype) for c in given[:4]]
    shape = coordinates[0].shape
    if len(shape) == 0:
        raise ValueError(
            "pair: coordinates must be arrays with the points on the last axis, got "
            "single numbers"
        )
    for name, c in zip(("y_left", "x_right", "y_right"), coordinates[1:], strict=True):
        if c.shape != shape:
            raise ValueError(
                f"pair: {name} has shape {c.shape}, x_left has {shape}; all four must "
                "agree"
            )
    roots = None
    if covariances is not None:
        sigma, roots = cofactor_roots.read_covariances(covariances, shape, mask)
    try:
        taking_part = xp.broadcast_to(
            xp.array(True if mask is None else mask, bool), shape
        )
        deviation = xp.broadcast_to(
            xp.array(1.0 if sigma is None else sigma, dtype), shape
        )
        if weight is not None:
            relative = xp.broadcast_to(xp.array(weight, dtype), shape)
            if xp is np and np.any(relative < 0):
                raise ValueError("a weight is negative")
            taking_part = taking_part & (relative != 0)
            deviation = deviation / xp.sqrt(xp.where(relative == 0, 1.0, relative))
        focals = [
            xp.broadcast_to(xp.array(f, dtype), shape[:-1]) for f in (left, right)
        ]
        if score is not None:
            score = xp.broadcast_to(xp.array(score, dtype), shape)
    except ValueError as error:
        fit = (
            f"mask, sigma, weight and score must fit the coordinates' shape {shape}, focal "
            f"lengths {shape[:-1]}"
        )
        raise ValueError(f"pair: {fit}: {error}") from None
    if not copies:
        smaller = xp.minimum(*focals)
        first = find_copies(coordinates, deviation, taking_part, smaller, xp)
        taking_part = taking_part & ~repeated(first)
    return _as_pair([*coordinates, deviation, taking_part, *focals], roots, score)


def with_roots(one: Pair) -> Pair:
    """The pair with `roots`: if it has none, those of equally accurate coordinates."""
    if one.roots is not None:
        return one
    xp = _library(one)
    fill = lambda value: xp.full(one.x_left.shape, value, one.x_left.dtype)
    roots, none = CofactorRoots(*map(fill, UNIT)), lambda leaf: leaf is None
    return eqx.tree_at(lambda pair: pair.roots, one, roots, is_leaf=none)


def with_score(one: Pair) -> Pair:
    """The pair with a score of each match: if it has none, one that is not known."""
    if one.score is not None:
        return one
    none, xp = lambda leaf: leaf is None, _library(one)
    unknown = xp.full(one.x_left.shape, np.nan, one.x_left.dtype)
    return eqx.tree_at(lambda pair: pair.score, one, unknown, is_leaf=none)


def _library(values: PyTree) -> ModuleType:
    """NumPy, which compiles nothing for each new length; of what is being traced,
    JAX's."""
    return jnp if is_traced(values) else np


def _as_pair(fields: list, roots: CofactorRoots | None, score: Any) -> Pair:
    """A `Pair` of these arrays, which nobody else changes: their memory is not
    copied."""
    every = [*fields, roots, score]
    return Pair(*(every if is_traced(every) else jax.device_put(every)))


def double(one: PyTree) -> PyTree:
    """A `Pair`, or pairs of any form, in arrays of double precision, in which
    everything is adjusted.

    Raises ValueError where JAX has none.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "jaxro adjusts in double precision, which is switched off in JAX: leave "
            "JAX_ENABLE_X64 unset, or call jax.config.update('jax_enable_x64', True)"
        )

    def doubled(a):
        if not hasattr(a, "dtype"):  # a number of Python, put into a field
            return np.asarray(a, float)
        return a.astype(float) if a.dtype == np.float32 else a

    return jax.tree.map(doubled, one)


def pad(one: Pair, points: int) -> Pair:
    """The pair with zeros up to `points` places, masked out. Raises ValueError if it
    has more."""
    return _as_pair(*_pad_fields(one, points, _library(one)))


def quickly(pair: Pair, *_: Any, **__: Any) -> dict[str, Any]:
    """How to compile what works on one pair: the fewer points, the sooner it is ready."""
    return settings_for(pair.x_left.size)


ROOMS = tuple(16 << doublings for doublings in range(28))
"""Places that single pairs are padded to: each size has a program, not each number."""


def room_for(points: int) -> int:
    """The places that a single pair of so many points is padded to."""
    return next(room for room in ROOMS if room >= points)


def first_points(tree: PyTree, points: int) -> PyTree:
    """The arrays of a tree with so many places, by NumPy, which compiles nothing."""
    return jax.device_put(jax.tree.map(lambda a: np.asarray(a)[..., :points], tree))


def _pad_fields(one: Pair, points: int, xp: ModuleType) -> tuple[list, Any, Any]:
    """New fields of a `Pair`, with so many places: those of every pair, the roots and
    the score."""
    missing = points - one.x_left.shape[-1]
    if missing < 0:
        raise ValueError(
            f"pad: the pair has {one.x_left.shape[-1]} points, more than {points}"
        )
    shape = *one.x_left.shape[:-1], missing
    places = lambda field, fill=0.0: xp.concatenate(
        [field, xp.full(shape, fill, field.dtype)], axis=-1
    )
    *coordinates, sigma, mask, left, right = jax.tree.leaves(one)[:8]
    roots = one.roots
    if roots is not None:
        fill = zip(roots, UNIT, strict=True)
        roots = CofactorRoots(*(places(root, unit) for root, unit in fill))
    fields = [
        *map(places, coordinates),
        places(sigma, 1),
        places(mask),
        xp.array(left),
        xp.array(right),
    ]
    return fields, roots, None if one.score is None else places(one.score, np.nan)


def stack(pairs: Sequence[Pair], points: int | None = None) -> Pair:
    """One batch of many single pairs, padded to the longest or to `points`. Raises
    ValueError for what is no list of single pairs, and for more points."""
    pairs = list(pairs)
    if not pairs:
        raise ValueError("stack: no pairs given")
    if any(one.x_left.ndim != 1 for one in pairs):
        raise ValueError(
            "stack: single pairs are wanted, got a batch (pair, point): take it apart "
            "with unstack"
        )
    if any(one.roots is not None for one in pairs):
        pairs = [with_roots(one) for one in pairs]
    if any(one.score is not None for one in pairs):
        pairs = [with_score(one) for one in pairs]
    longest = max(one.x_left.shape[-1] for one in pairs) if points is None else points
    xp = _library(pairs)
    rows = [_pad_fields(one, longest, xp) for one in pairs]
    return _as_pair(*jax.tree.map(lambda *fields: xp.stack(fields), *rows))


def unstack(batch: Pair) -> list[Pair]:
    """The single pairs of a batch, padding left in place. Raises ValueError for a
    single pair."""
    if batch.x_left.ndim < 2:
        raise ValueError(
            "unstack: a batch of pairs (pair, point) is wanted, got one pair"
        )
    if not is_traced(batch):
        batch = jax.tree.map(np.array, batch)  # what is made of it keeps its memory
    every = range(batch.x_left.shape[0])
    rows = [jax.tree.map(lambda a, i=i: a[i], batch) for i in every]
    return [row if is_traced(row) else jax.device_put(row) for row in rows]


def swapped(one: Pair) -> Pair:
    """The same pair with left and right exchanged."""
    return Pair(
        x_left=one.x_right,
        y_left=one.y_right,
        x_right=one.x_left,
        y_right=one.y_left,
        sigma=one.sigma,
        mask=one.mask,
        focal_left=one.focal_right,
        focal_right=one.focal_left,
        roots=None if one.roots is None else one.roots.swapped(),
        score=one.score,
    )


WIDEST = 1e9
"""Coordinate over focal length from which it is no measurement: its ray is at right
angles to the axis."""

SCALE = 1e30
"""Focal lengths and standard deviations above this or below its inverse are no numbers
in any unit: powers of them overflow."""


def mask_unusable(one: Pair) -> tuple[Pair, Bool[Array, "*pairs"]]:
    """The pair with points that are not finite masked and zeroed, and whether anything
    had to be left out.

    Masked points are set to zero coordinates and unit cofactors whatever they held, so that
    nothing they hold can reach a result or a derivative. What is out of all proportion
    (WIDEST, SCALE) counts as not finite: its squares would not be.
    """
    fair = lambda positive: (positive > 1 / SCALE) & (positive < SCALE)
    focals = [one.focal_left, one.focal_right]
    focal_ok = [fair(f) for f in focals]
    finite = fair(one.sigma)
    if one.roots is not None:
        finite = finite & one.roots.fair
    for c, f in zip(
        one.coordinates, (focals[0], focals[0], focals[1], focals[1]), strict=True
    ):
        finite = finite & (jnp.abs(c) < WIDEST * jnp.minimum(f, SCALE)[..., None])
    use = one.mask & finite
    bad = (count(one.mask & ~finite) > 0) | ~focal_ok[0] | ~focal_ok[1]
    roots = one.roots
    if roots is not None:
        fill = zip(roots, UNIT, strict=True)
        roots = CofactorRoots(*(jnp.where(use, root, unit) for root, unit in fill))
    repaired = Pair(
        *(jnp.where(use, c, 0.0) for c in one.coordinates),
        jnp.where(use, one.sigma, 1.0),
        use,
        *(jnp.where(ok, f, 1.0) for ok, f in zip(focal_ok, focals, strict=True)),
        roots,
        one.score,
    )
    return repaired, bad
