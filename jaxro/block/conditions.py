"""The adjustment of a small block by conditions, the system of the 1982 fragment on
independent models:

    Vᵀ R V = min,    Φ(λ + V, U + ΔU) = 0
    A Q Aᵀ K + B ΔU + W = 0,    Bᵀ K = 0,    V = Q Aᵀ K

linearised at the adjusted measurements until nothing moves, so that it ends at the
minimum itself. It is what `adjust_block` computes, by another way: its unknowns are the
orientation elements of models, and no points. Everything is dense.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..adjustment import RESULTS
from ..adjustment.normal_equations import SINGULAR
from .adjust import Prepared, prepare_block
from .conditions_of_block import problem_of
from .conditions_of_models import Linearised, Problem, advance
from .given import Given
from .measured_block import Ground, MeasuredBlock
from .network import Start, points_of

STEPS = 30
"""Linearisations at most."""

SHORT = 1e-9
"""A step of so many standard deviations, of any correction or of all elements together,
is the last one."""


class ConditionAdjustment(NamedTuple):
    """A block adjusted by conditions.

    `residuals`, `control_residuals`: V, as those of a `BlockAdjustment`. `correlates`:
    K, by the names of the formulas in `conditions_of_models`. `squares`: VᵀRV.
    `rotations` (object to camera) and `centres`: the photos on the ground;
    `centre_deviations`: a posteriori. In a free network the first model stays where the
    start has it, and the deviations are those from its first photo.
    """

    block: MeasuredBlock
    ground: Ground | None
    residuals: Float[np.ndarray, "ray 2"]
    control_residuals: Float[np.ndarray, "known 3"]
    correlates: dict[str, Float[np.ndarray, " _"]]
    squares: float
    degrees_of_freedom: int
    rotations: Float[np.ndarray, "photo 3 3"]
    centres: Float[np.ndarray, "photo 3"]
    centre_deviations: Float[np.ndarray, "photo 3"]
    iterations: int
    result: RESULTS

    @property
    def sigma0(self) -> float:
        """The standard deviation of a coordinate with sigma 1."""
        freedom = self.degrees_of_freedom
        return float(np.sqrt(self.squares / freedom)) if freedom > 0 else np.nan

    def check(self) -> "ConditionAdjustment":
        """This adjustment; RuntimeError with advice where it is not usable."""
        if self.result != RESULTS.successful:
            raise RuntimeError(f"adjust_conditions: {RESULTS[self.result]}")
        return self


def adjust_conditions(
    block: MeasuredBlock, start: Start, ground: Ground | None = None
) -> ConditionAdjustment:
    """Adjust a small block by conditions, from approximate stations and points.

    The same rays and known coordinates take part as in `adjust_block`; without known
    points the network is free. Raises ValueError for more conditions than are meant to
    be adjusted together, for a single photo, for two places of a point on one photo,
    and for neighbouring rays that are parallel. Other failures are values of `result`.
    """
    prepared = prepare_block(Given(block, ground), start)
    problem = problem_of(prepared, start)
    models = len(block.photos) - 1
    # five of each, and the lengths of all bases but one
    unknowns = 6 * models - 1
    # the seven of the ground
    unknowns += 7 if prepared.known else 0
    return _read(prepared, _solve(problem, _deviations(prepared), unknowns))


# -------------------------------------------------------------------------------------
# the system


class Solved(NamedTuple):
    """The end of the iterations: V in standard deviations, K of all conditions, the
    cofactors of U."""

    linearised: Linearised
    corrections: Float[np.ndarray, " lambda"]
    correlates: Float[np.ndarray, " condition"]
    cofactor: Float[np.ndarray, "u u"]
    iterations: int
    result: RESULTS


def _solve(
    problem: Problem, sigma: Float[np.ndarray, " lambda"], unknowns: int
) -> Solved:
    """Corrections, correlates and elements of the minimum."""
    conditions = sum(len(group.rays) for group in problem.groups)
    white, correlates = np.zeros(len(sigma)), np.full(conditions, np.nan)
    cofactor = np.full((unknowns, unknowns), np.nan)
    linearised = _advance(problem, white, np.zeros(unknowns))
    result, number = RESULTS.diverged, 0
    while number < STEPS and result == RESULTS.diverged:
        a, b, w = _assemble(linearised)
        if not np.all(np.isfinite(w)):
            break
        number += 1
        found = _solve_linear(a * sigma[None], b, w, white)
        if found is None:
            result = RESULTS.rank_deficient
            break
        moved = found.corrections - white
        white, correlates, cofactor = (
            found.corrections,
            found.correlates,
            found.cofactor,
        )
        linearised = _advance(linearised.problem, moved * sigma, found.elements)
        if max(np.max(np.abs(moved)), found.length) < SHORT:
            result = RESULTS.successful
    return Solved(linearised, white, correlates, cofactor, number, result)


class Step(NamedTuple):
    """The solution of a linear system: V in standard deviations, K, ΔU, the cofactors
    of U, and how long ΔU is in standard deviations."""

    corrections: Float[np.ndarray, " lambda"]
    correlates: Float[np.ndarray, " condition"]
    elements: Float[np.ndarray, " u"]
    cofactor: Float[np.ndarray, "u u"]
    length: float


def _solve_linear(
    a: Float[np.ndarray, "condition lambda"],
    b: Float[np.ndarray, "condition u"],
    w: Float[np.ndarray, " condition"],
    white: Float[np.ndarray, " lambda"],
) -> Step | None:
    """A Aᵀ K + B ΔU + W = 0, Bᵀ K = 0, with A by measurements of the standard deviation
    1, which are corrected by `white` so far. None for a singular system."""
    from scipy.linalg import solve_triangular

    conditions, unknowns = b.shape
    if unknowns > conditions:
        return None
    # W is that of the measurements themselves
    w = w - a @ white
    try:
        root = np.linalg.cholesky(a @ a.T)
    except np.linalg.LinAlgError:
        return None
    b, w = (solve_triangular(root, part, lower=True) for part in (b, w))
    scale = np.linalg.norm(b, axis=0)
    if not np.all(scale > 0):
        return None
    q, r = np.linalg.qr(b / scale)
    if np.min(np.diagonal(r) ** 2) < SINGULAR:
        return None
    along = q.T @ w
    inverse = solve_triangular(r, np.eye(unknowns)) / scale[:, None]
    correlates = -solve_triangular(root.T, w - q @ along)
    return Step(
        corrections=a.T @ correlates,
        correlates=correlates,
        elements=-inverse @ along,
        cofactor=inverse @ inverse.T,
        length=float(np.linalg.norm(along)),
    )


def _advance(problem: Problem, corrections: np.ndarray, step: np.ndarray) -> Linearised:
    return advance(problem, corrections, step)


def _assemble(linearised: Linearised) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and W of all conditions together."""
    problem = linearised.problem
    rays, known = len(problem.measured.places), len(problem.measured.values)
    parts = []
    for group, one in zip(problem.groups, linearised.conditions, strict=True):
        of_rays, of_known = np.asarray(group.rays), np.asarray(group.known)
        a = np.zeros((len(of_rays), 2 * rays + known))
        row = np.arange(len(a))[:, None]
        a[row, 2 * of_rays] = np.asarray(one.by_places)[:, :, 0]
        a[row, 2 * of_rays + 1] = np.asarray(one.by_places)[:, :, 1]
        a[row, 2 * rays + of_known] = np.asarray(one.by_values)
        parts.append((a, np.asarray(one.by_elements), np.asarray(one.misclosure)))
    a, b, w = (np.concatenate(part) for part in zip(*parts, strict=True))
    return a, b, w


