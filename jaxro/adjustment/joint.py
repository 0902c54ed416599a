"""The adjustment of several kinds of conditions between blocks of parameters, all at
once."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from . import elimination, normal_equations as normal
from .blocks import (
    Families,
    Linearised,
    Steps,
    close_blocks,
    linearise,
    move,
    normalise,
    residuals,
)
from .elimination import Blocks, Held, Layout, Solution
from .guarded import root, times
from .levenberg_marquardt import DampedStep, promised
from .losses import AbstractLoss
from .m_estimates import spread
from .results import RESULTS
from .terms import Term


class JointAdjustment(eqx.Module):
    """A finished adjustment of blocks of parameters by several terms.

    `parameters`: by the name of their family, as they were given. `normal_matrix` (what
    is left of it after the elimination) and `cofactor`: of all local parameters of the
    kept families, in their order. `residuals` (whitened) and `redundancy`: of each
    term, (group, m). `sigma0` is NaN without a degree of freedom. `pivot`: the least
    part of the diagonal of a parameter that those before it leave.
    """

    parameters: dict[str, PyTree]
    normal_matrix: Float[Array, "kept kept"]
    cofactor: Float[Array, "kept kept"]
    residuals: tuple[Float[Array, "_ _"], ...]
    redundancy: tuple[Float[Array, "_ _"], ...]
    sigma0: Float[Array, ""]
    pivot: Float[Array, ""]
    degrees_of_freedom: Int[Array, ""]
    iterations: Int[Array, ""]
    result: RESULTS
    solution: Solution
    layout: Layout

    def cofactors(self, name: str) -> Float[Array, "member d d"]:
        """The cofactors of the local parameters of each member of a family."""
        return elimination.cofactors(self.layout, self.solution, name)

    def covariance(
        self, name: str, sigma0: ArrayLike | None = None
    ) -> Float[Array, "member d d"]:
        """sigma0² Q of each member of a family: a posteriori, or a priori with the
        sigma0 given."""
        return times(
            self.cofactors(name),
            (self.sigma0 if sigma0 is None else jnp.asarray(sigma0)) ** 2,
        )


class Joint(eqx.Module):
    """The residuals of all terms as a function of displacements of the families, and
    how to correct these."""

    terms: tuple[Term, ...]
    families: dict[str, PyTree]
    layout: Layout
    constraints: Callable | None
    loss: AbstractLoss | None
    held: Held | None

    def __call__(self, steps: Steps) -> list[Array]:
        """The whitened (and, with a loss, transformed) residuals of every term."""
        found = [residuals(term, self.families, steps) for term in self.terms]
        return found if self.loss is None else [self.loss.transform(r) for r in found]

    def correction(self, steps: Steps) -> Steps:
        """What Gauss-Newton subtracts from the displacements."""
        found = self.solve(steps, self.linearise(steps), self.loss)
        blocks = found.eliminated
        return self.layout.divided(found.step, None if blocks is None else blocks.steps)

    def damped(self, steps: Steps, damping: Float[Array, ""]) -> DampedStep:
        """What Levenberg-Marquardt subtracts from the displacements."""
        normals = self._accumulate(self.linearise(steps), self.loss)
        found = elimination.solve(
            elimination.damp(normals, damping), self._constraint(steps)
        )
        blocks = found.eliminated
        of_blocks = None if blocks is None else blocks.steps
        decrement, spread = elimination.along(normals, found.step, of_blocks)
        step = self.layout.divided(found.step, of_blocks)
        return promised(step, decrement, damping, spread)

    def further(self, steps: Steps, step: Steps) -> Steps:
        """The displacements followed by a step."""
        return jax.tree.map(jnp.add, steps, step)

    def linearise(self, steps: Steps) -> list[Linearised]:
        return [
            self._release(term, linearise(term, self.families, steps))
            for term in self.terms
        ]

    def _release(self, term: Term, part: Linearised) -> Linearised:
        """The term without the derivatives by what is held."""
        if self.held is None:
            return part
        fixed = [self.held[name][member] for name, member in term.touches]
        columns = zip(part.columns, fixed, strict=True)
        return Linearised(
            part.residuals, tuple(jnp.where(f[:, None], 0.0, a) for a, f in columns)
        )

    def solve(
        self, steps: Steps, parts: list[Linearised], loss: AbstractLoss | None
    ) -> Solution:
        """The solution of the normal equations with the weights of a loss."""
        normals = self._accumulate(parts, loss)
        solution = elimination.solve(normals, self._constraint(steps))
        if self.held is None:
            return solution
        return elimination.without_held(self.layout, solution, self.held)

    def _accumulate(
        self, parts: list[Linearised], loss: AbstractLoss | None
    ) -> elimination.Normals:
        """The normal equations with the weights of a loss."""
        normals = elimination.accumulate(
            self.layout, self.terms, [_weight(part, loss) for part in parts]
        )
        if self.held is None:
            return normals
        return elimination.hold(self.layout, normals, self.held)

    def _constraint(self, steps: Steps) -> tuple[Array, Array] | None:
        if self.constraints is None:
            return None

        def of_kept(kept):
            steps = self.layout.divided(kept, None)
            families = {
                b.name: move(self.families[b.name], steps[b.name])
                for b in self.layout.kept
            }
            return jnp.atleast_1d(self.constraints(families))  # pyright: ignore[reportOptionalCall]

        kept = jnp.concatenate(
            [steps[block.name].reshape(-1) for block in self.layout.kept]
        )
        slopes, value = jax.jacrev(of_kept)(kept), of_kept(kept)
        if self.held is not None:
            fixed = [self.held[block.name].reshape(-1) for block in self.layout.kept]
            slopes = jnp.where(jnp.concatenate(fixed)[None], 0.0, slopes)
        return slopes, value


def check_families(
    terms: tuple[Term, ...],
    start: Families,
    eliminate: str | None,
    held: Mapping[str, ArrayLike] | None,
) -> None:
    """Raises ValueError for terms and families that do not go together."""
    if unknown := set(held or {}) - set(start):
        raise ValueError(
            f"adjust: {sorted(unknown)} is held, and no family; there are "
            f"{sorted(start)}"
        )
    for name, family in start.items():
        if any(jnp.ndim(a) == 0 for a in jax.tree.leaves(family)):
            raise ValueError(
                f"adjust: the start of family {name!r} has a single number; each number "
                "of a block is an array over all blocks of the family"
            )
    elimination.layout(start, terms, eliminate)


def held_of(layout: Layout, held: Mapping[str, ArrayLike]) -> Held:
    """For every local parameter whether it is held; of a family one flag for all, one
    for each member, or one for each number of each member."""

    def spread_flags(block: Blocks) -> Bool[Array, "_ _"]:
        flags = jnp.asarray(held.get(block.name, False))
        if flags.ndim == 1:
            flags = flags[:, None]
        return jnp.broadcast_to(flags, (block.members, block.size))

    return {block.name: spread_flags(block) for block in layout.blocks}


def adjust_jointly(
    terms: tuple[Term, ...],
    start: Families,
    *,
    eliminate: str | None = None,
    constraints: Callable | None = None,
    held: Mapping[str, ArrayLike] | None = None,
    loss: AbstractLoss | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 30,
) -> JointAdjustment:
    """What `adjust` does for several terms."""
    families = {
        name: jax.tree.map(lambda a: jnp.asarray(a, float), family)
        for name, family in start.items()
    }
    # the optimum does not depend on where it is sought; family by family, because JAX
    # would sort them by name
    families = {
        name: jax.lax.stop_gradient(family) for name, family in families.items()
    }
    layout = elimination.layout(families, terms, eliminate)
    terms = tuple(close_blocks(term, families) for term in terms)
    fixed = None if held is None else held_of(layout, held)
    joint = Joint(terms, families, layout, constraints, loss, fixed)
    origin = {
        block.name: jnp.zeros((block.members, block.size), float)
        for block in layout.blocks
    }
    found = normal.minimise(joint, origin, solver, max_steps)
    solved = {
        name: normalise(move(families[name], step))
        for name, step in found.value.items()
    }
    at_solution = Joint(terms, solved, layout, constraints, loss, fixed)
    return _read(
        at_solution,
        origin,
        found.stats["num_steps"],
        found.result == optx.RESULTS.successful,
    )


def _read(
    joint: Joint, steps: Steps, iterations: Int[Array, ""], converged: Bool[Array, ""]
) -> JointAdjustment:
    """Everything that follows from the linearisation at the solution, from which these
    steps are none."""
    layout, terms, loss = joint.layout, joint.terms, joint.loss
    parts = joint.linearise(steps)
    weighted = joint.solve(steps, parts, loss)
    rows = jnp.concatenate([part.residuals.reshape(-1) for part in parts])
    use = jnp.concatenate(
        [
            jnp.repeat(t.mask, part.residuals.shape[1])
            for t, part in zip(terms, parts, strict=True)
        ]
    )
    known = 0 if joint.constraints is None else joint._constraint(steps)[1].shape[0]  # pyright: ignore[reportOptionalSubscript]
    unknown: Any = layout.total - known
    if joint.held is not None:
        unknown = unknown - sum(jnp.sum(fixed) for fixed in joint.held.values())
    freedom = jnp.sum(use) - unknown
    checked = freedom > 0
    solution = weighted
    if loss is None:
        sigma0 = root(
            jnp.sum(rows**2) / jnp.where(checked, freedom, 1).astype(rows.dtype)
        )
    else:
        if joint.held is not None:
            unknown = unknown.astype(rows.dtype)
        sigma0, factor = spread(loss, rows, use.astype(rows.dtype), unknown)
        factor = jnp.where(checked, factor, 1.0)
        plain = joint.solve(steps, parts, None)
        blocks = plain.eliminated
        blocks = (
            None if blocks is None else blocks._replace(inverse=factor * blocks.inverse)
        )
        solution = plain._replace(cofactor=factor * plain.cofactor, eliminated=blocks)
    pivot = jnp.min(weighted.pivots)
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.diverged)
    result = RESULTS.where(pivot < normal.SINGULAR, RESULTS.rank_deficient, result)
    return JointAdjustment(
        parameters=joint.families,
        normal_matrix=weighted.normal_matrix,
        cofactor=solution.cofactor,
        residuals=tuple(part.residuals for part in parts),
        redundancy=tuple(
            elimination.redundancies(layout, weighted, term, _weight(part, loss))
            for term, part in zip(terms, parts, strict=True)
        ),
        sigma0=jnp.where(checked, sigma0, jnp.nan),
        pivot=pivot,
        degrees_of_freedom=freedom,
        iterations=iterations,
        result=result,
        solution=solution,
        layout=layout,
    )


def _weight(part: Linearised, loss: AbstractLoss | None) -> Linearised:
    """Residuals and columns times the roots of the weights rho'(r²)."""
    if loss is None:
        return part
    weight = jnp.sqrt(loss.weight(part.residuals**2))
    return Linearised(
        weight * part.residuals, tuple(weight[:, :, None] * a for a in part.columns)
    )
