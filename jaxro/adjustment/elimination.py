"""Normal equations of many blocks of parameters, the most numerous of which are
eliminated.

With kept parameters x, eliminated blocks y_e (object points, say) that no condition
joins to one another, and

    [ N   Wᵀ ] [x]   [h]
    [ W   V  ] [y] = [g],    V block-diagonal,

the kept ones solve (N - Wᵀ V⁻¹ W) x = h - Wᵀ V⁻¹ g (Schur complement), and y = V⁻¹ (g -
W x) follows block by block.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.ops import segment_sum
from jaxtyping import Array, Bool, Float, Int

from ..xla.programs import is_traced
from . import normal_equations as normal, symmetric
from .blocks import Families, Linearised, dimension, members
from .terms import Term

Matrix = Float[Array, "kept kept"]
Vector = Float[Array, " kept"]

Held = dict[str, Bool[Array, "_ _"]]
"""Of every family the local parameters that do not move, (member, d)."""


class Blocks(NamedTuple):
    """A family of blocks: its name, how many `members` it has, how many local
    parameters each of them, and where these begin among all kept ones; None where the
    family is eliminated."""

    name: str
    members: int
    size: int
    begin: int | None


class Layout(eqx.Module):
    """Where the local parameters of every family stand, the kept ones behind one
    another."""

    blocks: tuple[Blocks, ...] = eqx.field(static=True)

    def __getitem__(self, name: str) -> Blocks:
        return next(block for block in self.blocks if block.name == name)

    @property
    def kept(self) -> tuple[Blocks, ...]:
        return tuple(block for block in self.blocks if block.begin is not None)

    @property
    def eliminated(self) -> Blocks | None:
        return next((block for block in self.blocks if block.begin is None), None)

    @property
    def count(self) -> int:
        """The number of all kept parameters."""
        return sum(block.members * block.size for block in self.kept)

    @property
    def total(self) -> int:
        """The number of all parameters."""
        return sum(block.members * block.size for block in self.blocks)

    def is_eliminated(self, name: str) -> bool:
        return self[name].begin is None

    def places(self, name: str, member: Int[Array, "*group"]) -> Int[Array, "*group d"]:
        """The places of the parameters of these members among all kept ones."""
        _, _, size, begin = self[name]
        assert begin is not None
        return (
            begin
            + member[..., None] * size
            + jnp.expand_dims(jnp.arange(size), range(member.ndim))
        )

    def divided(
        self, kept: Vector, eliminated: Float[Array, "block d"] | None
    ) -> dict[str, Array]:
        """All parameters by family, (member, d)."""
        out = {}
        for name, count, size, begin in self.blocks:
            out[name] = (
                eliminated
                if begin is None
                else kept[begin : begin + count * size].reshape(count, size)
            )
        return out


def layout(
    families: Families, terms: tuple[Term, ...], eliminate: str | None
) -> Layout:
    """The `Layout` of these families. Raises ValueError for a name that there is not, a
    family without a condition, and where a condition joins two eliminated blocks or
    nothing is left."""
    touched = {name for term in terms for name, _ in term.touches}
    asked = touched if eliminate is None else touched | {eliminate}
    if unknown := asked - set(families):
        raise ValueError(
            f"adjust: there are no parameters {sorted(unknown)}; there are "
            f"{sorted(families)}"
        )
    if idle := set(families) - touched:
        raise ValueError(f"adjust: no condition touches the parameters {sorted(idle)}")
    for term in terms:
        for name, member in term.touches:
            if not is_traced(member) and not np.all(
                np.isin(member, np.arange(members(families[name])))
            ):
                raise ValueError(
                    f"adjust: a condition touches a member of {name!r} that is not "
                    "there"
                )
        if sum(name == eliminate for name, _ in term.touches) > 1:
            raise ValueError(
                f"adjust: a condition joins two blocks of {eliminate!r}, which cannot "
                "be eliminated then"
            )
    if set(families) == {eliminate}:
        raise ValueError(
            f"adjust: {eliminate!r} are all the parameters there are; one family has "
            "to be kept"
        )
    blocks, begin = [], 0
    for name, family in families.items():
        block = Blocks(
            name,
            members(family),
            dimension(family),
            None if name == eliminate else begin,
        )
        blocks.append(block)
        begin += 0 if name == eliminate else block.members * block.size
    return Layout(tuple(blocks))


class Sums(NamedTuple):
    """The sums of the eliminated blocks: V, W and g of the module's docstring."""

    v: Float[Array, "block d d"]
    w: Float[Array, "block d kept"]
    g: Float[Array, "block d"]


