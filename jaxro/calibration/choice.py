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
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..adjustment import RESULTS, JointAdjustment, symmetric
from ..camera.area import Area
from ..camera.brown import Brown
from ..camera.condition import Rays, perspective
from ..camera.field import Field
from ..camera.zones import Whole
from ..xla.passes import count
from ..xla.programs import compiled
from .calibrate import by_size, calibrate, first_start, observe
from .images import MeasuredImage, frame
from .known import NOTHING, Known
from .models import Model
from .padded import Common, Padded, pad
from .problem import solve
from .result import Calibration
from .starts import Start

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


def default_models(rays: Rays = perspective) -> tuple[Model, ...]:
    """The `plain_models`, and a displacement field of several lengths and strengths,
    alone and with Brown's lens."""
    fields = [
        Model(brown=lens, field=Field(length, strength))
        for lens in (None, Brown())
        for length in LENGTHS
        for strength in STRENGTHS
    ]
    models = [*plain_models(), *fields]
    return tuple(dataclasses.replace(model, rays=rays) for model in models)


def plain_models() -> list[Model]:
    """One focal length; two; Brown's lens with one, two or three radial coefficients
    and with all."""
    square = {"affinity": False, "shear": False}
    lenses = [Brown(k, tangential=False, **square) for k in (1, 2, 3)]
    lenses += [Brown(2, **square), Brown(3, **square), Brown(shear=False), Brown()]
    return [Model(), Model(y=Whole()), *(Model(brown=lens) for lens in lenses)]


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
    first = first_start(measured, known, rays=rays)
    return Comparison(models, _compare(measured, known, first, models=models))


def choose(
    measured: MeasuredImage,
    models: Sequence[Model] | None = None,
    known: Known = NOTHING,
) -> tuple[Calibration, Comparison]:
    """The calibration by the model with the greatest evidence, and the comparison that
    it comes from."""
    found = compare(measured, models, known)
    return calibrate(measured, found.best, known), found


@compiled(settings=by_size, static=("models",))
def _compare(
    measured: MeasuredImage, known: Known, first: Start, *, models: tuple[Model, ...]
) -> Figures:
    number = 2 * count(measured.mask)
    read = lambda found, padded, sigma: assess(found, padded, sigma, number)
    return adjust_models(measured, known, first, models, read)


def adjust_models(
    measured: MeasuredImage,
    known: Known,
    first: Start,
    models: tuple[Model, ...],
    read: Callable[[JointAdjustment, Padded, Float[Array, ""]], Any],
) -> Any:
    """What `read` takes from the adjustment of one image by each model and from the
    standard deviation of a place in the units of the frame."""
    given = frame(measured, first.handedness)
    observed = observe(measured, given)
    common = Common(
        places=observed.places,
        area=Area(observed.places, measured.mask, given.half_sides, first.principal),
        known=known,
        frame=given,
        sigma=observed.sigma,
        focal=first.focal,
        principal=first.principal,
    )

    def adjust(one: Padded) -> Any:
        start, rays = (first.station, one.camera), models[0].rays
        found = solve(observed, one.focal, one.field, one.prior, rays, start)
        return read(found, one, observed.sigma)

    every = jax.tree.map(lambda *a: jnp.stack(a), *pad(models, common))
    # one after the other: together they would all wait for the slowest
    return jax.lax.map(adjust, every)


def assess(
    found: JointAdjustment,
    padded: Padded,
    sigma: Float[Array, ""],
    number: Float[Array, ""],
) -> Figures:
    """The figures of one adjustment; `number`: of coordinates, less the coordinates of
    the points that were eliminated."""
    modes, cameras = padded.field.shape[2], found.layout["camera"].members
    squares: Array = sum(jnp.sum(r**2) for r in found.residuals)  # pyright: ignore[reportAssignmentType]
    at = fields_of(found, modes)
    own = found.normal_matrix[jnp.ix_(at, at)]
    score = evidence(squares, own, padded.strength * sigma, number)
    score = score + cameras * padded.unknowns * jnp.log(number)
    redundancy = found.redundancy[0]
    apart = found.residuals[0] / jnp.where(redundancy > 0, redundancy, 1.0)
    used = jnp.sum(jnp.where(redundancy > 0, 1.0, 0.0))
    settled = found.result == RESULTS.successful
    usable = settled & jnp.isfinite(score) & (found.degrees_of_freedom > 0)
    return Figures(
        score=jnp.where(usable, score, jnp.inf),
        sigma0=found.sigma0,
        left_out=jnp.sqrt(jnp.sum(apart**2) / jnp.maximum(used, 1.0)),
        effective=number - jnp.sum(redundancy),
        degrees_of_freedom=found.degrees_of_freedom,
    )


def evidence(
    squares: Float[Array, ""],
    own: Float[Array, "mode mode"],
    deviation: Float[Array, ""],
    number: Float[Array, ""],
) -> Float[Array, ""]:
    """N log(S / N) + log det(I + γ² AᵀA), from `own`, the normal matrix AᵀA + I/γ² of
    the field's coefficients, and their a priori standard deviation γ."""
    score = number * jnp.log(squares / number)
    if len(own) == 0:
        return score
    pivots = jnp.maximum(symmetric.inverse(own).pivots, jnp.finfo(own.dtype).tiny)
    return score + jnp.sum(jnp.log(pivots * jnp.diagonal(own) * deviation**2))


def fields_of(found: JointAdjustment, modes: int) -> Int[Array, " mode"]:
    """Where the coefficients of all fields stand in the normal matrix."""
    block = found.layout["camera"]
    places = found.layout.places("camera", jnp.arange(block.members))
    return places[:, block.size - modes :].reshape(-1)
