"""The classical adjustment of independent models: the coordinates of points and
projection centres in models are taken for measurements,

    s R x + T - X = v,    Σ vᵀ P v = min

with seven parameters of each model and the ground coordinates X unknown. Its normal
equations claim standard deviations that are not those of its results: coordinates of a
model are correlated, and two models share the places on their common photo. The true
ones follow from the covariance of these places, through the relative orientations and
through this estimator.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..adjustment import RESULTS, Term
from ..adjustment.sparse import SparseAdjustment, adjust_sparse
from ..geometry.camera_axes import SIGNS
from ..xla.programs import compiled
from .classical_models import ModelCoordinates
from .measured_block import Ground
from .network import Frame, KnownCoordinates, Start, frame_of, known_of, of_coordinate
from .similarity import Similarity

MOST = 3000
"""Unknowns up to which the true deviations are computed: their matrices are dense."""


DATUM = 7
"""Known coordinates that models need."""


def of_tie(
    model: Similarity, point: Float[Array, "3"], tie: tuple[Array, Array]
) -> Float[Array, "3"]:
    """The misfit of a point of a model, in the system of the ground; a tie has its
    coordinates in the model, and the error of its place on the ground."""
    at, error = tie
    return model.to_ground(at) + error - point


@dataclass(frozen=True)
class ClassicalAdjustment:
    """Independent models on the ground. Coordinates and deviations are those of all
    points of the block and, behind them, of all projection centres; NaN for those that
    are in no model."""

    models: ModelCoordinates
    ground: Ground
    frame: Frame
    known: KnownCoordinates
    number: Int[np.ndarray, " both"]
    deviations: Float[np.ndarray, "row 3"]
    adjustment: SparseAdjustment

    @property
    def result(self) -> RESULTS:
        """How the adjustment ended."""
        return self.adjustment.result

    def check(self) -> "ClassicalAdjustment":
        """This adjustment; RuntimeError with advice where it is not usable."""
        if self.result != RESULTS.successful:
            raise RuntimeError(f"adjust_models: {RESULTS[self.result]}")
        return self

    @property
    def sigma0(self) -> float:
        """The standard deviation of what has the deviation 1."""
        return self.adjustment.sigma0

    @property
    def coordinates(self) -> Float[np.ndarray, "both 3"]:
        """Points and projection centres on the ground."""
        points = self.adjustment.parameters["point"]
        return self._spread(self.frame.outside(points))

    @property
    def claimed(self) -> Float[np.ndarray, "both 3"]:
        """The standard deviations that its own normal equations claim, with its own
        sigma0."""
        q = np.asarray(self.adjustment.cofactors["point"])
        of_axes = np.sqrt(np.diagonal(q, axis1=1, axis2=2))
        return self._spread(self.sigma0 * self.frame.length * of_axes)

    @cached_property
    def true(self) -> Float[np.ndarray, "both 3"]:
        """The standard deviations that its results have, from those of the places on
        photos and of the known coordinates. Raises ValueError for more than `MOST`
        unknowns."""
        from scipy.linalg import cho_factor, cho_solve

        models, known, length = self.models, self.known, self.frame.length
        begin = 7 * len(models.left)
        unknowns = begin + 3 * (int(self.number.max()) + 1)
        if unknowns > MOST:
            raise ValueError(
                f"classical: {unknowns} unknowns, the true deviations are computed for "
                f"at most {MOST}: take a part of the block"
            )
        ties, turns = self._slopes
        of_known = np.zeros((len(known.number), unknowns))
        column = begin + 3 * self.number[known.number] + known.axis
        of_known[np.arange(len(known.number)), column] = 1.0
        white = length / np.concatenate([self.deviations.ravel(), known.sigma])
        a = np.concatenate([ties, of_known]) * white[:, None]
        # the points by the places on the ground: rows of (Aᵀ P A)⁻¹ Aᵀ P
        by = cho_solve(cho_factor(a.T @ a), a.T)[begin:] * white
        by_ties, by_known = np.split(by, [len(ties)], axis=1)
        by_places = (on_ground(models, turns).T @ by_ties.T).T
        sigma = np.repeat(models.block.sigma, 2)
        variances = np.sum((by_places * sigma) ** 2, axis=1)
        variances += np.sum((by_known * known.sigma) ** 2, axis=1)
        return self._spread(np.sqrt(variances).reshape(-1, 3))

    @property
    def _slopes(self) -> tuple[np.ndarray, Float[np.ndarray, "row 3 3"]]:
        """The derivatives of ties by all unknowns, in the frame; and of the ground by
        the coordinates of each row."""
        models = self.models
        every = self.adjustment.parameters["model"]
        found = _by_model(every, models.model, models.at)
        of_models, turns = map(np.asarray, found)
        row = np.arange(len(models.at))[:, None]
        begin, points = 7 * len(models.left), int(self.number.max()) + 1
        ties = np.zeros((len(models.at), 3, begin + 3 * points))
        for axis in range(3):
            own = 7 * models.model[:, None] + np.arange(7)
            ties[row, axis, own] = of_models[:, axis]
            point = begin + 3 * self.number[models.point] + axis
            ties[row[:, 0], axis, point] = -1.0
        return ties.reshape(3 * len(row), -1), turns * self.frame.length

    def _spread(self, values: Float[np.ndarray, "some 3"]) -> np.ndarray:
        there = (self.number >= 0)[:, None]
        return np.where(there, values[np.maximum(self.number, 0)], np.nan)


def adjust_models(
    models: ModelCoordinates,
    start: Start,
    ground: Ground,
    deviations: Float[ArrayLike, "..."],
) -> ClassicalAdjustment:
    """Adjust models to each other and to the ground, from approximate stations.

    `deviations`: standard deviations of model coordinates along X, Y and Z of the
    ground: a number for equal weights, three for plan and height, or those of each row.
    Raises ValueError for fewer known coordinates than the ground has parameters. Other
    failures are values of `adjustment.result`.
    """
    units = frame_of(start)
    shown = np.zeros(len(models.block.points) + len(models.block.photos), bool)
    shown[models.point] = True
    number = np.where(shown, np.cumsum(shown) - 1, -1)
    known = known_of(models.block, ground)
    known = known.take(~known.station)
    known = known.take(shown[known.number])
    if len(known.value) < DATUM:
        raise ValueError(
            f"adjust_models: {len(known.value)} known coordinates are in models, "
            f"{DATUM} are needed: add control"
        )
    sigma = np.broadcast_to(np.asarray(deviations, float), models.at.shape)
    ties = Term(
        of_tie,
        (models.at, np.zeros_like(models.at)),
        (None, (sigma / units.length) ** 2),
        touches=[("model", models.model), ("point", number[models.point])],
    )
    control = Term(
        of_coordinate,
        (known.axis, (known.value - units.middle[known.axis]) / units.length),
        (None, (known.sigma / units.length) ** 2),
        touches=[("point", number[known.number])],
    )
    turns, lengths = placed(models, start)
    of_points = np.zeros((int(np.sum(shown)), 3))
    places = np.einsum("rij,rj->ri", turns[models.model], models.at)
    places *= lengths[models.model, None]
    places += start.centres[models.left[models.model]]
    of_points[number[models.point]] = units.inside(places)
    families = {
        "model": _similarities(models, start, units),
        "point": of_points,
    }
    adjustment = adjust_sparse(
        (ties, control), families, eliminate="point", linked="model"
    )
    return ClassicalAdjustment(
        models=models,
        ground=ground,
        frame=units,
        known=known,
        number=number,
        deviations=sigma,
        adjustment=adjustment,
    )


def deviations_of(models: ModelCoordinates, start: Start) -> Float[np.ndarray, "row 3"]:
    """The true standard deviations of each row within its model, along X, Y and Z of
    the ground, from those of the places. What holds a model has none: the left
    projection centre, and the length of the base."""
    turns, lengths = placed(models, start)
    scaled = turns * lengths[:, None, None]
    by_places = on_ground(models, scaled[models.model])
    variances = by_places.power(2) @ np.repeat(models.block.sigma**2, 2)
    return np.sqrt(variances).reshape(-1, 3)


def on_ground(models: ModelCoordinates, turns: Float[np.ndarray, "row 3 3"]) -> Any:
    """The derivatives of places on the ground by places on photos, sparse; `turns`:
    from the coordinates of each row to the ground."""
    from scipy.sparse import bsr_array

    rows = np.arange(len(turns) + 1)
    return bsr_array((turns, rows[:-1], rows)) @ models.by_places


def placed(
    models: ModelCoordinates, start: Start
) -> tuple[Float[np.ndarray, "model 3 3"], Float[np.ndarray, " model"]]:
    """Rotations from the models to the ground, and lengths of their bases there, by
    approximate stations."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = start.quaternions[models.left].T
    stations = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    bases = start.centres[models.right] - start.centres[models.left]
    turns = np.swapaxes(stations, 1, 2) * SIGNS
    return turns, np.linalg.norm(bases, axis=1)


def _similarities(models: ModelCoordinates, start: Start, units: Frame) -> Similarity:
    """The approximate seven parameters of each model, in the frame."""
    from scipy.spatial.transform import Rotation

    turns, lengths = placed(models, start)
    x, y, z, w = Rotation.from_matrix(turns).as_quat().T
    shift = units.inside(start.centres[models.left])
    quaternions = np.stack([w, x, y, z], axis=1)
    return Similarity(*jax.device_put((lengths / units.length, quaternions, shift)))


@compiled
def _by_model(
    families: Similarity, model: Int[Array, " row"], at: Float[Array, "row 3"]
) -> tuple[Float[Array, "row 3 7"], Float[Array, "row 3 3"]]:
    """The derivatives of places on the ground by the parameters of their model, and by
    their coordinates in it."""

    def place(step: Array, at: Array, number: Array) -> Array:
        own = jax.tree.map(lambda a: a[number], families)
        return own.move(step).to_ground(at)

    slopes = jax.jacfwd(place, argnums=(0, 1))
    return jax.vmap(lambda k, x: slopes(jnp.zeros(7), x, k))(model, at)
