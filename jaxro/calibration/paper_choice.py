"""The number of zones that the paper chooses (Yurchenko 2002), to be compared with the
choice by evidence.

The paper adjusts every variant of zones and looks at the covariance matrix K of its five
elements (two tilts and the station) and the focal lengths of the zones, in two stages:

1. The trace Sp of K is compared with the least one, at a level of 3 %: variants that are
   worse are rejected. The text does not print the statistic; here it is Sp over the
   least Sp against Fisher's distribution. Both come from the same measurements, so that
   this is no F test: the level is not 3 %.
2. Of the rest, the variant with the least condition number COND(K) is taken, or with the
   least value of equation (2), whose formula is lost and is taken as

       COND / COND_min + mu Sp / Sp_min.

Both depend on the units of angles, lengths and focal lengths. In correlation form K is
scaled to a diagonal of 1 in stage two, which needs no units; its trace then is the
number of unknowns.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import RESULTS, JointAdjustment, critical_values
from ..adjustment.guarded import times
from ..camera.zones import (
    AbstractZones,
    Whole,
    rectangles,
    rings,
    strips_along_x,
    strips_along_y,
)
from ..xla.passes import count
from ..xla.programs import compiled
from .calibrate import by_size, first_start
from .choice import Figures, adjust_models, assess
from .images import MeasuredImage, frame
from .known import NOTHING, Known
from .models import Model
from .padded import Padded
from .starts import Start

LEVEL = 0.03
"""The paper's level of stage one."""

POWERS_OF_UNITS = (1e-3, 1.0, 1e3)
"""Other units that are tried: of angles, of lengths, of focal lengths."""


class Units(NamedTuple):
    """How many units of K one radian, one unit of the object and one unit of the image
    are: with objects in m and images in mm, `Units(1000.0, 1000.0, 1.0)` stands for
    mrad and mm."""

    angle: float = 1.0
    length: float = 1.0
    focal: float = 1.0


AS_MEASURED = Units()
"""Radians, the unit of the object and that of the image."""


class Picks(NamedTuple):
    """The numbers of the models that the rules of stage two take."""

    condition: int
    equation_2: int
    condition_of_correlations: int
    equation_2_of_correlations: int


class PaperChoice(NamedTuple):
    """All variants, what the paper looks at, and what its rules take.

    `traces` and `conditions` of K in the units that were given, and the
    `correlation_conditions`; NaN where a variant cannot be adjusted. `kept`: after
    stage one. `by_score`: the number of the model that evidence takes.
    `depends_on_units`: whether other units (factors of 1,000) change a pick of the two
    rules that have units; the pick then says nothing of the image.
    """

    models: tuple[Model, ...]
    degrees_of_freedom: Int[np.ndarray, " model"]
    sigma0: Float[np.ndarray, " model"]
    traces: Float[np.ndarray, " model"]
    conditions: Float[np.ndarray, " model"]
    correlation_conditions: Float[np.ndarray, " model"]
    score: Float[np.ndarray, " model"]
    kept: Bool[np.ndarray, " model"]
    picks: Picks
    by_score: int
    depends_on_units: bool


def paper_models() -> tuple[Model, ...]:
    """Strips along x and along y, rectangles and rings about the centroid, up to nine
    zones, each with one focal length a zone, and with two."""
    zones: list[AbstractZones] = [Whole()]
    zones += [strips_along_x(k) for k in (2, 3, 4)]
    zones += [strips_along_y(k) for k in (2, 3, 4)]
    zones += [rectangles(a, b) for a, b in product((2, 3), (2, 3))]
    zones += [rings(k, about_centroid=True) for k in (2, 3)]
    return tuple(Model(x=x, y=y) for x in zones for y in (None, x))


def choose_as_paper(
    measured: MeasuredImage,
    models: Sequence[Model] | None = None,
    known: Known = NOTHING,
    *,
    units: Units = AS_MEASURED,
    mu: float = 1.0,
) -> PaperChoice:
    """What the paper's two stages take of these models; `mu`: its equalising
    coefficient. Focal lengths that change linearly enter K without the combinations
    that imitate a tilt.

    Raises ValueError for models of more than focal lengths or of different rays, and
    RuntimeError where no model can be adjusted.
    """
    models = paper_models() if models is None else tuple(models)
    if any(model.brown is not None or model.field is not None for model in models):
        raise ValueError("choose_as_paper: a model has zones of focal lengths alone")
    rays = models[0].rays
    if any(model.rays is not rays for model in models):
        raise ValueError("choose_as_paper: all models have the same rays")
    first = first_start(measured, known, rays=rays)
    covariances, usable, figures = _adjust_all(measured, known, first, models=models)
    usable = np.asarray(usable)
    if not np.any(usable):
        raise RuntimeError(
            "choose_as_paper: no model can be adjusted; measure more points, or give "
            "models with fewer zones"
        )
    # what failed is not finite, and is not looked at
    covariances = np.where(
        usable[:, None, None], covariances, np.eye(covariances.shape[1])
    )
    every = list(map(_of_paper, covariances, models))
    freedom = np.asarray(figures.degrees_of_freedom)
    table = [_rules(every, usable, freedom, each, mu) for each in _other_units(units)]
    own, others = table[0], table[1:]
    nan = lambda a: np.where(usable, a, np.nan)
    return PaperChoice(
        models=models,
        degrees_of_freedom=freedom,
        sigma0=np.asarray(figures.sigma0),
        traces=nan(own.traces),
        conditions=nan(own.conditions),
        correlation_conditions=nan(own.correlation_conditions),
        score=np.asarray(figures.score),
        kept=own.kept,
        picks=own.picks,
        by_score=int(np.argmin(figures.score)),
        depends_on_units=any(other.picks[:2] != own.picks[:2] for other in others),
    )


