"""Normal equations of thousands of blocks, and what follows from their solution: the
compiled programs of `sparse`, whose docstring has the equations."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ops import segment_sum
from jaxtyping import Array, Float, Int

from ..xla.programs import compiled
from .blocks import Linearised, Steps, linearise, move, normalise, residuals
from .elimination import inverses
from .sparse_factor import Carried, Pattern, Reduced
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

    def place(self, name: str) -> tuple[int, int]:
        """Where the parameters of a family begin among all of them (linked, common,
        eliminated), and how many each member has."""
        linked = self.blocks * self.block_size
        if name == self.linked:
            return 0, self.block_size
        if name == self.eliminated:
            return linked + self.common_total, self.point_size
        k = self.common.index(name)
        return linked + self.begin[k], self.common_sizes[k]


class Data(NamedTuple):
    """The terms, the families that they displace, and who meets whom."""

    terms: tuple[Term, ...]
    families: dict[str, Any]
    pattern: Pattern


class Touched(NamedTuple):
    """The columns of one term by the roles of what it touches: the eliminated block (if
    any), the linked ones, and all common parameters in a row."""

    own: tuple[Int[Array, " group"], Float[Array, "group m p"]] | None
    links: list[tuple[Int[Array, " group"], Float[Array, "group m d"]]]
    common: Float[Array, "group m c"]
    residuals: Float[Array, "group m"]


class Normals(NamedTuple):
    """The normal equations before the elimination, W sighting by sighting."""

    s: Float[Array, "slot d d"]
    h: Float[Array, "block d"]
    border: Float[Array, "block d c"]
    common: Float[Array, "c c"]
    b: Float[Array, " c"]
    v: Float[Array, "point p p"]
    g: Float[Array, "point p"]
    x: Float[Array, "point p c"]
    w: Float[Array, "sighting p d"]


class Solved(NamedTuple):
    """Cofactors that the elimination reaches: of linked blocks by slots, of each of
    them with the common parameters, and of these."""

    links: Float[Array, "slot d d"]
    crossed: Float[Array, "block d c"]
    common: Float[Array, "c c"]


class OfPoints(NamedTuple):
    """Cofactors of each point, with the block of each sighting, and with the common
    parameters."""

    own: Float[Array, "point p p"]
    links: Float[Array, "sighting p d"]
    common: Float[Array, "point p c"]


class Shifts(NamedTuple):
    """N⁻¹ Aᵀ of the rows of a term, as far as these touch what is shifted: the linked
    blocks in their order, and the eliminated one (if any). By it a member moves back
    where a whitened residual grows by 1."""

    links: list[Float[Array, "group d m"]]
    own: Float[Array, "group p m"] | None


class Read(NamedTuple):
    """Cofactors of each point; the redundancy of each row and the `Shifts` of each
    term."""

    points: Float[Array, "point p p"]
    redundancy: list[Float[Array, "_ _"]]
    shifts: list[Shifts]


@compiled
def displace(families: dict[str, Any], steps: Steps) -> dict[str, Any]:
    """The families after a displacement, in their standard form."""
    return {
        name: normalise(move(family, steps[name])) for name, family in families.items()
    }


@compiled
def all_residuals(steps: Steps, data: Data) -> list[Float[Array, "_ _"]]:
    """The whitened residuals of every term."""
    return [residuals(term, data.families, steps) for term in data.terms]


@compiled
def reduce_normals(
    steps: Steps, damping: Float[Array, ""], data: Data, *, roles: Roles
) -> tuple[Reduced, Carried]:
    """The normal equations of displaced families, their diagonal larger by the part
    `damping`, after the elimination."""
    n, of, whole = roles.blocks, data.pattern, _normals(data, steps, roles)
    diagonal = lambda a: jnp.diagonal(a, axis1=-2, axis2=-1)
    diagonals = tuple(map(diagonal, (whole.s[:n], whole.common, whole.v)))
    more = [_diagonal(_more(a, damping)) for a in (diagonals[0], diagonals[2])]
    inverse, pivots = inverses(whole.v + more[1])
    w, x, g = whole.w, whole.x, whole.g
    of_w, of_x = _times(inverse[of.point], w), _times(inverse, x)
    along_w = jnp.sum(of_w * g[of.point][:, :, None], 1)
    common = whole.common + jnp.diag(damping * diagonals[1])
    reduced = Reduced(
        blocks=_without_points(whole.s.at[:n].add(more[0]), of, w, of_w),
        h=whole.h - segment_sum(along_w, of.block, n),
        border=whole.border - segment_sum(_product(w, of_x[of.point]), of.block, n),
        common=common - jnp.einsum("epi,epj->ij", x, of_x),
        b=whole.b - jnp.einsum("epi,ep->i", of_x, g),
    )
    carried = Carried(
        inverse=inverse,
        pivots=pivots,
        g=g,
        x=x,
        w=w,
        right=(whole.h, whole.b),
        diagonals=diagonals,
    )
    return reduced, carried


def _normals(data: Data, steps: Steps, roles: Roles) -> Normals:
    """The sums over all terms."""
    n, d, c = roles.blocks, roles.block_size, roles.common_total
    e, p = roles.points, roles.point_size
    sums = Normals(
        s=jnp.zeros((roles.slots, d, d)),
        h=jnp.zeros((n, d)),
        border=jnp.zeros((n, d, c)),
        common=jnp.zeros((c, c)),
        b=jnp.zeros(c),
        v=jnp.zeros((e, p, p)),
        g=jnp.zeros((e, p)),
        x=jnp.zeros((e, p, c)),
        w=jnp.zeros((0, p, d)),
    )
    direct = iter(data.pattern.direct)
    for touched in _all_touched(data, steps, roles):
        sums = _add_own(
            _add_common(_add_links(sums, touched, direct), touched), touched
        )
    return sums


def _add_links(sums: Normals, touched: Touched, direct: Iterator) -> Normals:
    """With the products of the linked columns; `direct`: the slots of two of them."""
    s, h, border, n = sums.s, sums.h, sums.border, len(sums.h)
    for i, a in touched.links:
        s = s.at[i].add(_product(a, a))
        h = h + segment_sum(_along(a, touched.residuals), i, n)
        border = border + segment_sum(_product(a, touched.common), i, n)
    for (i, a), (j, b) in _meeting(touched.links):
        both = _product(a, b)
        turned = jnp.where((i >= j)[:, None, None], both, _turned(both))
        # a block that meets itself has both halves of the product
        turned = turned + jnp.where((i == j)[:, None, None], _turned(both), 0.0)
        s = s.at[next(direct)].add(turned)
    return sums._replace(s=s, h=h, border=border)


def _add_common(sums: Normals, touched: Touched) -> Normals:
    """With the products of the common columns."""
    a = touched.common
    return sums._replace(
        common=sums.common + jnp.einsum("gmi,gmj->ij", a, a),
        b=sums.b + jnp.einsum("gmi,gm->i", a, touched.residuals),
    )


def _add_own(sums: Normals, touched: Touched) -> Normals:
    """With the products of the eliminated columns."""
    if touched.own is None:
        return sums
    (i, a), e = touched.own, len(sums.v)
    return sums._replace(
        v=sums.v + segment_sum(_product(a, a), i, e),
        g=sums.g + segment_sum(_along(a, touched.residuals), i, e),
        x=sums.x + segment_sum(_product(a, touched.common), i, e),
        w=jnp.concatenate([sums.w, *(_product(a, b) for _, b in touched.links)]),
    )


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


@compiled
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


@compiled
def read_solution(solved: tuple[Carried, Solved], data: Data, *, roles: Roles) -> Read:
    """What follows from the cofactors of the linked and common parameters."""
    carried, known = solved
    points = _of_points(carried, known, data.pattern)
    redundancy, shifts = [], []
    direct, begin = iter(data.pattern.direct), 0
    every = zip(_all_touched(data, origin(data, roles), roles), data.terms, strict=True)
    for touched, term in every:
        groups = len(term.mask)
        end = begin + groups * len(touched.links) * (touched.own is not None)
        sightings = points.links[begin:end].reshape(-1, groups, *points.links.shape[1:])
        begin = end
        shift, common = _shift(touched, known, points, sightings, direct)
        taken = _taken(touched.common, common)
        for (_, a), b in zip(touched.links, shift.links, strict=True):
            taken = taken + _taken(a, b)
        if touched.own is not None and shift.own is not None:
            taken = taken + _taken(touched.own[1], shift.own)
        redundancy.append(jnp.where(term.mask[:, None], 1 - taken, 0.0))
        shifts.append(shift)
    return Read(points.own, redundancy, shifts)


def along_rows(
    values: dict[str, Float[Array, "_ _ _"]], data: Data, roles: Roles
) -> list[Float[Array, "_ _ _"]]:
    """A times columns of all parameters, given by families, of each term."""
    found = []
    for term in data.terms:
        part = linearise(term, data.families, origin(data, roles))
        columns = zip(term.touches, part.columns, strict=True)
        each = [_times(a, values[name][member]) for (name, member), a in columns]
        found.append(jnp.sum(jnp.stack(each), axis=0))
    return found


def _of_points(carried: Carried, known: Solved, of: Pattern) -> OfPoints:
    """Q_yx = -V⁻¹ (W Q_xx + X Q_cx), and so on, for the points."""
    inverse, x, w = carried.inverse, carried.x, carried.w
    sum_ = lambda a: segment_sum(a, of.point, len(inverse))
    # with the block of each sighting, times -V
    seen = _times(x[of.point], _turned(known.crossed)[of.block])

    def more(seen, chunk):
        one, other, slot, both = chunk
        own = known.links.at[slot].get(mode="fill", fill_value=0.0)
        seen = seen.at[other].add(_times(w[one], own))
        turned = jnp.where(both[:, None, None], _turned(own), 0.0)
        return seen.at[one].add(_times(w[other], turned)), None

    seen = jax.lax.scan(more, seen, (of.p, of.q, of.slot, of.both))[0]
    # with the common parameters, times -V
    common = sum_(_times(w, known.crossed[of.block])) + _times(x, known.common[None])
    middle = sum_(_times(seen, _turned(w))) + _times(common, _turned(x))
    return OfPoints(
        own=inverse + _times(_times(inverse, middle), inverse),
        links=-_times(inverse[of.point], seen),
        common=-_times(inverse, common),
    )


def _shift(
    touched: Touched,
    known: Solved,
    points: OfPoints,
    sightings: Float[Array, "link group p d"],
    direct: Iterator,
) -> tuple[Shifts, Float[Array, "group c m"]]:
    """The `Shifts` of one term, and those of the common parameters. `sightings`: the
    cofactors of its points with its linked blocks; `direct`: the slots of two of
    these."""
    across = _turned(touched.common)
    common = _times(known.common[None], across)
    links = []
    for i, a in touched.links:
        links.append(_times(known.links[i], _turned(a)))
        links[-1] = links[-1] + _times(known.crossed[i], across)
        common = common + _times(_turned(known.crossed)[i], _turned(a))
    numbered = list(enumerate(touched.links))
    for (first, (i, a)), (second, (j, b)) in _meeting(numbered):
        q = known.links[next(direct)]
        q = jnp.where((i >= j)[:, None, None], q, _turned(q))
        links[first] = links[first] + _times(q, _turned(b))
        links[second] = links[second] + _times(_turned(q), _turned(a))
    if touched.own is None:
        return Shifts(links, None), common
    e, a = touched.own
    own = _times(points.own[e], _turned(a)) + _times(points.common[e], across)
    common = common + _times(_turned(points.common)[e], _turned(a))
    for k, (_, b) in numbered:
        own = own + _times(sightings[k], _turned(b))
        links[k] = links[k] + _times(_turned(sightings[k]), _turned(a))
    return Shifts(links, own), common


def _taken(
    a: Float[Array, "group m k"], shift: Float[Array, "group k m"]
) -> Float[Array, "group m"]:
    """The part of each row that some parameters take: the diagonal of a shift."""
    return jnp.sum(a * _turned(shift), axis=2)


def origin(data: Data, roles: Roles) -> Steps:
    """No displacement."""
    return {name: jnp.zeros(shape) for name, shape in shapes(data, roles).items()}


def shapes(data: Data, roles: Roles) -> dict[str, tuple[int, int]]:
    """Of the displacements of each family."""
    sizes = dict(zip(roles.common, roles.common_sizes, strict=True))
    sizes |= {roles.eliminated: roles.point_size, roles.linked: roles.block_size}
    number = lambda name: jax.tree.leaves(data.families[name])[0].shape[0]
    return {name: (number(name), sizes[name]) for name in data.families}


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


def _turned(a: Float[Array, "g i j"]) -> Float[Array, "g j i"]:
    """Each matrix transposed."""
    return jnp.swapaxes(a, 1, 2)


def _along(a: Float[Array, "g m i"], r: Float[Array, "g m"]) -> Float[Array, "g i"]:
    """aᵀ r of each group."""
    return jnp.sum(a * r[:, :, None], axis=1)


def _product(a: Float[Array, "g m i"], b: Float[Array, "g m j"]):
    """aᵀ b of each group, in loops: a call of a library for each would take longer."""
    return jnp.sum(a[:, :, :, None] * b[:, :, None, :], axis=1)


def _times(a: Float[Array, "#g i k"], b: Float[Array, "#g k j"]):
    """a b of each group."""
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)
