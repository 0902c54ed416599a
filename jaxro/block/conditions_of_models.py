"""The conditions Φ(λ, U) = 0 of models with common photos, as the 1982 fragment has
them, and their derivatives.

λ are the places on photos and the known ground coordinates. U are the orientation
elements: five of each model, the length of each base but the first one, and the seven
that place the first photo on the ground. The models are the edges of a tree of photos.
A point with r rays has 2 r - 3 conditions: the rays of every two neighbouring photos
meet, and every two neighbouring models have it at the same depth in their common photo.
Each known coordinate adds one.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..geometry import rotations as rot
from ..geometry.elements import RelativePose
from ..xla.programs import compiled
from .similarity import Similarity


class View(NamedTuple):
    """A place on a photo: the rotation of the photo from camera axes (y down, z
    forward) into those of the first photo, its centre there, and the place with the
    focal length 1."""

    turn: Float[Array, "3 3"]
    centre: Float[Array, "3"]
    place: Float[Array, "2"]

    @property
    def ray(self) -> Float[Array, "3"]:
        """The direction to the point; its depth is 1."""
        return self.turn @ jnp.append(self.place, 1.0)


class Known(NamedTuple):
    """A known ground coordinate of a point, and along which axis."""

    axis: Int[Array, ""]
    value: Float[Array, ""]


Formula = Callable[[list[View], list[Known], Similarity], Float[Array, ""]]
"""A condition of one point: of some of its rays, some of its known coordinates, and the
similarity from the first photo to the ground."""

# -------------------------------------------------------------------------------------
# the conditions


def coplanarity(views, known, ground):
    """Two rays meet: b . (d1 x d2) = 0."""
    del known, ground
    first, second = views
    base = second.centre - first.centre
    return jnp.dot(base, jnp.cross(first.ray, second.ray))


def equal_depth(views, known, ground):
    """The first ray has the same depth where it meets the second one and where it meets
    the third."""
    del known, ground
    common, one, other = views
    return depth(common, one) / depth(common, other) - 1


def known_coordinate(views, known, ground):
    """Two rays meet at a known coordinate."""
    (view, beside), (one,) = views, known
    point = view.centre + depth(view, beside) * view.ray
    return ground.to_ground(point)[one.axis] - one.value


def through_known(views, known, ground):
    """A single ray has one known coordinate where it has another."""
    (view,), (at, one) = views, known
    begin = ground.to_ground(view.centre)
    along = ground.to_ground(view.centre + view.ray) - begin
    reach = (at.value - begin[at.axis]) / along[at.axis]
    return begin[one.axis] + reach * along[one.axis] - one.value


def depth(view: View, beside: View) -> Float[Array, ""]:
    """The depth λ of the point of two rays in the first photo, λ d1 = b + μ d2."""
    across = jnp.cross(view.ray, beside.ray)
    base = beside.centre - view.centre
    return jnp.dot(jnp.cross(base, beside.ray), across) / jnp.dot(across, across)


# -------------------------------------------------------------------------------------
# the elements


class Tree(NamedTuple):
    """The photos of the models, one model a row: `known` is the first photo, or the
    `new` one of a row above."""

    known: Int[Array, " model"]
    new: Int[Array, " model"]


class Elements(NamedTuple):
    """U: the `models` (camera axes, from the known photo), the logarithms of their base
    `lengths`, of which the first is 0, and the similarity from the first photo to the
    `ground`."""

    models: RelativePose
    lengths: Float[Array, " model"]
    ground: Similarity

    def move(self, step: Float[Array, " u"]) -> "Elements":
        """The elements after a small step of the models, lengths and, where it is that
        long, of the similarity."""
        number = len(self.lengths)
        of_models, rest = step[: 5 * number].reshape(number, 5), step[5 * number :]
        of_lengths, of_ground = rest[: number - 1], rest[number - 1 :]
        models = jax.vmap(lambda pose, one: pose.move(one))(self.models, of_models)
        lengths = self.lengths + jnp.concatenate([jnp.zeros(1), of_lengths])
        ground = self.ground.move(of_ground) if len(of_ground) else self.ground
        return Elements(models, lengths, ground)

    def normalise(self) -> "Elements":
        """The same elements in their standard form."""
        models = jax.vmap(lambda pose: pose.normalise())(self.models)
        return Elements(models, self.lengths, self.ground.normalise())


class Photos(NamedTuple):
    """Rotations of all photos into the axes of the first one, and their centres."""

    turns: Float[Array, "photo 3 3"]
    centres: Float[Array, "photo 3"]


def photos_of(elements: Elements, tree: Tree) -> Photos:
    """The photos along the tree."""
    number = len(tree.new) + 1
    eye = jnp.broadcast_to(jnp.eye(3)[None], (number, 3, 3))
    begin = Photos(eye, jnp.zeros((number, 3)))

    def add(photos: Photos, model: tuple) -> tuple[Photos, None]:
        pose, length, known, new = model
        rotation, base = pose.relative()
        turn = photos.turns[known]
        centre = photos.centres[known] + jnp.exp(length) * turn @ jnp.stack(base)
        turns = photos.turns.at[new].set(turn @ rot.as_array(rotation))
        return Photos(turns, photos.centres.at[new].set(centre)), None

    rows = elements.models, elements.lengths, tree.known, tree.new
    return jax.lax.scan(add, begin, rows)[0]


def _on_ground(elements: Elements, photos: Photos) -> Photos:
    turn = rot.as_array(elements.ground.rotation)
    turns = jax.vmap(lambda one: turn @ one)(photos.turns)
    return Photos(turns, jax.vmap(elements.ground.to_ground)(photos.centres))


# -------------------------------------------------------------------------------------
# their derivatives


class Group(eqx.Module):
    """All conditions of one formula: the numbers of their rays and of their known
    coordinates."""

    formula: Formula = eqx.field(static=True)
    rays: Int[Array, "condition view"]
    known: Int[Array, "condition given"]


class Measurements(NamedTuple):
    """λ: places with the focal length 1 and their photos, known coordinates and their
    axes."""

    places: Float[Array, "ray 2"]
    photo: Int[Array, " ray"]
    values: Float[Array, " coordinate"]
    axis: Int[Array, " coordinate"]


class Linear(NamedTuple):
    """Conditions of a group: their misclosures, and their derivatives by the elements,
    by the places of their rays, and by their known coordinates."""

    misclosure: Float[Array, " condition"]
    by_elements: Float[Array, "condition u"]
    by_places: Float[Array, "condition view 2"]
    by_values: Float[Array, "condition given"]


class Problem(NamedTuple):
    """What the conditions are made of."""

    groups: list[Group]
    measured: Measurements
    elements: Elements
    tree: Tree


class Linearised(NamedTuple):
    """A problem, its linearised conditions, its photos on the ground, and the
    derivatives of their centres by the elements."""

    problem: Problem
    conditions: list[Linear]
    photos: Photos
    centres: Float[Array, "photo 3 u"]


@compiled
def advance(
    problem: Problem, corrections: Float[Array, " lambda"], step: Float[Array, " u"]
) -> Linearised:
    """A problem with corrections of its measurements (places, then known coordinates)
    and a step of its elements, linearised there."""
    places, values = problem.measured.places, problem.measured.values
    of_places = corrections[: places.size].reshape(places.shape)
    measured = problem.measured._replace(
        places=places + of_places, values=values + corrections[places.size :]
    )
    elements = problem.elements.move(step).normalise()
    problem = problem._replace(measured=measured, elements=elements)

    def photos_at(step: Float[Array, " u"]) -> tuple[Photos, Photos]:
        moved = elements.move(step)
        photos = photos_of(moved, problem.tree)
        return photos, _on_ground(moved, photos)

    origin = jnp.zeros_like(step)
    photos, ground = photos_at(origin)
    by_step, on_ground = jax.jacfwd(photos_at)(origin)
    found = [
        _linearise(group, measured, elements, photos, by_step)
        for group in problem.groups
    ]
    return Linearised(problem, found, ground, on_ground.centres)


def _linearise(
    group: Group,
    measured: Measurements,
    elements: Elements,
    photos: Photos,
    by_step: Photos,
) -> Linear:
    photo = measured.photo[group.rays]
    seen = photos.turns[photo], photos.centres[photo], measured.places[group.rays]
    known = measured.axis[group.known], measured.values[group.known]

    def value(turns, centres, places, values, ground, axes):
        views = [View(*one) for one in zip(turns, centres, places, strict=True)]
        given = [Known(*one) for one in zip(axes, values, strict=True)]
        return group.formula(views, given, elements.ground.move(ground))

    def linear(turns, centres, places, axes, values):
        of_ground = jnp.zeros(7)
        numbers = turns, centres, places, values, of_ground
        return jax.value_and_grad(value, argnums=(0, 1, 2, 3, 4))(*numbers, axes)

    misclosure, slopes = jax.vmap(linear)(*seen, *known)
    by_turns, by_centres, by_places, by_values, by_ground = slopes
    by_elements = jnp.einsum("nvab,nvabu->nu", by_turns, by_step.turns[photo])
    by_elements += jnp.einsum("nva,nvau->nu", by_centres, by_step.centres[photo])
    # the similarity itself is behind the models and lengths, or it is not asked for
    own = 6 * len(elements.lengths) - 1
    asked = by_elements.shape[1] - own
    by_elements = by_elements.at[:, own:].add(by_ground[:, :asked])
    return Linear(misclosure, by_elements, by_places, by_values)
