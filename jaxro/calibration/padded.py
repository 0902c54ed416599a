"""Models as arrays of the same shapes, so that one compiled program adjusts them all.

A parameter that a model does not have is fixed at its value by a very small a priori
variance.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..camera.area import Area
from ..camera.brown import COEFFICIENTS
from ..camera.condition import Camera
from ..camera.field import MODES
from .images import Frame, Pair, Places
from .known import Known, prior
from .models import Model, field_weights, imitating, parameter_weights
from .problem import FIXED, Prior


class Size(NamedTuple):
    """How many focal lengths, and coefficients of a field, all models have."""

    focals: int
    modes: int


class Padded(eqx.Module):
    """A model as arrays of the same shapes for all models: weights of the focal lengths
    and of the field, what is known beforehand, the camera to start from, the strength
    of the field and the number of other unknowns."""

    focal: Float[Array, "point 2 parameter"]
    field: Float[Array, "point 2 mode"]
    prior: Prior
    camera: Camera
    strength: Float[Array, ""]
    unknowns: Float[Array, ""]


class Common(eqx.Module):
    """What all models of an image share: the places, the measured area, what is known,
    the units, the standard deviation of a place in them, and the first focal length and
    principal place."""

    places: Places
    area: Area
    known: Known
    frame: Frame
    sigma: Float[Array, ""]
    focal: Float[Array, ""]
    principal: Pair


def pad(models: Sequence[Model], common: Common) -> list[Padded]:
    """Every model with as many parameters as the largest of them."""
    size = size_of(models)
    # many models share their zones, and fields that differ in their strength alone have
    # the same columns
    zones, columns = {}, {}
    for model in models:
        if (own := _zones_of(model)) not in zones:
            zones[own] = _focals(model, common)
        if (own := _columns_of(model)) not in columns:
            columns[own] = _columns(model, size, common)
    return [
        _pad(m, size, zones[_zones_of(m)], columns[_columns_of(m)], common)
        for m in models
    ]


def pad_one(model: Model, size: Size, common: Common) -> Padded:
    """One model with as many parameters as `size` says."""
    focals, columns = _focals(model, common), _columns(model, size, common)
    return _pad(model, size, focals, columns, common)


def size_of(models: Sequence[Model]) -> Size:
    """The `Size` of the largest of these models."""
    fields = any(model.field is not None for model in models)
    focals = max(model.focals - model.imitated for model in models)
    return Size(focals, 2 * MODES if fields else 0)


class _Focals(NamedTuple):
    """The focal lengths of a model: their weights at the places, and of which
    parameters they are made (`imitating`)."""

    weights: Float[Array, "point 2 parameter"]
    basis: Float[Array, "zone parameter"]


def _zones_of(model: Model) -> tuple:
    """What the focal lengths of a model depend on."""
    return model.x, model.y


def _focals(model: Model, common: Common) -> _Focals:
    basis = imitating(model, common.area)
    weights = parameter_weights(model, common.places, common.area, basis)
    return _Focals(weights, basis)


def _columns_of(model: Model) -> tuple | None:
    """What the columns of a model's field depend on."""
    return None if model.field is None else (model.field.length, model.brown)


def _columns(model: Model, size: Size, common: Common) -> Array:
    if model.field is None:
        return jnp.zeros((len(common.places), 2, size.modes))
    return field_weights(model, common.places, common.area)


def _pad(
    model: Model, size: Size, focals: _Focals, field: Array, common: Common
) -> Padded:
    focal, basis = focals
    camera = Camera(
        principal=common.principal,
        focal=common.focal * jnp.sum(basis, axis=0),
        brown=jnp.zeros(COEFFICIENTS),
        field=jnp.zeros(size.modes),
    )
    known = prior(model, camera, common.known, common.frame, common.sigma, basis)
    missing = size.focals - focal.shape[2]
    fixed = (FIXED * common.sigma) ** 2
    strength = 1.0 if model.field is None else model.field.strength
    return Padded(
        focal=jnp.pad(focal, ((0, 0), (0, 0), (0, missing))),
        field=field,
        prior=Prior(
            _with_focals(known.value, missing, jnp.zeros(())),
            _with_focals(known.variance, missing, fixed),
        ),
        camera=_with_focals(camera, missing, jnp.zeros(())),
        strength=jnp.asarray(strength, float),
        unknowns=jnp.asarray(model.unknowns, float),
    )


def _with_focals(camera: Camera, missing: int, value: Float[Array, ""]) -> Camera:
    """The camera with more focal lengths, all of this value."""
    more = jnp.broadcast_to(value, (missing,))
    return eqx.tree_at(lambda c: c.focal, camera, jnp.concatenate([camera.focal, more]))