class Normals(NamedTuple):
    """The sums of the module's docstring: N, h, and those of the eliminated blocks, if
    there are any."""

    n: Matrix
    h: Vector
    eliminated: Sums | None


def accumulate(
    layout: Layout, terms: tuple[Term, ...], parts: list[Linearised]
) -> Normals:
    """The normal equations of terms that have been linearised."""
    dtype = parts[0].residuals.dtype
    n, h = (
        jnp.zeros((layout.count, layout.count), dtype),
        jnp.zeros(layout.count, dtype),
    )
    sums = None
    if layout.eliminated is not None:
        _, blocks, d, _ = layout.eliminated
        sums = Sums(
            *(
                jnp.zeros((blocks, d, *more), dtype)
                for more in ((d,), (layout.count,), ())
            )
        )
    for term, part in zip(terms, parts, strict=True):
        own, kept = _divided(layout, term, part)
        for name, member, a in kept:
            rows, alone = layout.places(name, member), layout[name].members == 1
            own_h = jnp.einsum("gmi,gm->gi", a, part.residuals)
            h = h.at[rows[0]].add(jnp.sum(own_h, 0)) if alone else h.at[rows].add(own_h)
            for other, of_other, b in kept:
                if alone and layout[other].members == 1:
                    # one block for all groups: one product of matrices
                    places = rows[0], layout.places(other, of_other)[0]
                    n = n.at[jnp.ix_(*places)].add(jnp.einsum("gmi,gmj->ij", a, b))
                    continue
                columns = layout.places(other, of_other)
                n = n.at[rows[:, :, None], columns[:, None, :]].add(
                    jnp.einsum("gmi,gmj->gij", a, b)
                )
        for _, member, a in own:
            sums = _with_blocks(layout, sums, part, member, a, kept)
    return Normals(n, h, sums)


def _with_blocks(
    layout: Layout, sums: Sums | None, part: Linearised, member, a, kept
) -> Sums:
    """The sums, with those of a term that touches the eliminated blocks `member` with
    the columns `a`."""
    assert sums is not None
    v, w, g = sums
    v = v + segment_sum(jnp.einsum("gmi,gmj->gij", a, a), member, v.shape[0])
    g = g + segment_sum(jnp.einsum("gmi,gm->gi", a, part.residuals), member, v.shape[0])
    rows = jnp.arange(a.shape[2])[None, :, None]
    for other, of_other, b in kept:
        columns = layout.places(other, of_other)[:, None]
        w = w.at[member[:, None, None], rows, columns].add(
            jnp.einsum("gmi,gmj->gij", a, b)
        )
    return Sums(v, w, g)


def _divided(layout: Layout, term: Term, part: Linearised) -> tuple[list, list]:
    """The blocks that a term touches, as (family, members, columns): the eliminated
    ones, and the kept ones."""
    touched = [
        (name, member, a)
        for (name, member), a in zip(term.touches, part.columns, strict=True)
    ]
    own = [entry for entry in touched if layout.is_eliminated(entry[0])]
    return own, [entry for entry in touched if not layout.is_eliminated(entry[0])]


def hold(layout: Layout, normals: Normals, held: Held) -> Normals:
    """The normal equations of which some parameters are held: their columns are zero,
    and each has the equation step = 0 of weight 1."""
    n, h, sums = normals
    of_kept = jnp.concatenate(
        [held[block.name].reshape(-1) for block in layout.kept]
    ).astype(n.dtype)
    n = n + jnp.diag(of_kept)
    if sums is not None and layout.eliminated is not None:
        of_blocks = held[layout.eliminated.name].astype(n.dtype)
        unit = jnp.eye(sums.v.shape[1], dtype=n.dtype)
        sums = sums._replace(v=sums.v + of_blocks[:, :, None] * unit[None])
    return Normals(n, h, sums)


