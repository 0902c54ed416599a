"""Which conditions a block has, and the orientation elements that they begin with."""

import jax
import numpy as np
from jaxtyping import Float, Int

from ..geometry.elements import RelativePose
from .adjust import Prepared
from .conditions_of_models import (
    Elements,
    Group,
    Measurements,
    Problem,
    Tree,
    coplanarity,
    equal_depth,
    known_coordinate,
    through_known,
)
from .measured_block import MeasuredBlock
from .network import Start, points_of
from .similarity import Similarity

MOST = 3000
"""Conditions that a dense system is meant for."""

PARALLEL = 1e-12
"""Squared sine of the angle between two rays below which they have no intersection."""


def problem_of(prepared: Prepared, start: Start) -> Problem:
    """The conditions of what takes part in the adjustment of a block, at its
    approximate stations. Raises ValueError."""
    block, numbered = prepared.block, prepared.numbered
    if len(block.photos) < 2:
        raise ValueError("adjust_conditions: a model has two photos, the block has one")
    used = numbered.rays
    photo, point = block.photo[used], block.point[used]
    focal = block.focal[photo]
    places = np.stack([block.x[used] / focal, -block.y[used] / focal], axis=1)
    known, frame = points_of(prepared.known), prepared.frame
    if len(known.row) < sum(len(part.row) for part in prepared.known):
        raise ValueError(
            "adjust_conditions: stations are known; use adjust_block, which has them"
        )
    axis = known.axis
    values = (known.value - frame.middle[axis]) / frame.length
    measured = Measurements(*jax.device_put((places, photo, values, axis)))

    turns = _turns(start)
    tree = _tree(len(block.photos), photo, point)
    rank = np.empty(len(block.photos), int)
    rank[[tree.known[0], *tree.new]] = np.arange(len(rank))
    # the rays of each point one behind the other, along the tree
    order = np.lexsort((rank[photo], point))
    rays = np.append(places, np.ones((len(places), 1)), axis=1)
    rays = np.einsum("rji,rj->ri", turns[photo], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    groups = _groups(block, measured, point, known.number, order, rays)
    number = sum(len(group.rays) for group in groups)
    if number > MOST:
        raise ValueError(
            f"adjust_conditions: {number} conditions, at most {MOST} are adjusted "
            "together: use adjust_block, which has the same solution"
        )
    return Problem(
        groups=groups,
        measured=measured,
        elements=_elements(turns, frame.inside(start.centres), tree),
        tree=Tree(*jax.device_put((tree.known, tree.new))),
    )


def _groups(
    block: MeasuredBlock,
    measured: Measurements,
    point: Int[np.ndarray, " ray"],
    known: Int[np.ndarray, " coordinate"],
    order: Int[np.ndarray, " ray"],
    rays: Float[np.ndarray, "ray 3"],
) -> list[Group]:
    """The conditions by their formulas. `point`: of each ray, `known`: of each known
    coordinate."""
    same = point[order[1:]] == point[order[:-1]]
    first, second = order[:-1][same], order[1:][same]
    sine = 1 - np.sum(rays[first] * rays[second], axis=1) ** 2
    _check(block, measured, point, first, second, sine)
    three = same[1:] & same[:-1]
    before, common, after = (order[k : len(order) - 2 + k][three] for k in range(3))

    # a known coordinate is compared where two rays meet at the largest angle
    widest = np.full(len(block.points), -1)
    widest[point[first][np.argsort(sine)]] = np.argsort(sine)
    meets = widest[known] >= 0
    pair = widest[known[meets]]

    # where there is one ray, with the coordinate along which it runs most
    alone = np.flatnonzero(~meets)
    ray_of = np.full(len(block.points), -1)
    ray_of[point] = np.arange(len(point))
    along = np.abs(rays[ray_of[known[alone]], np.asarray(measured.axis)[alone]])
    at = np.full(len(block.points), -1)
    at[known[alone][np.argsort(along)]] = alone[np.argsort(along)]
    rest = alone[at[known[alone]] != alone]

    none = lambda rows: np.zeros((len(rows), 0), int)
    columns = lambda *rows: np.stack(rows, axis=1)
    groups = [
        (coplanarity, columns(first, second), none(first)),
        (equal_depth, columns(common, before, after), none(common)),
        (
            known_coordinate,
            columns(first[pair], second[pair]),
            columns(np.flatnonzero(meets)),
        ),
        (
            through_known,
            columns(ray_of[known[rest]]),
            columns(at[known[rest]], rest),
        ),
    ]
    return [
        Group(formula, *jax.device_put((of_rays, of_known)))
        for formula, of_rays, of_known in groups
        if len(of_rays)
    ]


def _check(
    block: MeasuredBlock,
    measured: Measurements,
    point: Int[np.ndarray, " ray"],
    first: Int[np.ndarray, " pair"],
    second: Int[np.ndarray, " pair"],
    sine: Float[np.ndarray, " pair"],
) -> None:
    """Raises ValueError where two neighbouring rays do not meet at a point."""
    photo = np.asarray(measured.photo)
    twice = photo[first] == photo[second]
    wrong = np.flatnonzero(twice | (sine < PARALLEL))
    if len(wrong) == 0:
        return
    k = wrong[0]
    name = block.points[point[first[k]]]
    one, other = (block.photos[photo[rays[k]]] for rays in (first, second))
    if twice[k]:
        raise ValueError(
            f"adjust_conditions: photo {one!r} has two places of point {name!r}: leave "
            "one of them out, or use adjust_block"
        )
    raise ValueError(
        f"adjust_conditions: the rays of point {name!r} on the photos {one!r} and "
        f"{other!r} are parallel: leave one of them out, or use adjust_block"
    )


def _tree(
    photos: int, photo: Int[np.ndarray, " ray"], point: Int[np.ndarray, " ray"]
) -> Tree:
    """The models of most common points that join all photos, from a photo that belongs
    to one of them."""
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    shown = np.zeros((photos, int(point.max(initial=0)) + 1))
    shown[photo, point] = 1.0
    # photos without a common point, too: the elements of such a model are as good
    tree = minimum_spanning_tree(1 / (1 + shown @ shown.T))
    models = np.bincount(np.concatenate(tree.nonzero()), minlength=photos)
    order, before = breadth_first_order(tree, int(np.argmin(models)), directed=False)
    return Tree(known=before[order[1:]].astype(int), new=order[1:].astype(int))


def _turns(start: Start) -> Float[np.ndarray, "photo 3 3"]:
    """The rotations of the stations, object to camera."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = start.quaternions.T
    return Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()


def _elements(
    turns: Float[np.ndarray, "photo 3 3"],
    centres: Float[np.ndarray, "photo 3"],
    tree: Tree,
) -> Elements:
    """The elements of stations; the first base is the unit of the models."""
    from scipy.spatial.transform import Rotation

    known, new = tree
    base = np.einsum("mij,mj->mi", turns[known], centres[new] - centres[known])
    length = np.linalg.norm(base, axis=1)
    turn = turns[known] @ np.swapaxes(turns[new], 1, 2)
    x, y, z, w = Rotation.from_matrix(turn).as_quat().T
    models = w, x, y, z, *(base / length[:, None]).T
    x, y, z, w = Rotation.from_matrix(turns[known[0]].T).as_quat()
    ground = length[0], np.array([w, x, y, z]), centres[known[0]]
    return Elements(
        models=RelativePose(*jax.device_put(models)),
        lengths=jax.device_put(np.log(length / length[0])),
        ground=Similarity(*jax.device_put(ground)),
    )