def _other_units(units: Units) -> list[Units]:
    """The units given, and all others."""
    factors = product(POWERS_OF_UNITS, repeat=3)
    others = [Units(*np.multiply(units, factor).tolist()) for factor in factors]
    return [units, *others]


def _of_paper(covariance: np.ndarray, model: Model) -> Float[np.ndarray, "p p"]:
    """K: of two tilts, the station and the focal lengths, in radians, units of the
    object and of the image. Swing and principal place are not among them."""
    focals = 8 + np.arange(model.focals - model.imitated)
    chosen = np.concatenate([[0, 1, 3, 4, 5], focals])
    return covariance[np.ix_(chosen, chosen)]


class _Rules(NamedTuple):
    traces: np.ndarray
    conditions: np.ndarray
    correlation_conditions: np.ndarray
    kept: np.ndarray
    picks: Picks


def _rules(
    every: Sequence[np.ndarray],
    usable: np.ndarray,
    freedom: np.ndarray,
    units: Units,
    mu: float,
) -> _Rules:
    """Both stages, with K in these units."""
    scaled = [_in_units(k, units) for k in every]
    traces = np.array([np.trace(k) for k in scaled])
    conditions = np.array([_condition(k) for k in scaled])
    of_correlations = np.array([_condition(_correlations(k)) for k in scaled])
    sizes = np.array([float(len(k)) for k in scaled])
    kept = _stage_one(traces, usable, freedom)
    picks = Picks(
        _least(conditions, kept),
        _least(_equation_2(conditions, traces, kept, mu), kept),
        _least(of_correlations, kept),
        _least(_equation_2(of_correlations, sizes, kept, mu), kept),
    )
    return _Rules(traces, conditions, of_correlations, kept, picks)


def _in_units(k: np.ndarray, units: Units) -> np.ndarray:
    focals = len(k) - 5
    factors = np.repeat(units, [2, 3, focals])
    return k * np.outer(factors, factors)


def _stage_one(
    traces: np.ndarray, usable: np.ndarray, freedom: np.ndarray
) -> Bool[np.ndarray, " model"]:
    """Which variants are not worse than the best at the paper's level."""
    traces = np.where(usable, traces, np.inf)
    best = _least(traces, usable)
    limit = critical_values.fisher(LEVEL, np.maximum(freedom, 1), freedom[best])
    return usable & (traces <= traces[best] * np.asarray(limit))


def _equation_2(
    conditions: np.ndarray, traces: np.ndarray, kept: np.ndarray, mu: float
) -> np.ndarray:
    """Equation (2) of the paper, relative to the least values of those that are kept;
    infinite for the others."""
    of_kept = lambda a: np.where(kept, a / a[kept].min(), np.inf)
    return of_kept(conditions) + mu * of_kept(traces)


def _condition(k: np.ndarray) -> float:
    """The largest eigenvalue over the smallest; at most what rounding can tell."""
    values = np.linalg.eigvalsh(k)
    least = np.finfo(float).eps * values[-1]
    return float(values[-1] / max(values[0], least))


def _correlations(k: np.ndarray) -> np.ndarray:
    deviations = np.sqrt(np.maximum(np.diagonal(k), np.finfo(float).tiny))
    return k / np.outer(deviations, deviations)


def _least(values: np.ndarray, among: np.ndarray) -> int:
    """The number of the least value among some."""
    return int(np.argmin(np.where(among, values, np.inf)))


@compiled(settings=by_size, static=("models",))
def _adjust_all(
    measured: MeasuredImage, known: Known, first: Start, *, models: tuple[Model, ...]
) -> tuple[Float[Array, "model p p"], Bool[Array, " model"], Figures]:
    """Of every model the covariance of all parameters in the units of object and image,
    whether it can be used, and its figures."""
    given = frame(measured, first.handedness)
    number = 2 * count(measured.mask)

    def read(found: JointAdjustment, padded: Padded, sigma: Array):
        settled = found.result == RESULTS.successful
        covariance = times(found.cofactor, found.sigma0**2)
        figures = assess(found, padded, sigma, number)
        return covariance, settled & (found.degrees_of_freedom > 0), figures

    covariances, usable, figures = adjust_models(measured, known, first, models, read)
    camera = covariances.shape[1] - 6
    units = jnp.concatenate(
        [
            jnp.ones(3),
            jnp.broadcast_to(given.length, (3,)),
            jnp.broadcast_to(given.size, (camera,)),
        ]
    )
    return covariances * (units[:, None] * units[None])[None], usable, figures
