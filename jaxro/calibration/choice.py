"""Which model an image needs: all of them are adjusted in one compiled program, and the
evidence decides.

    -2 log evidence = N log(S / N) + log det(I + γ² AᵀA) + d log N

N coordinates, S the sum of squares of residuals and of the field's coefficients, A the
columns of the field, d the number of other unknowns. Without a field this is the
criterion of Schwarz (1978), BIC; with one the field is integrated out, and every other
unknown counts as there. What a model is expected to be wrong by is told by leaving out
each coordinate in turn (`left_out`).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..adjustment import RESULTS, JointAdjustment, symmetric
from ..xla.passes import count
from ..xla.programs import Program
from ..xla.settings import MOMENT, settings_for
from .brown import Brown
from .calibrate import calibrate, first_start, observe
from .camera import Camera, Rays, perspective
from .field import MODES, Field
from .images import MeasuredImage, frame
from .known import NOTHING, Known, prior
from .models import Model, field_weights, imitating, parameter_weights
from .problem import FIXED, Observed, Prior, solve
from .result import Calibration
from .starts import Start
from .zones import Area, Whole

LENGTHS = (0.5, 0.8, 1.25)
"""Correlation lengths of the fields that are tried, in half sides of the area."""

STRENGTHS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Their strengths, in units of sigma."""


class Figures(NamedTuple):
    """What was found of each model, one after the other.

    `score`: -2 log evidence, the smaller the better; infinite where the adjustment
    failed. `left_out`: root mean square of the residuals of coordinates that were left
    out, in units of sigma. `effective`: unknowns, those of a field in part.
    """

    score: Float[Array, "*model"]
    sigma0: Float[Array, "*model"]
    left_out: Float[Array, "*model"]
    effective: Float[Array, "*model"]
    degrees_of_freedom: Int[Array, "*model"]


class Comparison(NamedTuple):
    """The models that were compared, and their figures."""

    models: tuple[Model, ...]
    figures: Figures

    @property
    def best(self) -> Model:
        """The model with the greatest evidence."""
        return self.models[int(np.argmin(np.asarray(self.figures.score)))]


class _Padded(eqx.Module):
    """A model as arrays of the same shapes for all models."""

    focal: Float[Array, "point 2 parameter"]
    field: Float[Array, "point 2 mode"]
    prior: Prior
    camera: Camera
    strength: Float[Array, ""]
    unknowns: Float[Array, ""]


def default_models(rays: Rays = perspective) -> tuple[Model, ...]:
    """One focal length; two; Brown's lens with one, two or three radial coefficients
    and with all; a displacement field of several lengths and strengths, alone and with
    Brown's lens."""
    square = {"affinity": False, "shear": False}
    lenses = [Brown(k, tangential=False, **square) for k in (1, 2, 3)]
    lenses += [Brown(2, **square), Brown(3, **square), Brown(shear=False), Brown()]
    plain = [Model(), Model(y=Whole()), *(Model(brown=lens) for lens in lenses)]
    fields = [
        Model(brown=lens, field=Field(length, strength))
        for lens in (None, Brown())
        for length in LENGTHS
        for strength in STRENGTHS
    ]
    return tuple(dataclasses.replace(model, rays=rays) for model in [*plain, *fields])


def compare(
    measured: MeasuredImage,
    models: Sequence[Model] | None = None,
    known: Known = NOTHING,
) -> Comparison:
    """Adjust one image by every model, in one program; they share their `rays`."""
    models = default_models() if models is None else tuple(models)
    rays = models[0].rays
    if any(model.rays is not rays for model in models):
        raise ValueError("compare: all models have the same rays")
    settings = settings_for(measured.mask.size, MOMENT)
    first = Program(first_start, {"rays": rays}, settings)((measured, known))
    program = Program(_compare, {"models": models}, settings)
    return Comparison(models, program((measured, known, first)))


