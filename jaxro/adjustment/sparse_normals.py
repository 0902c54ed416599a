"""Normal equations of thousands of blocks, and what follows from their solution: the
compiled programs of `sparse`, whose docstring has the equations."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ops import segment_sum
from jaxtyping import Array, Float, Int

from .blocks import Linearised, Steps, linearise, residuals
from .elimination import inverses
from .sparse_factor import Pattern, Reduced
from .terms import Term


class Roles(NamedTuple):
    """The families by what they are to the normal equations, with the number of members
    and of parameters of each; `begin`: where the parameters of each common family
    begin."""

    eliminated: str
    linked: str
    common: tuple[str, ...]
    points: int
    point_size: int
    blocks: int
    block_size: int
    begin: tuple[int, ...]
    common_sizes: tuple[int, ...]
    common_total: int
    slots: int

    def columns(self, name: str, member: Int[Array, " group"]) -> Int[Array, "group d"]:
        """The places of the parameters of members of a common family."""
        k = self.common.index(name)
        size = self.common_sizes[k]
        return self.begin[k] + member[:, None] * size + jnp.arange(size)[None]


class Data(NamedTuple):
    """The terms, the families that they displace, and who meets whom."""

    terms: tuple[Term, ...]
    families: dict[str, Any]
    pattern: Pattern


class Carried(NamedTuple):
    """What leads from the reduced system back to the eliminated blocks: V⁻¹ with the
    least pivot of each V, g, X, and W of each sighting; and of the whole system the
    right-hand sides and the diagonals, of which the promise of a step is made."""

    inverse: Float[Array, "point p p"]
    pivots: Float[Array, " point"]
    g: Float[Array, "point p"]
    x: Float[Array, "point p c"]
    w: Float[Array, "sighting p d"]
    right: tuple[Float[Array, "block d"], Float[Array, " c"]]
    diagonals: tuple[
        Float[Array, "block d"], Float[Array, " c"], Float[Array, "point p"]
    ]


class Touched(NamedTuple):
    """The columns of one term by the roles of what it touches: the eliminated block (if
    any), the linked ones, and all common parameters in a row."""

    own: tuple[Int[Array, " group"], Float[Array, "group m p"]] | None
    links: list[tuple[Int[Array, " group"], Float[Array, "group m d"]]]
    common: Float[Array, "group m c"]
    residuals: Float[Array, "group m"]


class Read(NamedTuple):
    """Cofactors of each point, and the redundancy of each row of each term."""

    points: Float[Array, "point p p"]
    redundancy: list[Float[Array, "_ _"]]


def all_residuals(steps: Steps, data: Data) -> list[Float[Array, "_ _"]]:
    """The whitened residuals of every term."""
    return [residuals(term, data.families, steps) for term in data.terms]


def reduce_normals(
    at: tuple[Steps, Float[Array, ""]], data: Data, roles: Roles
) -> tuple[Reduced, Carried]:
    """The normal equations of displaced families, their diagonal larger by the part
    `damping`, after the elimination."""
    steps, damping = at
    n, d, c = roles.blocks, roles.block_size, roles.common_total
    e, p = roles.points, roles.point_size
    of = data.pattern
    blocks = jnp.zeros((roles.slots, d, d))
    h, border = jnp.zeros((n, d)), jnp.zeros((n, d, c))
    common, b = jnp.zeros((c, c)), jnp.zeros(c)
    v, g, x = jnp.zeros((e, p, p)), jnp.zeros((e, p)), jnp.zeros((e, p, c))
    w, direct = [], list(of.direct)
    for touched in _all_touched(data, steps, roles):
        r, cross = touched.residuals, touched.common
        common = common + jnp.einsum("gmi,gmj->ij", cross, cross)
        b = b + jnp.einsum("gmi,gm->i", cross, r)
        for i, a in touched.links:
            blocks = blocks.at[i].add(_product(a, a))
            h = h + segment_sum(jnp.sum(a * r[:, :, None], 1), i, n)
            border = border + segment_sum(_product(a, cross), i, n)
        for (i, a), (j, other) in _meeting(touched.links):
            slot = direct.pop(0)
            both = _product(a, other)
            turned = jnp.where((i >= j)[:, None, None], both, jnp.swapaxes(both, 1, 2))
            # a block that meets itself has both halves of the product
            same = (i == j)[:, None, None]
            turned = turned + jnp.where(same, jnp.swapaxes(both, 1, 2), 0.0)
            blocks = blocks.at[slot].add(turned)
        if touched.own is None:
            continue
        i, a = touched.own
        v = v + segment_sum(_product(a, a), i, e)
        g = g + segment_sum(jnp.sum(a * r[:, :, None], 1), i, e)
        x = x + segment_sum(_product(a, cross), i, e)
        w += [_product(a, other) for _, other in touched.links]
    right = h, b
    diagonal = lambda a: jnp.diagonal(a, axis1=-2, axis2=-1)
    diagonals = diagonal(blocks[:n]), diagonal(common), diagonal(v)
    blocks = blocks.at[:n].add(_diagonal(_more(diagonals[0], damping)))
    common = common + jnp.diag(damping * diagonals[1])
    inverse, pivots = inverses(v + _diagonal(_more(diagonals[2], damping)))
    w = jnp.concatenate(w)
    k = _times(inverse[of.point], w)
    carried = Carried(
        inverse=inverse,
        pivots=pivots,
        g=g,
        x=x,
        w=w,
        right=right,
        diagonals=diagonals,
    )
    of_x = _times(inverse, x)
    reduced = Reduced(
        blocks=_without_points(blocks, of, w, k),
        h=h - segment_sum(jnp.sum(k * g[of.point][:, :, None], 1), of.block, n),
        border=border - segment_sum(_product(w, of_x[of.point]), of.block, n),
        common=common - jnp.einsum("epi,epj->ij", x, of_x),
        b=b - jnp.einsum("epi,ep->i", of_x, g),
    )
    return reduced, carried


def _without_points(
    blocks: Float[Array, "slot d d"],
    of: Pattern,
    w: Float[Array, "sighting p d"],
    k: Float[Array, "sighting p d"],
) -> Float[Array, "slot d d"]:
    """S - Wᵀ V⁻¹ W, pair of sightings by pair."""

    def more(blocks, chunk):
        p, q, slot = chunk
        return blocks.at[slot].add(-_product(w[p], k[q]), mode="drop"), None

    return jax.lax.scan(more, blocks, (of.p, of.q, of.slot))[0]


def carry_back(
    step: tuple[Float[Array, "block d"], Float[Array, " c"], Carried], data: Data
) -> tuple[Float[Array, "point p"], Float[Array, ""], Float[Array, ""]]:
    """The step of the eliminated blocks from that of the others; hᵀ dx and dxᵀ diag(N)
    dx of the whole step."""
    x, c, carried = step
    of = data.pattern
    seen = jnp.sum(carried.w * x[of.block][:, None, :], axis=2)
    rest = carried.g - segment_sum(seen, of.point, len(carried.g))
    rest = rest - jnp.sum(carried.x * c[None, None], axis=2)
    y = jnp.sum(carried.inverse * rest[:, None, :], axis=2)
    (h, b), parts = carried.right, (x, c, y)
    along = [jnp.sum(a * s) for a, s in zip((h, b, carried.g), parts, strict=True)]
    squares = zip(carried.diagonals, parts, strict=True)
    spread = [jnp.sum(a * s**2) for a, s in squares]
    total = lambda terms: jnp.sum(jnp.stack(terms))
    return y, total(along), total(spread)


def read_solution(
    solved: tuple[
        Carried,
        Float[Array, "slot d d"],
        Float[Array, "block d c"],
        Float[Array, "c c"],
    ],
    data: Data,
    roles: Roles,
) -> Read:
    """Cofactors of the points and redundancies of all rows, from the cofactors of the
    linked and common parameters."""
    carried, q, crossed, corner = solved
    of, inverse, x, w = data.pattern, carried.inverse, carried.x, carried.w
    # of point and linked block of each sighting, times -V
    seen = _times(x[of.point], jnp.swapaxes(crossed, 1, 2)[of.block])

    def more(seen, chunk):
        one, other, slot, both = chunk
        own = q.at[slot].get(mode="fill", fill_value=0.0)
        seen = seen.at[other].add(_times(w[one], own))
        turned = jnp.where(both[:, None, None], jnp.swapaxes(own, 1, 2), 0.0)
        return seen.at[one].add(_times(w[other], turned)), None

    seen = jax.lax.scan(more, seen, (of.p, of.q, of.slot, of.both))[0]
    # of point and common parameters, times -V
    sums = segment_sum(_times(w, crossed[of.block]), of.point, roles.points)
    with_common = sums + _times(x, corner[None])
    turned = lambda a: jnp.swapaxes(a, 1, 2)
    middle = segment_sum(_times(seen, turned(w)), of.point, roles.points)
    middle = middle + _times(with_common, turned(x))
    points = inverse + _times(_times(inverse, middle), inverse)
    with_links = -_times(inverse[of.point], seen)
    with_common = -_times(inverse, with_common)

    steps = origin(data, roles)
    redundancy, begin, direct = [], 0, list(of.direct)
    taken_by = lambda a, q, b: jnp.sum(_times(a, q) * b, axis=2)
    every = zip(_all_touched(data, steps, roles), data.terms, strict=True)
    for touched, term in every:
        cross = touched.common
        taken = taken_by(cross, corner[None], cross)
        for i, a in touched.links:
            taken = taken + taken_by(a, q[i], a)
            taken = taken + 2 * taken_by(a, crossed[i], cross)
        for (i, a), (j, b) in _meeting(touched.links):
            own = q[direct.pop(0)]
            own = jnp.where((i >= j)[:, None, None], own, turned(own))
            taken = taken + 2 * taken_by(a, own, b)
        if touched.own is not None:
            e, a = touched.own
            taken = taken + taken_by(a, points[e], a)
            taken = taken + 2 * taken_by(a, with_common[e], cross)
            for _, b in touched.links:
                own = with_links[begin : begin + len(e)]
                taken = taken + 2 * taken_by(a, own, b)
                begin += len(e)
        redundancy.append(jnp.where(term.mask[:, None], 1 - taken, 0.0))
    return Read(points, redundancy)


def origin(data: Data, roles: Roles, xp: Any = jnp) -> Steps:
    """No displacement; `xp`: the library of its arrays. NumPy compiles nothing for
    every number of members."""
    sizes = dict(zip(roles.common, roles.common_sizes, strict=True))
    sizes |= {roles.eliminated: roles.point_size, roles.linked: roles.block_size}
    number = lambda name: jax.tree.leaves(data.families[name])[0].shape[0]
    zeros = lambda name: xp.zeros((number(name), sizes[name]))
    return {name: zeros(name) for name in data.families}


def _all_touched(data: Data, steps: Steps, roles: Roles) -> list[Touched]:
    """Every term, linearised."""
    parts = (linearise(term, data.families, steps) for term in data.terms)
    return [
        _touched(term, part, roles)
        for term, part in zip(data.terms, parts, strict=True)
    ]


def _touched(term: Term, part: Linearised, roles: Roles) -> Touched:
    own, links = None, []
    groups, m = part.residuals.shape
    common = jnp.zeros((groups, roles.common_total, m))
    for (name, member), a in zip(term.touches, part.columns, strict=True):
        if name == roles.eliminated:
            own = member, a
        elif name == roles.linked:
            links.append((member, a))
        else:
            rows = jnp.arange(groups)[:, None], roles.columns(name, member)
            common = common.at[rows].add(jnp.swapaxes(a, 1, 2))
    return Touched(own, links, jnp.swapaxes(common, 1, 2), part.residuals)


def _meeting(links: list) -> list:
    """All two linked blocks that one group touches."""
    return [(a, b) for k, a in enumerate(links) for b in links[k + 1 :]]


def _more(
    diagonal: Float[Array, "member k"], damping: Float[Array, ""]
) -> Float[Array, "member k"]:
    """What is added to the diagonal: a part of it; 1 for members that nothing touches,
    which then stand still."""
    untouched = jnp.all(diagonal == 0, axis=1)[:, None]
    return jnp.where(untouched, 1.0, damping * diagonal)


def _diagonal(entries: Float[Array, "member k"]) -> Float[Array, "member k k"]:
    """Diagonal matrices."""
    return entries[:, :, None] * jnp.eye(entries.shape[1])[None]


def _product(a: Float[Array, "g m i"], b: Float[Array, "g m j"]):
    """aᵀ b of each group, in loops: a call of a library for each would take longer."""
    return jnp.sum(a[:, :, :, None] * b[:, :, None, :], axis=1)


def _times(a: Float[Array, "#g i k"], b: Float[Array, "#g k j"]):
    """a b of each group."""
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)
