"""The adjustment of thousands of blocks, most of which never meet.

Three kinds of families: the `eliminated` one (object points), the `linked` one (photos:
those that share a point are linked), and the `common` ones, which have few members and
may be touched by everything (cameras). With y the eliminated, x the linked and c the
common parameters the normal equations are

    [ S   B   Wᵀ ] [x]   [h]
    [ Bᵀ  C   Xᵀ ] [c] = [b],    V block-diagonal, S and W nearly empty,
    [ W   X   V  ] [y]   [g]

and S - Wᵀ V⁻¹ W has a block for each pair of linked members alone. Compiled programs
linearise, eliminate and read the solution (`sparse_normals`); between them the host
factorises this matrix (`sparse_factor`). The numbers are those of `adjust` with the
same terms.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..xla.programs import compiled
from .block_tridiagonal import Levels, arrange
from .blocks import Families, Steps
from .elimination import layout
from .levenberg_marquardt import DampedStep, LevenbergMarquardt, promised
from .normal_equations import SINGULAR
from .results import RESULTS
from .sparse_factor import (
    Carried,
    CofactorMatrix,
    Cofactors,
    Datum,
    Factored,
    Reduced,
    Singular,
    Slots,
    factorise,
    pattern,
    room_for,
)
from .sparse_normals import (
    Data,
    Roles,
    Shifts,
    Solved,
    all_residuals,
    carry_back,
    displace,
    read_solution,
    reduce_normals,
    shapes,
)
from .terms import Term

FIRST_DAMPING = 1e-14
"""The first steps are those of Gauss-Newton: the bends of a long strip have eigenvalues
that any damping to speak of would hide."""

LEAST_WEIGHT = 1e-10
"""A weight is at least this, so that nothing is divided by zero."""

FEWEST = 64
"""Groups for which there is room in each term: fewer ones share their programs."""

SHORT = 1e-6
"""A step of so many standard deviations is the last one: what the next one would be is
the square of it."""

DatumOf = Callable[[Families], Datum]
"""What a free network is referred to, of the displaced families."""


class Problem(NamedTuple):
    """Terms and start with some room, who meets whom, in which order the host works on
    them; and the true numbers: of groups of each term, of members of each family."""

    data: Data
    roles: Roles
    slots: Slots
    levels: Levels
    groups: tuple[int, ...]
    members: dict[str, int]

    def at(self, other: "Problem") -> "Problem":
        """The problem with the families of another one."""
        return self._replace(data=self.data._replace(families=other.data.families))

    def weighted(self, weights: Sequence[Float[np.ndarray, " _"]]) -> "Problem":
        """The problem with the variances of the groups of each term divided by
        weights."""
        terms = map(_weighted, self.data.terms, weights)
        return self._replace(data=self.data._replace(terms=tuple(terms)))


class Minimum(NamedTuple):
    """The problem with its families where the sum of squares is smallest, how many steps
    led there, and whether they came to rest."""

    problem: Problem
    iterations: int
    result: RESULTS


@dataclass(frozen=True)
class SparseAdjustment:
    """A finished adjustment.

    `parameters`: by the name of their family. `residuals` (whitened) and `redundancy`:
    of each term. `cofactors`: of the local parameters of each member of the eliminated
    and of the linked family, and of all common ones together. `shifts`: of each term.
    Without a solution (`result`) cofactors and redundancies are NaN, and there are no
    shifts. `problem`: at the minimum.
    """

    parameters: dict[str, Any]
    residuals: list[Float[np.ndarray, "_ _"]]
    redundancy: list[Float[np.ndarray, "_ _"]]
    shifts: list[Shifts]
    cofactors: dict[str, Float[np.ndarray, "_ _ _"]]
    common_cofactor: Float[np.ndarray, "_ _"]
    sigma0: float
    degrees_of_freedom: int
    pivot: float
    iterations: int
    result: RESULTS
    problem: Problem
    datum: DatumOf | None
    referred: CofactorMatrix | None = None

    @cached_property
    def all_cofactors(self) -> CofactorMatrix:
        """The cofactor matrix of all parameters, of which any columns can be had. The
        normal equations are made and factorised once more, unless the network was
        `referred` to another datum. Raises `Singular`."""
        if self.referred is not None:
            return self.referred
        problem = self.problem
        system = _System(problem, self.datum)
        factored, _, carried = system.factorise(_origin(problem), jnp.zeros(()))
        return Cofactors(factored, carried, problem.data.pattern)

    def common_cofactor_of(self, name: str) -> Float[np.ndarray, "_ _"]:
        """The part of `common_cofactor` that belongs to one family, all members
        together."""
        roles = self.problem.roles
        k = roles.common.index(name)
        size = self.problem.members[name] * roles.common_sizes[k]
        own = slice(roles.begin[k], roles.begin[k] + size)
        return self.common_cofactor[own, own]

    def rows(
        self, members: Mapping[str, Sequence[int] | Int[np.ndarray, " _"]]
    ) -> Int[np.ndarray, " row"]:
        """Where the local parameters of members stand in `all_cofactors`, in the order
        of the families and of their members."""
        found = [np.zeros(0, int)]
        for name, numbers in members.items():
            begin, size = self.problem.roles.place(name)
            member = np.asarray(numbers, int)[:, None]
            found.append((begin + member * size + np.arange(size)[None]).ravel())
        return np.concatenate(found)


def adjust_sparse(
    terms: tuple[Term, ...],
    start: Families,
    *,
    eliminate: str,
    linked: str,
    datum: DatumOf | None = None,
    max_steps: int = 30,
) -> SparseAdjustment:
    """What `adjust` does for several terms, of thousands of blocks. `eliminate` and
    `linked` name the two large families; in all others everything may meet everything.

    Conditions are functions of modules or compared by value: programs are kept by them.
    It cannot be traced, because the host works between the programs. Failures are
    values of `result`.
    """
    problem = prepare(terms, start, eliminate=eliminate, linked=linked)
    return read(minimise(problem, datum=datum, max_steps=max_steps), datum)


def prepare(
    terms: tuple[Term, ...], start: Families, *, eliminate: str, linked: str
) -> Problem:
    """The `Problem` of terms and start. Raises ValueError as `adjust` does."""
    families = {
        name: jax.tree.map(lambda a: np.asarray(a, float), family)
        for name, family in start.items()
    }
    blocks = layout(families, terms, eliminate)
    members = {b.name: b.members for b in blocks.blocks}
    groups = tuple(len(term.mask) for term in terms)
    terms = tuple(_term_with_room(term) for term in terms)
    large = (eliminate, linked)
    families |= {name: with_room(families[name]) for name in large}
    common = [b for b in blocks.blocks if b.name not in large]
    sizes = [b.members * b.size for b in common]
    point, block, use, direct = [], [], [], []
    for term in terms:
        of = lambda role, term=term: [
            np.asarray(member) for name, member in term.touches if name == role
        ]
        own, others = of(eliminate), of(linked)
        direct += [(a, b) for k, a in enumerate(others) for b in others[k + 1 :]]
        for member in others if own else ():
            point.append(own[0])
            block.append(member)
            use.append(np.asarray(term.mask))
    number = room_for(members[linked])
    together = [np.concatenate(a) for a in (point, block, use)]
    meets, slots = pattern(*together, direct, number)
    size = blocks[linked].size
    roles = Roles(
        eliminated=eliminate,
        linked=linked,
        common=tuple(b.name for b in common),
        points=room_for(members[eliminate]),
        point_size=blocks[eliminate].size,
        blocks=number,
        block_size=size,
        begin=tuple(int(k) for k in np.cumsum([0, *sizes[:-1]])) if sizes else (),
        common_sizes=tuple(b.size for b in common),
        common_total=sum(sizes),
        slots=room_for(len(slots.first)),
    )
    levels = arrange(slots.first, slots.second, number, size)
    data = Data(terms, families, meets)
    return Problem(data, roles, slots, levels, groups, members)


def with_room(tree: Any, least: int = 1) -> Any:
    """All leaves with more rows, at least so many, which repeat the first one."""

    def longer(a: ArrayLike) -> np.ndarray:
        # in NumPy: JAX would compile this for every number of rows
        rows = np.asarray(a)
        missing = max(room_for(len(rows)), least) - len(rows)
        return np.concatenate([rows, np.repeat(rows[:1], missing, axis=0)])

    return jax.tree.map(longer, tree)


def _term_with_room(term: Term) -> Term:
    """The term with more groups, which are not in use."""
    columns = term.observations, term.cofactor, [m for _, m in term.touches]
    observations, cofactor, touched = with_room(columns, FEWEST)
    names = [name for name, _ in term.touches]
    use = np.zeros(max(room_for(len(term.mask)), FEWEST), bool)
    use[: len(term.mask)] = np.asarray(term.mask)
    return Term(
        term.condition,
        observations,
        cofactor,
        touches=list(zip(names, touched, strict=True)),
        mask=use,
    )


def _weighted(term: Term, weight: Float[np.ndarray, " group"]) -> Term:
    factor = np.ones(len(term.mask))
    factor[: len(weight)] = 1 / np.maximum(weight, LEAST_WEIGHT)
    divided = lambda q: np.asarray(q) * factor.reshape(-1, *(1,) * (np.ndim(q) - 1))
    cofactor = jax.tree.map(divided, term.cofactor)
    return Term(
        term.condition,
        term.observations,
        cofactor,
        touches=term.touches,
        mask=term.mask,
    )


def residuals_of(problem: Problem) -> list[Float[np.ndarray, "_ _"]]:
    """The whitened residuals of each term where the families stand."""
    rows = _System(problem, None)(_origin(problem))
    return [np.asarray(a)[:n] for a, n in zip(rows, problem.groups, strict=True)]


@dataclass(frozen=True)
class _System:
    """The residuals as a function of displacements, and how to correct these, as
    `LevenbergMarquardt` asks for them."""

    problem: Problem
    datum: DatumOf | None

    def __call__(self, steps: Steps) -> list[Array]:
        return all_residuals(steps, self.problem.data)

    def damped(self, steps: Steps, damping: Float[Array, ""]) -> DampedStep:
        """What is subtracted from the displacements. Raises `Singular`."""
        data, roles = self.problem.data, self.problem.roles
        factored, reduced, carried = self.factorise(steps, damping)
        x, c = factored.step(np.asarray(reduced.h), np.asarray(reduced.b))
        common = {}
        for k, name in enumerate(roles.common):
            own = steps[name].shape
            begin = roles.begin[k]
            common[name] = c[begin : begin + own[0] * own[1]].reshape(own)
        x, c, common = jax.device_put((x, c, common))
        y, decrement, spread = carry_back((x, c, carried), data)
        step = {roles.linked: x, roles.eliminated: y, **common}
        whole = {name: step[name] for name in steps}, decrement, damping, spread
        return compiled(promised)(*whole)

    def further(self, steps: Steps, step: Steps) -> Steps:
        """The displacements followed by a step."""
        return _further(steps, step)

    def datum_at(self, steps: Steps) -> Datum:
        """The datum of the displaced families, with rows for the room of the linked
        one."""
        data, roles, members = (
            self.problem.data,
            self.problem.roles,
            self.problem.members,
        )
        found = self.datum(trimmed(displace(data.families, steps), members))  # pyright: ignore[reportOptionalCall]
        missing = roles.blocks - found.rows.shape[1]
        return found._replace(rows=np.pad(found.rows, ((0, 0), (0, missing), (0, 0))))

    def factorise(
        self, steps: Steps, damping: Float[Array, ""]
    ) -> tuple[Factored, Reduced, Carried]:
        """The factorised matrix, the reduced system, and what leads back."""
        problem = self.problem
        data, roles = problem.data, problem.roles
        reduced, carried = reduce_normals(steps, damping, data, roles=roles)
        datum = None if self.datum is None else self.datum_at(steps)
        factored = factorise(reduced, problem.slots, problem.levels, datum)
        return factored, reduced, carried


def minimise(
    problem: Problem,
    *,
    datum: DatumOf | None = None,
    max_steps: int = 30,
) -> Minimum:
    """The least sum of squares, from where the families stand."""
    system = _System(problem, datum)
    solver = LevenbergMarquardt(rtol=SHORT, damping=FIRST_DAMPING)
    function = lambda steps, system: (system(steps), None)
    steps, done, result = _origin(problem), False, RESULTS.diverged
    state = solver.init(function, steps, system, {}, None, None, frozenset())
    number = 0
    while number < max_steps and not done:
        number += 1
        try:
            steps, state, _ = solver.step(
                function, steps, system, {}, state, frozenset()
            )
        except Singular:
            result = RESULTS.rank_deficient
            break
        done = bool(state.done)
    if done:
        result = RESULTS.successful
    data = problem.data._replace(families=displace(problem.data.families, steps))
    return Minimum(problem._replace(data=data), number, result)


def read(found: Minimum, datum: DatumOf | None = None) -> SparseAdjustment:
    """Everything that follows from the linearisation at the minimum."""
    problem = found.problem
    data, roles, members = problem.data, problem.roles, problem.members
    system, steps = _System(problem, datum), _origin(problem)
    rows = residuals_of(problem)
    used = sum(
        int(np.sum(np.asarray(term.mask))) * r.shape[1]
        for term, r in zip(data.terms, rows, strict=True)
    )
    unknowns = members[roles.eliminated] * roles.point_size
    unknowns += members[roles.linked] * roles.block_size + roles.common_total
    unknown = lambda name, d: np.full((members[name], d, d), np.nan)
    adjusted = SparseAdjustment(
        parameters=trimmed(data.families, members),
        residuals=rows,
        redundancy=[np.full_like(r, np.nan) for r in rows],
        shifts=[],
        cofactors={
            roles.eliminated: unknown(roles.eliminated, roles.point_size),
            roles.linked: unknown(roles.linked, roles.block_size),
        },
        common_cofactor=np.full((roles.common_total,) * 2, np.nan),
        sigma0=np.nan,
        degrees_of_freedom=used - unknowns,
        pivot=0.0,
        iterations=found.iterations,
        result=found.result,
        problem=problem,
        datum=datum,
    )
    try:
        factored, _, carried = system.factorise(steps, jnp.zeros(()))
    except Singular:
        return replace(adjusted, result=RESULTS.rank_deficient)
    freedom = adjusted.degrees_of_freedom
    freedom += 0 if factored.free is None else len(factored.free.datum.rest)
    q, crossed, corner = factored.select(problem.slots)
    room = np.zeros((roles.slots - len(q), *q.shape[1:]))
    cofactors = np.concatenate([q, room]), crossed, corner
    solved = carried, Solved(*jax.device_put(cofactors))
    every = read_solution(solved, data, roles=roles)
    of_groups = lambda parts: [
        jax.tree.map(lambda a, n=n: np.asarray(a)[:n], part)
        for part, n in zip(parts, problem.groups, strict=True)
    ]
    pivot = min(factored.pivot, float(np.min(carried.pivots)))
    singular = pivot < SINGULAR
    squares = sum(float(np.sum(r**2)) for r in rows)
    return replace(
        adjusted,
        redundancy=of_groups(every.redundancy),
        shifts=of_groups(every.shifts),
        cofactors={
            roles.eliminated: np.asarray(every.points)[: members[roles.eliminated]],
            roles.linked: q[: members[roles.linked]],
        },
        common_cofactor=corner,
        sigma0=float(np.sqrt(squares / freedom)) if freedom > 0 else np.nan,
        degrees_of_freedom=freedom,
        pivot=pivot,
        result=RESULTS.rank_deficient if singular else found.result,
    )


# -------------------------------------------------------------------------------------
# programs between those of `sparse_normals`: single operations would be compiled for
# every number of members


def _origin(problem: Problem) -> Steps:
    """No displacement."""
    found = shapes(problem.data, problem.roles)
    return jax.device_put({name: np.zeros(shape) for name, shape in found.items()})


@compiled
def _further(steps: Steps, step: Steps) -> Steps:
    return jax.tree.map(jnp.add, steps, step)


def trimmed(families: dict[str, Any], members: dict[str, int]) -> dict[str, Any]:
    """The families without their room."""
    return {
        name: jax.tree.map(lambda a, n=members[name]: np.asarray(a)[:n], family)
        for name, family in families.items()
    }