def damp(normals: Normals, damping: Float[Array, ""]) -> Normals:
    """The normal equations, the diagonal of which is larger by the part `damping`."""
    n, h, sums = normals
    n = n + jnp.diag(damping * jnp.diagonal(n))
    if sums is not None:
        diagonal = jnp.diagonal(sums.v, axis1=1, axis2=2)
        unit = jnp.eye(sums.v.shape[1], dtype=n.dtype)
        sums = sums._replace(v=sums.v + damping * diagonal[:, :, None] * unit[None])
    return Normals(n, h, sums)


def along(
    normals: Normals, kept: Vector, eliminated: Float[Array, "block d"] | None
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Of a step dx: hᵀ dx and dxᵀ diag(N) dx, the eliminated blocks included."""
    n, h, sums = normals
    product = jnp.sum(h * kept)
    squares = jnp.sum(jnp.diagonal(n) * kept**2)
    if sums is None or eliminated is None:
        return product, squares
    diagonal = jnp.diagonal(sums.v, axis1=1, axis2=2)
    product = product + jnp.sum(sums.g * eliminated)
    return product, squares + jnp.sum(diagonal * eliminated**2)


class Carried(NamedTuple):
    """The solution of the eliminated blocks: their `steps`, V⁻¹ and V⁻¹ W."""

    steps: Float[Array, "block d"]
    inverse: Float[Array, "block d d"]
    by_kept: Float[Array, "block d kept"]


class Solution(NamedTuple):
    """The normal matrix of the kept parameters, their step and their cofactors; the
    solution of the eliminated blocks, if there are any; and what the parameters before
    each one leave of its diagonal (`pivots`)."""

    normal_matrix: Matrix
    step: Vector
    cofactor: Matrix
    eliminated: Carried | None
    pivots: Float[Array, " some"]


def solve(
    normals: Normals,
    constraint: tuple[Float[Array, "c kept"], Float[Array, " c"]] | None = None,
) -> Solution:
    """The solution, where the kept parameters also fulfil C step = c, given as (C,
    c)."""
    n, h, sums = normals
    diagonal = jnp.diagonal(n)
    scale = jnp.where(
        diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 1.0
    )
    if sums is None:
        q, step, pivots = _kept(n, h, scale, constraint)
        return Solution(n, step, q, None, pivots)
    inverse, of_blocks = inverses(sums.v)
    by_kept = inverse @ sums.w
    rows, flat = sums.w.reshape(-1, n.shape[0]), by_kept.reshape(-1, n.shape[0])
    n, h = n - rows.T @ flat, h - flat.T @ sums.g.reshape(-1)
    q, step, pivots = _kept(n, h, scale, constraint)
    steps = jnp.einsum("eij,ej->ei", inverse, sums.g) - by_kept @ step
    return Solution(
        n,
        step,
        q,
        Carried(steps, inverse, by_kept),
        jnp.concatenate([of_blocks, pivots]),
    )


def without_held(layout: Layout, solution: Solution, held: Held) -> Solution:
    """The solution with the cofactors of held parameters, which are zero."""
    dtype = solution.cofactor.dtype
    free = jnp.concatenate([~held[block.name].reshape(-1) for block in layout.kept])
    free = free.astype(dtype)
    solution = solution._replace(
        cofactor=solution.cofactor * free[:, None] * free[None, :]
    )
    if solution.eliminated is None or layout.eliminated is None:
        return solution
    of_blocks = (~held[layout.eliminated.name]).astype(dtype)
    inverse = solution.eliminated.inverse * of_blocks[:, :, None] * of_blocks[:, None]
    return solution._replace(eliminated=solution.eliminated._replace(inverse=inverse))


def _kept(
    n: Matrix, h: Vector, scale: Vector, constraint
) -> tuple[Matrix, Vector, Float[Array, " some"]]:
    """Cofactor, step and pivots of the kept parameters, all scaled by `scale` while
    they are calculated."""
    n = n * scale[:, None] * scale[None, :]
    h = h * scale
    if constraint is None:
        q, left = _inverse(n)
        step, pivots = q @ h, left * jnp.diagonal(n)
    else:
        # N + CᵀC is regular where N is not but the constraints fix what it leaves open;
        # with C x = c it changes nothing
        rows = constraint[0] * scale[None, :]
        length = jnp.sqrt(jnp.sum(rows**2, axis=1))
        rows, c = rows / length[:, None], constraint[1] / length
        q, left = symmetric.inverse(n + rows.T @ rows)
        border = q @ rows.T
        inverse, of_rows = symmetric.inverse(rows @ border)
        step = q @ (h + rows.T @ c)
        step = step - border @ (inverse @ (rows @ step - c))
        q = q - border @ inverse @ border.T
        pivots = jnp.concatenate([left, of_rows])
    return q * scale[:, None] * scale[None, :], step * scale, pivots


def _inverse(matrix: Matrix) -> tuple[Matrix, Float[Array, " some"]]:
    """The inverse of the kept parameters' matrix and its pivots; of a few parameters
    element by element, which batches well."""
    if len(matrix) > normal.UNROLLED:
        return symmetric.inverse(matrix)
    rows = [[matrix[i, j] for j in range(i + 1)] for i in range(len(matrix))]
    lower, pivot = normal.inverse(rows)
    return normal.dense(lower), pivot[None]


def inverses(
    v: Float[Array, "block d d"],
) -> tuple[Float[Array, "block d d"], Float[Array, " block"]]:
    """The inverses of many small matrices, and the smallest pivot of each, element by
    element."""
    d = v.shape[1]
    lower, pivot = normal.inverse(
        [[v[:, i, j] for j in range(i + 1)] for i in range(d)]
    )
    rows = [
        jnp.stack([lower[max(i, j)][min(i, j)] for j in range(d)], axis=-1)
        for i in range(d)
    ]
    return jnp.stack(rows, axis=1), pivot


def cofactors(
    layout: Layout, solution: Solution, name: str
) -> Float[Array, "member d d"]:
    """The cofactors of each block of a family."""
    block, blocks = layout[name], solution.eliminated
    if block.begin is not None or blocks is None:
        places = layout.places(name, jnp.arange(block.members))
        return solution.cofactor[places[:, :, None], places[:, None, :]]
    return blocks.inverse + jnp.einsum(
        "eik,kl,ejl->eij", blocks.by_kept, solution.cofactor, blocks.by_kept
    )


def redundancies(
    layout: Layout, solution: Solution, term: Term, part: Linearised
) -> Float[Array, "group m"]:
    """The redundancy number of every residual, 1 - a Q aᵀ of its row a; zero where the
    group is not used."""
    own, kept = _divided(layout, term, part)
    product = lambda a, q, b: jnp.einsum("gmi,gij,gmj->gm", a, q, b)
    taken = jnp.zeros_like(part.residuals)
    for name, member, a in kept:
        for other, of_other, b in kept:
            if layout[name].members == layout[other].members == 1:
                # one block for all groups: no copy of it for each
                first = jnp.zeros((), int)
                rows, columns = layout.places(name, first), layout.places(other, first)
                q = solution.cofactor[jnp.ix_(rows, columns)]
                taken = taken + jnp.einsum("gmi,ij,gmj->gm", a, q, b)
                continue
            rows, columns = (
                layout.places(name, member)[:, :, None],
                layout.places(other, of_other)[:, None],
            )
            taken = taken + product(a, solution.cofactor[rows, columns], b)
    for name, member, a in own:
        taken = taken + product(a, cofactors(layout, solution, name)[member], a)
        assert solution.eliminated is not None
        # of eliminated with kept parameters, times -1
        crossed = solution.eliminated.by_kept @ solution.cofactor
        rows = jnp.arange(layout[name].size)[None, :, None]
        for other, of_other, b in kept:
            q = crossed[
                member[:, None, None], rows, layout.places(other, of_other)[:, None]
            ]
            taken = taken - 2 * product(a, q, b)
    return jnp.where(term.mask[:, None], 1 - taken, 0.0)
