"""Which model several images need together: the lens by the criterion of Schwarz, the
strength of a displacement field by the evidence (`choice`).

One compiled program adjusts all models, one after another, each from the solution of
the one before. The strength γ of a field enters the linear problem at a solution as the
weights of its coefficients alone, so that one adjustment tells the evidence of all
strengths: with N, the normal matrix at γ0, D = (1/γ² - 1/γ0²) / sigma² at the places of
the coefficients a, and S0, the sum of squares,

    S(γ) = S0 + aᵀ D a - (D a)ᵀ (N + D)⁻¹ (D a)

The adjustment is repeated with the best strength until this is the one it had.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..adjustment import JointAdjustment, symmetric
from ..camera.brown import Brown
from ..camera.condition import Camera
from ..camera.field import Field
from ..xla.passes import count
from ..xla.programs import compiled
from .choice import Comparison, Figures, assess, evidence, fields_of, plain_models
from .known import NOTHING, Known
from .measured_images import MeasuredImages
from .models import Model
from .padded import Common, Padded, pad_one, size_of
from .problem_together import Approximate, approximate, solve_together
from .together import Together, calibrate_together

LENGTHS = (0.5, 0.8)
"""Correlation lengths of the fields that are tried, in half sides of the area."""

STRENGTHS = tuple(np.geomspace(0.01, 1000.0, 21).tolist())
"""Strengths of the fields that are told apart, in units of sigma."""

ROUNDS = 4
"""Adjustments by which the strength of a field is found."""


class Tried(NamedTuple):
    """One adjustment: its figures, the scores of all `STRENGTHS`, and where the next
    one can begin."""

    figures: Figures
    scores: Float[Array, " strength"]
    solution: Approximate


def models_of_cameras() -> tuple[Model, ...]:
    """The lenses of `default_models`, and displacement fields of several lengths, alone
    and with Brown's lens."""
    fields = [
        Model(brown=lens, field=Field(length, 1.0))
        for lens in (None, Brown())
        for length in LENGTHS
    ]
    return (*plain_models(), *fields)


def choose_together(
    measured: MeasuredImages,
    models: Sequence[Model] | None = None,
    known: Known = NOTHING,
) -> tuple[Together, Comparison]:
    """The calibration of several images by the model with the greatest evidence, and
    the comparison that it comes from.

    The strength of each field is found; the one that a model is given with is where the
    search begins. All models share their rays, and have no zones of focal lengths that
    change linearly.
    """
    compared = compare_together(measured, models, known)
    return calibrate_together(measured, compared.best, known), compared


def compare_together(
    measured: MeasuredImages,
    models: Sequence[Model] | None = None,
    known: Known = NOTHING,
) -> Comparison:
    """The adjustment of several images by every model, with the strength that has the
    greatest evidence."""
    models = models_of_cameras() if models is None else tuple(models)
    if any(model.rays is not models[0].rays or model.imitated for model in models):
        raise ValueError(
            "compare_together: all models have the same rays, and no focal lengths that "
            "change linearly"
        )
    # one program for all strengths
    alike = tuple(_with_strength(model, 1.0) for model in models)
    begin = compiled(approximate)(measured, rays=models[0].rays)
    found, figures = [], []
    for k, model in enumerate(models):
        strength = 1.0 if model.field is None else float(model.field.strength)
        for _ in range(ROUNDS):
            tried = adjust_model(measured, known, begin, k, strength, models=alike)
            if np.isfinite(tried.figures.score):
                begin = tried.solution
            best = STRENGTHS[int(np.nanargmin(tried.scores))]
            if model.field is None or best == strength:
                break
            strength = best
        found.append(_with_strength(model, strength))
        figures.append(tried.figures)
    return Comparison(tuple(found), jax.tree.map(lambda *a: np.stack(a), *figures))


def _with_strength(model: Model, strength: Float[Array, ""] | float) -> Model:
    if model.field is None:
        return model
    return dataclasses.replace(model, field=Field(model.field.length, strength))


@compiled(static=("models",))
def adjust_model(
    measured: MeasuredImages,
    known: Known,
    begin: Approximate,
    k: Int[Array, ""],
    strength: Float[Array, ""],
    *,
    models: tuple[Model, ...],
) -> Tried:
    """The adjustment by model number k, its field of the strength given."""
    common = Common(
        places=begin.places,
        area=begin.area,
        known=known,
        frame=begin.frame,
        sigma=begin.sigma,
        focal=jnp.ones(()),
        principal=jnp.zeros(2),
    )
    size = size_of(models)
    models = tuple(_with_strength(model, strength) for model in models)
    padded = jax.lax.switch(k, [partial(pad_one, m, size, common) for m in models])
    free = jnp.isinf(padded.prior.variance.brown)
    cameras = Camera(
        principal=begin.cameras.principal,
        focal=begin.cameras.focal * padded.camera.focal[None],
        brown=jnp.where(free[None], begin.cameras.brown, 0.0),
        field=jnp.zeros((measured.cameras, size.modes)),
    )
    found = solve_together(
        measured,
        begin,
        padded.focal,
        padded.field,
        padded.prior,
        models[0].rays,
        {"station": begin.stations, "camera": cameras, "point": begin.points},
    )
    unknown = count(~jnp.all(jnp.isfinite(measured.point_sigma), axis=1))
    number = 2.0 * len(measured.places) - 3 * unknown
    solved = found.parameters["camera"]
    cameras = Camera(
        principal=solved.principal,
        focal=solved.focal[:, :1],
        brown=solved.brown,
        field=solved.field[:, :0],
    )
    solution = eqx.tree_at(
        lambda a: (a.stations, a.cameras, a.points),
        begin,
        (found.parameters["station"], cameras, found.parameters["point"]),
    )
    with_field = jnp.array([model.field is not None for model in models])[k]
    scores = jax.lax.cond(
        with_field,
        lambda: _scores(found, padded, begin.sigma, number),
        lambda: jnp.zeros(len(STRENGTHS)),
    )
    return Tried(
        figures=assess(found, padded, begin.sigma, number),
        scores=scores,
        solution=solution,
    )


def _scores(
    found: JointAdjustment,
    padded: Padded,
    sigma: Float[Array, ""],
    number: Float[Array, ""],
) -> Float[Array, " strength"]:
    """-2 log evidence of the `STRENGTHS`, from the linear problem at the solution."""
    modes = padded.field.shape[2]
    if modes == 0:
        return jnp.zeros(len(STRENGTHS))
    at = fields_of(found, modes)
    a = found.parameters["camera"].field.reshape(-1)
    squares = sum(jnp.sum(r**2) for r in found.residuals)
    of_strength = lambda strength: 1 / (strength * sigma) ** 2

    def score(strength: Float[Array, ""]) -> Float[Array, ""]:
        more = of_strength(strength) - of_strength(padded.strength)
        n = found.normal_matrix.at[at, at].add(more)
        pull = jnp.zeros(len(n)).at[at].set(more * a)
        step = symmetric.inverse(n).matrix @ pull
        sum_ = squares + more * jnp.sum(a * a) - jnp.sum(pull * step)
        return evidence(sum_, n[jnp.ix_(at, at)], strength * sigma, number)

    return jax.lax.map(score, jnp.asarray(STRENGTHS))