def choose(
    measured: MeasuredImage,
    models: Sequence[Model] | None = None,
    known: Known = NOTHING,
) -> tuple[Calibration, Comparison]:
    """The calibration by the model with the greatest evidence, and the comparison that
    it comes from."""
    found = compare(measured, models, known)
    return calibrate(measured, found.best, known), found


def _compare(
    data: tuple[MeasuredImage, Known, Start], models: tuple[Model, ...]
) -> Figures:
    measured, known, first = data
    given = frame(measured, first.handedness)
    observed = observe(measured, given)
    area = Area(observed.places, measured.mask, given.half_sides, first.principal)
    most = max(model.focals for model in models)
    fields: dict = {}  # those that differ in their strength alone have the same columns

    def pad(model: Model) -> _Padded:
        basis = imitating(model, area)
        focal = parameter_weights(model, observed.places, area, basis)
        missing = most - focal.shape[2]
        none = model.field is None
        key = None if model.field is None else (model.field.length, model.brown)
        if key not in fields:
            columns = jnp.zeros((len(observed.places), 2, 2 * MODES))
            fields[key] = (
                columns if none else field_weights(model, observed.places, area)
            )
        strength = 1.0 if model.field is None else model.field.strength
        camera = Camera(
            principal=first.principal,
            focal=first.focal * jnp.sum(basis, axis=0),
            brown=jnp.zeros(7),
            field=jnp.zeros(2 * MODES),
        )
        beforehand = prior(model, camera, known, given, observed.sigma, basis)
        fixed = (FIXED * observed.sigma) ** 2
        longer = lambda a, value: jnp.pad(a, (0, missing), constant_values=value)
        at_focal = lambda c: c.focal
        value = eqx.tree_at(
            at_focal, beforehand.value, longer(beforehand.value.focal, 0.0)
        )
        variance = eqx.tree_at(
            at_focal,
            beforehand.variance,
            jnp.concatenate(
                [beforehand.variance.focal, jnp.broadcast_to(fixed, (missing,))]
            ),
        )
        return _Padded(
            focal=jnp.pad(focal, ((0, 0), (0, 0), (0, missing))),
            field=fields[key],
            prior=Prior(value, variance),
            camera=eqx.tree_at(at_focal, camera, longer(camera.focal, 0.0)),
            strength=jnp.asarray(strength, float),
            unknowns=jnp.asarray(model.unknowns, float),
        )

    def adjust(padded: _Padded) -> Figures:
        found = solve(
            observed,
            padded.focal,
            padded.field,
            padded.prior,
            models[0].rays,
            (first.station, padded.camera),
        )
        return _assess(found, padded, observed)

    every = jax.tree.map(lambda *a: jnp.stack(a), *map(pad, models))
    return jax.vmap(adjust)(every)


def _assess(found: JointAdjustment, padded: _Padded, observed: Observed) -> Figures:
    """The figures of one adjustment."""
    number = 2 * count(observed.mask)
    squares = sum(jnp.sum(r**2) for r in found.residuals)
    begin = found.normal_matrix.shape[0] - padded.field.shape[2]
    own = found.normal_matrix[begin:, begin:]
    pivots = symmetric.inverse(own).pivots
    variance = (padded.strength * observed.sigma) ** 2
    tiny = jnp.finfo(pivots.dtype).tiny
    logs = jnp.log(jnp.maximum(pivots, tiny)) + jnp.log(jnp.diagonal(own) * variance)
    score = number * jnp.log(squares / number) + jnp.sum(logs)
    score = score + padded.unknowns * jnp.log(number)
    redundancy = found.redundancy[0]
    apart = found.residuals[0] / jnp.where(redundancy > 0, redundancy, 1.0)
    settled = found.result == RESULTS.successful
    usable = settled & jnp.isfinite(score) & (found.degrees_of_freedom > 0)
    return Figures(
        score=jnp.where(usable, score, jnp.inf),
        sigma0=found.sigma0,
        left_out=jnp.sqrt(jnp.sum(apart**2) / number),
        effective=number - jnp.sum(redundancy),
        degrees_of_freedom=found.degrees_of_freedom,
    )
