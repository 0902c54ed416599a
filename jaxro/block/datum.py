"""The datum of a free network: inner constraints on its photos (Meissl 1962).

Moving all photos and points together changes no residual: shifts e_k, small turns by
e_k about the middle of the stations, and a change of scale. A photo at S goes with
them by

    shift   dS = e_k
    turn    dS = e_k × (S - middle),   dw = -R e_k
    scale   dS = S - middle

dw turns the photo about its own axes, R → exp(dw×) R. These columns are G. The datum
asks of the displacements x of all photos that Gᵀ W x = 0. W weighs a turn by one radian
as much as a shift by the distance to the ground. Of all datums of the network this one
has the least variance of the photos, Σ |dS|² + distance² |dw|². Centres alone would not
do: those of one strip lie on a line, about which they do not see it roll.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..adjustment.sparse import with_room
from ..adjustment.sparse_factor import Anchor, Datum
from ..camera.condition import Station
from ..geometry import rotations as rot
from ..xla.programs import compiled


class Reference(NamedTuple):
    """What a free network is referred to: where the photos `begin`, the `middle` of
    their stations, and the `distance` to the ground."""

    begin: Station
    middle: Float[Array, "3"]
    distance: Float[Array, ""]


def free_datum(
    begin: Station, distance: float, *, has_scale: bool = False
) -> Callable[[Mapping[str, Any]], Datum]:
    """The `Datum` of displaced families: photos are neither shifted nor turned nor,
    unless the network `has_scale` by other measurements, scaled as a whole from where
    they `begin`. `distance`: from the stations to the ground, about.

    While the system is solved one photo is held altogether, and the station farthest
    from it along the line between them.
    """
    number = 6 if has_scale else 7
    centres = np.asarray(begin.centre)
    middle, distance_of_points = np.mean(centres, axis=0), np.asarray(distance)
    held = int(np.argmax(np.linalg.norm(centres - middle, axis=1)))
    base = centres - centres[held]
    far = int(np.argmax(np.linalg.norm(base, axis=1)))
    along = np.concatenate([np.zeros(3), base[far] / np.linalg.norm(base[far])])
    anchors = (*(Anchor(held, row) for row in np.eye(6)), Anchor(far, along))

    def of(families: Mapping[str, Any]) -> Datum:
        both = with_room((begin, families["photo"]))
        moved, rows = _of_photos(*both, middle, distance_of_points)
        moved, rows = (np.asarray(a)[: len(centres), :number] for a in (moved, rows))
        return Datum(np.moveaxis(rows, 0, 1), np.sum(moved, axis=0), anchors[:number])

    return of


@compiled
def _of_photos(
    begin: Station, now: Station, middle: Float[Array, "3"], distance: Float[Array, ""]
) -> tuple[Float[Array, "photo 7"], Float[Array, "photo 7 6"]]:
    """The share of each photo in what the datum asks for, and its derivatives by the
    photo's own parameters."""

    def of_photo(begin: Station, now: Station) -> tuple[Array, Array]:
        def share(step: Array) -> Array:
            return displacement(begin, now.move(step), middle, distance)

        origin = jnp.zeros(6)
        return share(origin), jax.jacfwd(share)(origin)

    return jax.vmap(of_photo)(begin, now)


def displacement(
    begin: Station,
    now: Station,
    middle: Float[Array, "3"],
    distance: Float[Array, ""],
) -> Float[Array, "7"]:
    """Gᵀ W x of one photo: its shift, turn and scale from where it began."""
    about, moved = begin.centre - middle, now.centre - begin.centre
    # R = R_begin exp(-e×): the turn e is that of the ground's axes
    before, after = (rot.from_quaternion(*_unit(each)) for each in (begin, now))
    m = rot.product(rot.transpose(before), after)
    turned = jnp.stack([m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0]]) / 2
    turn = jnp.cross(about, moved) + distance**2 * turned
    scale = jnp.sum(about * moved)
    return jnp.concatenate([moved, turn, scale[None]])


def _unit(station: Station) -> tuple[Array, ...]:
    quaternion = rot.unit_quaternion(station.quaternion)
    return tuple(quaternion[k] for k in range(4))