# -------------------------------------------------------------------------------------
# what is read from it


def _deviations(prepared: Prepared) -> Float[np.ndarray, " lambda"]:
    """Standard deviations of all measurements, in the units of the conditions."""
    block, used = prepared.block, prepared.numbered.rays
    of_rays = block.sigma[used] / block.focal[block.photo[used]]
    of_known = points_of(prepared.known).sigma / prepared.frame.length
    return np.concatenate([np.repeat(of_rays, 2), of_known])


def _read(prepared: Prepared, found: Solved) -> ConditionAdjustment:
    block, ground, used = prepared.block, prepared.ground, prepared.numbered.rays
    known = points_of(prepared.known)
    number = 2 * int(np.sum(used))
    of_rays = found.corrections[:number].reshape(-1, 2)
    residuals = np.full((len(block.photo), 2), np.nan)
    sign = np.array([1.0, -1.0])
    residuals[used] = of_rays * block.sigma[used][:, None] * sign
    control = np.full((0 if ground is None else len(ground.points), 3), np.nan)
    control[known.row, known.axis] = found.corrections[number:] * known.sigma

    problem, _, photos, by = found.linearised
    sizes = [len(group.rays) for group in problem.groups]
    parts = np.split(found.correlates, np.cumsum(sizes)[:-1])
    names = [group.formula.__name__ for group in problem.groups]
    squares = float(found.corrections @ found.corrections)
    freedom = sum(sizes) - len(found.cofactor)
    sigma0 = np.sqrt(squares / freedom) if freedom > 0 else np.nan
    cofactors = np.einsum("pau,uv,pav->pa", by, found.cofactor, by, optimize=True)
    length = prepared.frame.length
    return ConditionAdjustment(
        block=block,
        ground=ground,
        residuals=residuals,
        control_residuals=control,
        correlates=dict(zip(names, parts, strict=True)),
        squares=squares,
        degrees_of_freedom=freedom,
        rotations=np.swapaxes(np.asarray(photos.turns), 1, 2),
        centres=prepared.frame.outside(photos.centres),
        centre_deviations=sigma0 * length * np.sqrt(np.maximum(cofactors, 0.0)),
        iterations=found.iterations,
        result=found.result,
    )
