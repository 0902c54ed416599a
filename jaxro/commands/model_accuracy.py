"""Standard deviations of the model points of a table, and what their errors share."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..adjustment.critical_values import trusted_sigma0
from ..batches.buckets import map_ragged
from ..batches.padding import Plan
from ..batches.ragged import Ragged
from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    RelativePose,
    convert,
)
from ..geometry.pairs import Pair
from ..orientation.model_errors import Derivatives, differentiate, root
from ..reports.columns import COMMON, OWN
from ..xla.programs import compiled
from ..xla.settings import MOMENT, settings_for
from .solve import Found, Task


class Posed(NamedTuple):
    """A pair, its pose, and the base of its elements; batches have leading axes."""

    pair: Pair
    pose: Float[Any, "*pairs 7"]
    base: Float[Any, "*pairs"]

    @property
    def x_left(self) -> Float[Any, "*pairs point"]:
        """Of the pair, by which batches are split."""
        return self.pair.x_left


class Differentiator(NamedTuple):
    """differentiate(posed) -> its `Derivatives` in the elements of this system."""

    system: type[AbstractElements]

    def __call__(self, posed: Posed) -> Derivatives:
        """The derivatives."""
        pose = RelativePose(*posed.pose)
        return differentiate(posed.pair, convert(pose, self.system, posed.base))


@compiled(settings=lambda one, **_: settings_for(one.x_left.size, MOMENT))
def _of_one(posed: Posed, *, of: Differentiator) -> Derivatives:
    return of(posed)


def add_model_errors(
    pairs: Ragged, found: Found, task: Task, plan: Plan | None
) -> Found:
    """What is found of the pairs with the `model_errors` of their points, where there are
    points, of which a least squares orientation tells."""
    if task.residual != "rigorous" or "points" not in found.of_points:
        return found
    points = found.of_points["points"]
    errors = model_errors(
        pairs, found.of_pairs, points, task.system, task.sigma_known, plan
    )
    return found._replace(of_points=found.of_points | {"points": points | errors})


def model_errors(
    pairs: Ragged,
    of_pairs: dict[str, Any],
    model: dict[str, np.ndarray],
    system: type[AbstractElements],
    sigma_known: bool,
    plan: Plan | None,
) -> dict[str, np.ndarray]:
    """Columns of the model points: standard deviations of X, Y and Z, the root of the
    covariance that each point has for itself, and what all points of a pair share: the
    derivatives by the elements times the root of their covariance. With the estimated
    sigma0 unless `sigma_known`, whose standard deviations hold where sigma0 may be 1;
    NaN where there is none, or no point. `model`: X, Y, Z."""
    base = (
        of_pairs["bx"] if system is DependentElements else np.ones(len(pairs.lengths))
    )
    of = Differentiator(system)

    def batch_of(members: np.ndarray, size: int) -> Posed:
        pose = of_pairs["pose"][members]
        return Posed(pairs.pad_to(members, size), pose, base[members])

    if plan is None:
        one = batch_of(np.zeros(1, int), len(pairs.x_left))
        found = _of_one(jax.tree.map(lambda a: a[0], one), of=of)
    else:
        found = map_ragged(of, pairs, batch_of, plan)
    at, by_elements, own = map(np.asarray, found)
    scale = _scale(pairs, at, np.stack([model[axis] for axis in "XYZ"], axis=1))
    sigma0, freedom = of_pairs["sigma0"], of_pairs["degrees_of_freedom"]
    if sigma_known:
        sigma0 = trusted_sigma0(sigma0, freedom)
    known = np.repeat(np.asarray(sigma0) * scale, pairs.lengths)
    cofactor = np.repeat(root(of_pairs["cofactor"]), pairs.lengths, axis=0)
    common = known[:, None, None] * (by_elements @ cofactor)
    alone = known[:, None, None] * root(own @ np.swapaxes(own, 1, 2))
    variances = np.sum(common**2, axis=2) + np.sum(alone**2, axis=2)
    columns = dict(zip(("sX", "sY", "sZ"), np.sqrt(variances).T, strict=True))
    rows, places = np.tril_indices(3)
    columns |= dict(zip(OWN, alone[:, rows, places].T, strict=True))
    return columns | dict(zip(COMMON, common.reshape(-1, 15).T, strict=True))


def _scale(
    pairs: Ragged, at: Float[np.ndarray, "row 3"], model: Float[np.ndarray, "row 3"]
) -> Float[np.ndarray, " pair"]:
    """How much larger the model of each pair is than where its points are `at`."""
    there = np.all(np.isfinite(at) & np.isfinite(model), axis=1)[:, None]
    product = lambda a, b: np.add.reduceat(
        np.sum(np.where(there, a * b, 0.0), axis=1), pairs.begins[:-1]
    )
    size = product(at, at)
    return product(at, model) / np.where(size > 0, size, np.nan)
