"""Whether two photos of one camera have the same distortion.

Both calibrations give a ray for every place of the measuring system. What a rotation of
the camera, a shift of the film, and a change of the focal length make is taken out of
the difference d of the corrected places; if the distortion is the same, the rest is
noise of the covariance

    C = J1 Q1 J1ᵀ + J2 Q2 J2ᵀ + (H1 - H2) Γ (H1 - H2)ᵀ

J are the derivatives of the corrected places by the parameters of each calibration, Q
the cofactors of these from what was measured. A field is estimated with a prior, so that
a calibration finds only a part H g of a distortion g; where the points of both images
lie elsewhere, both find different parts of the same g, whose a priori covariance is Γ.

    F = dᵀ C⁻¹ d / r / s²

over the r patterns of distortion that no pose imitates, with the pooled s² of both
sigma0², has Fisher's distribution if the distortion is the same.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from ..adjustment import critical_values
from ..xla.programs import compiled
from .compared import Compared, compare_rays, prior_deviation
from .result import Calibration

NODES = 15
"""Nodes along each side of the area on which the distortions are compared."""

FREE = 100.0
"""How large zones and Brown's corrections are taken to be beside a field, in units of
sigma, when the independent patterns of distortion are sought."""

LEAST = 0.1
"""A pattern of distortion that is smaller, in units of sigma, is not compared."""

Both = tuple[Calibration, Calibration]
Rows = Float[np.ndarray, "row _"]


class Difference(NamedTuple):
    """The second distortion minus the first, on nodes over the area that both images
    have measured, and what is taken out of it.

    `difference` of the corrected places, and its standard `deviations` if the
    distortion is the same, in the unit of the image. `turn`: the rotation about the
    camera's axes (radians), `shift` of the places (unit of the image) and `scale` (of
    the focal length; 0 if it is not taken out) that lead from the first to the second.
    `f` with `above` and `below` degrees of freedom, and the `probability` that it is
    larger by chance if the distortion is the same.
    """

    places: Float[np.ndarray, "node 2"]
    difference: Float[np.ndarray, "node 2"]
    deviations: Float[np.ndarray, "node 2"]
    turn: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "2"]
    scale: float
    f: float
    above: int
    below: int
    probability: float

    @property
    def in_deviations(self) -> Float[np.ndarray, "node 2"]:
        """The difference in units of its standard deviations."""
        there = self.deviations > 0
        return np.where(there, self.difference / np.where(there, self.deviations, 1), 0)


def difference(
    first: Calibration, second: Calibration, *, refocused: bool = False
) -> Difference:
    """Compare the distortion of two calibrations, each from measurements of its own, in
    the same measuring system of one camera.

    `refocused`: a change of the focal length is taken out as well; else it is asked
    whether distortion and focal length are the same. Zones are those of the measured
    area of each image: compare models with zones where both areas are the same.

    Raises RuntimeError for a calibration that cannot be used, and ValueError for images
    of different handedness or rays, without a common area, or without distortion.
    """
    both = first.check(), second.check()
    nodes = _common_area(both)
    compare = compiled(compare_rays)
    found: Compared = compare(nodes, first, second, refocused=refocused)
    apart, pose = np.asarray(found.apart), np.asarray(found.pose)
    covariance, patterns = _covariance(found), _patterns(both, found)
    below, variance = _pooled(both)
    d, own = patterns.T @ apart, patterns.T @ covariance @ patterns
    rank = patterns.shape[1]
    f = float(d @ np.linalg.solve(own, d)) / rank / variance
    axes = np.asarray(first.frame.axes)
    variances = np.maximum(np.diagonal(covariance), 0.0) * variance
    return Difference(
        places=nodes,
        difference=apart.reshape(-1, 2) * axes,
        deviations=np.sqrt(variances).reshape(-1, 2),
        turn=pose[:3],
        shift=pose[3:5] * axes,
        scale=float(pose[5]) if refocused else 0.0,
        f=f,
        above=rank,
        below=below,
        probability=float(critical_values.fisher_p(f, rank, below)),
    )


def _common_area(both: Both) -> Float[np.ndarray, "node 2"]:
    """Nodes over the rectangle that both images have measured."""
    if both[0].model.rays is not both[1].model.rays:
        raise ValueError("difference: both calibrations need the same rays")
    frames = [found.frame for found in both]
    if float(frames[0].handedness) != float(frames[1].handedness):
        raise ValueError(
            "difference: y points down in one of the images and up in the other; "
            "measure both in the same system"
        )
    centres = [np.asarray(f.centre) for f in frames]
    halves = [np.asarray(f.half_sides * f.size) for f in frames]
    sides = list(zip(centres, halves, strict=True))
    low = np.maximum(*(centre - half for centre, half in sides))
    high = np.minimum(*(centre + half for centre, half in sides))
    if not np.all(high > low):
        raise ValueError(
            "difference: the measured areas of both images do not overlap; measure "
            "both in the same system"
        )
    t = np.linspace(0.0, 1.0, NODES)
    square = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return low + (high - low) * square


def _without_pose(found: Compared, rows: ArrayLike) -> Rows:
    """Displacements of the nodes, in columns, less what a pose makes of them."""
    pose, rows = np.asarray(found.patterns), np.asarray(rows)
    return rows - pose @ np.linalg.lstsq(pose, rows)[0]


def _covariance(found: Compared) -> Float[np.ndarray, "row row"]:
    """C of the module, without the pose, in units of sigma0²."""
    shrunk = _without_pose(found, found.shrunk)
    whole = shrunk @ shrunk.T
    for rows, cofactor in zip(found.slopes, found.noise, strict=True):
        left = _without_pose(found, rows)
        whole = whole + left @ np.asarray(cofactor) @ left.T
    return whole


def _pooled(both: Both) -> tuple[int, float]:
    """The degrees of freedom of both calibrations, and the mean of their sigma0²."""
    freedom = [int(found.degrees_of_freedom) for found in both]
    squares = [float(found.sigma0) ** 2 for found in both]
    return sum(freedom), float(np.average(squares, weights=freedom))


def _patterns(both: Both, found: Compared) -> Float[np.ndarray, "row rank"]:
    """Orthonormal patterns of all distortions that the models know, without those that
    a pose makes as well."""
    every = [
        _sized(one, np.asarray(rows))
        for one, rows in zip(both, found.slopes, strict=True)
    ]
    same = bool(both[0].model == both[1].model)
    # the patterns of two images differ a little, by their areas and principal places
    columns = (every[0] + every[1]) / 2 if same else np.concatenate(every, axis=1)
    vectors, sizes, _ = np.linalg.svd(
        _without_pose(found, columns), full_matrices=False
    )
    kept = sizes > LEAST * np.sqrt(len(columns))
    if not np.any(kept):
        raise ValueError(
            "difference: the models have no distortion; compare models with Brown's "
            "coefficients, zones or a field"
        )
    return vectors[:, kept]


def _sized(found: Calibration, rows: Rows) -> Rows:
    """The patterns of the unknowns of distortion, as large as they may be, in units of
    sigma."""
    end = rows.shape[1] - found.camera.field.size
    free = rows[:, 8:end][:, _free(found)]
    sized = [FREE * free / np.sqrt(np.mean(free**2, axis=0))]
    if found.model.field is not None:
        sigma = float(found.observed.sigma * found.frame.size)
        sized.append(rows[:, end:] * (float(prior_deviation(found)) / sigma))
    return np.concatenate(sized, axis=1)


def _free(found: Calibration) -> Int[np.ndarray, " free"]:
    """Which of the focal lengths and of Brown's coefficients are unknowns."""
    focals, lens = found.camera.focal.size, found.model.brown
    of_lens = () if lens is None else np.flatnonzero(lens.free) + focals
    return np.concatenate([np.arange(focals), of_lens]).astype(int)
