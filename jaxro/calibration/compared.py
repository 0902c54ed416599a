"""Two calibrations in one measuring system: the rays that both give to the same places,
the pose between them, and how the rays follow the measurements."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..adjustment import symmetric
from ..camera.condition import Measured
from ..camera.field import functions
from .correct import ideal
from .images import Places
from .result import Calibration
from .slopes import inverse_of_two, slopes

ROUNDS = 5
"""Steps of Gauss-Newton to the pose between both calibrations."""

Rows = Float[Array, "row _"]
"""A row for x and one for y of each node, in turns."""


class Compared(NamedTuple):
    """Two calibrations on the same nodes, in the unit of the image, x to the right and
    y down.

    `apart`: the corrected places of the second minus those of the first, after the
    `pose` has been taken out that brings both together: a rotation about the camera's
    axes (radians), a shift and, if asked for, a change of scale; `patterns` are its
    derivatives. `slopes`: the derivatives of the corrected places by the parameters of
    each calibration. `noise`: cofactors of these parameters from the errors of what was
    measured. `shrunk`: what both find differently of one field that has the a priori
    variance.
    """

    apart: Float[Array, " row"]
    pose: Float[Array, " value"]
    patterns: Rows
    slopes: tuple[Rows, Rows]
    noise: tuple[Float[Array, "p p"], Float[Array, "q q"]]
    shrunk: Rows


def compare_rays(
    nodes: Places, first: Calibration, second: Calibration, refocused: bool
) -> Compared:
    """Compare two calibrations on nodes of the measuring system; `refocused`: with a
    change of scale."""
    both, focal = (first, second), jnp.mean(first.focal)
    (places, by_first), (aim, by_second) = (_ideal(f, nodes, focal) for f in both)

    def posed(pose: Array, place: Array) -> Array:
        a, b, c = (pose[k] for k in range(3))
        x, y, z = first.model.rays.direction(place / focal)
        turned = x - c * y + b * z, y + c * x - a * z, z - b * x + a * y
        moved = focal * jnp.stack(first.model.rays(turned)) + pose[3:5]
        return moved * (1 + pose[5]) if refocused else moved

    pose = jnp.zeros(6 if refocused else 5)
    pose = jax.lax.fori_loop(
        0, ROUNDS, lambda _, pose: _nearer(posed, pose, places, aim), pose
    )
    met, patterns, by_place = _linearise(posed, pose, places)
    own = by_first.reshape(len(nodes), 2, -1)
    by_first = jnp.einsum("nij,njp->nip", by_place, own).reshape(by_first.shape)
    rows = by_first, by_second
    return Compared(
        apart=(aim - met).reshape(-1),
        pose=pose,
        patterns=patterns,
        slopes=rows,
        noise=(_noise(first), _noise(second)),
        shrunk=_shrunk(both, rows),
    )


def prior_deviation(found: Calibration) -> Float[Array, ""]:
    """The a priori standard deviation of the coefficients of a field, in the units of
    the frame."""
    assert found.model.field is not None
    return found.model.field.strength * found.observed.sigma


def _ideal(
    found: Calibration, nodes: Places, focal: Float[Array, ""]
) -> tuple[Places, Rows]:
    """The corrected places for a focal length in the unit of the image, and their
    derivatives by all parameters of the calibration; the station has no part in them.
    """
    places, slopes = ideal(found, found.frame.normal_places(nodes))
    larger = focal / jnp.mean(found.basis @ found.camera.focal)
    rows = larger * slopes.reshape(-1, slopes.shape[2])
    return larger * places, jnp.pad(rows, ((0, 0), (6, 0)))


def _nearer(posed, pose: Array, places: Places, aim: Places) -> Array:
    """One step of Gauss-Newton to the pose that brings places nearest to others."""
    met, columns, _ = _linearise(posed, pose, places)
    inverse = symmetric.inverse(columns.T @ columns).matrix
    return pose + inverse @ (columns.T @ (aim - met).reshape(-1))


def _linearise(
    posed, pose: Array, places: Places
) -> tuple[Places, Rows, Float[Array, "node 2 2"]]:
    """The places after a pose, and their derivatives by the pose and by the places."""
    of_all = lambda function: jax.vmap(function, (None, 0))(pose, places)
    by_pose, by_place = of_all(jax.jacfwd(posed, argnums=(0, 1)))
    return of_all(posed), by_pose.reshape(-1, pose.size), by_place


def _noise(found: Calibration) -> Float[Array, "p p"]:
    """The cofactors from the errors of what was measured, for a field as it is:
    Q - Q Λ Q, Λ the weights of its prior."""
    q, modes = found.adjustment.cofactor, found.camera.field.size
    if not modes:
        return q
    of_field = q[:, -modes:] / prior_deviation(found)
    return q - of_field @ of_field.T


def _shrunk(both: tuple[Calibration, Calibration], rows: tuple[Rows, Rows]) -> Rows:
    """What the second finds of a field minus what the first finds, for every function
    of the a priori covariance; of two priors this is the mean."""
    priors = [found for found in both if found.model.field is not None]
    columns = [jnp.zeros((len(rows[0]), 0))]
    for given in priors:
        first, second = (
            own @ _found_of(given, by) for by, own in zip(both, rows, strict=True)
        )
        columns.append((second - first) / len(priors) ** 0.5)
    return jnp.concatenate(columns, axis=1)


def _found_of(given: Calibration, by: Calibration) -> Float[Array, "p mode"]:
    """The parameters that a calibration finds of each function of the a priori field of
    another one, times the standard deviation of its coefficient."""
    assert given.model.field is not None
    u = given.frame.normal_places(by.measured.places)
    size = prior_deviation(given) * given.frame.size / by.frame.size
    values = functions(u, given.model.field.length) * size
    response = _response(by)
    return jnp.concatenate([response[:, :, k] @ values for k in range(2)], axis=1)


def _response(found: Calibration) -> Float[Array, "p place 2"]:
    """The derivatives of all parameters by the measured places: -Q Aᵀ M⁻¹ B, M the
    cofactor of a misfit; in the units of the frame."""
    observed = found.observed
    measured = Measured(
        observed.places, observed.points, found.focal_weights, found.field_weights
    )
    at = slopes(found.model.rays, found.station, found.camera, measured)

    def rows(a: Array, b: Array, c: Array, variance: Array, of_point: Array) -> Array:
        own = variance * (b @ b.T) + (c * of_point[None]) @ c.T
        return a.T @ inverse_of_two(own) @ b

    every = jax.vmap(rows)(
        at.parameters, at.place, at.point, observed.variance, observed.point_variance
    )
    used = jnp.where(observed.mask[:, None, None], every, 0.0)
    return -jnp.einsum("pq,nqc->pnc", found.adjustment.cofactor, used)
