"""Procedures that find wrong rows of any adjustment, networks above all, for comparison
by simulation. `ROW_PROCEDURES` is the one list of them.

Each is called with the rows of a solution and the errors of all rows in many trials, and
says in each which rows it leaves out, which it suspects first, and whether it comes to an
end.
"""

import abc
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..adjustment import losses
from ..adjustment.critical_values import UNTESTABLE
from ..statistics.explanations import DOUBT
from ..statistics.promise import draw_errors, orthonormal, repeat_job
from ..statistics.rows import Rows
from ..xla.programs import compiled

TURNS = 100
"""Turns of reweighting at most."""

STILL = 1e-6
"""Change of all residuals below which it ends, in standard deviations."""

Errors = Float[np.ndarray, "trial row"]


class Found(NamedTuple):
    """In every trial: the rows that are suspected first, those that are left out, and
    whether the procedure came to an end."""

    first: Bool[np.ndarray, "trial row"]
    left_out: Bool[np.ndarray, "trial row"]
    finished: Bool[np.ndarray, " trial"]


class AbstractRowProcedure(eqx.Module):
    """What finds wrong rows, with the probability `level` that it rejects any where
    there is no error; `rounds`: of one row each, at most."""

    @abc.abstractmethod
    def __call__(
        self, given: Rows, errors: Errors, *, level: float, rounds: int, seed: int
    ) -> Found:
        """What is found with these errors."""


class Snooping(AbstractRowProcedure):
    """Data snooping (Baarda 1968): the row with the largest |w| (|tau|, Pope 1976) is
    left out, one at a time, while it exceeds the limit. With `together` only where no
    other row explains the misfit as well; else the trial ends undecided, as it does
    where nothing tells two rows apart at all. `each`: the
    level of every test, in place of that of all together."""

    estimated: bool = False
    together: bool = False
    each: float | None = None

    def __call__(
        self, given: Rows, errors: Errors, *, level: float, rounds: int, seed: int
    ) -> Found:
        del seed
        trials = repeat_job(
            given,
            errors,
            level=level if self.each is None else self.each,
            estimated=self.estimated,
            familywise=self.each is None,
            doubt=DOUBT if self.together else 1.0,
            rounds=rounds,
        )
        return Found(trials.named, trials.left_out, trials.accepted)


class Reweighting(AbstractRowProcedure):
    """Robust estimation by iterated weights; all rows are left out whose residual over
    its standard deviation in least squares exceeds a limit, which `calm` trials without
    errors exceed with the probability of the level."""

    loss: losses.AbstractWeight
    calm: int = 2000

    def __call__(
        self, given: Rows, errors: Errors, *, level: float, rounds: int, seed: int
    ) -> Found:
        del rounds
        calm, _ = draw_errors(given, jax.random.key(seed + 1), 0, 0.0, self.calm)
        limit = np.quantile(np.max(self._statistic(given, calm), axis=1), 1 - level)
        statistic = self._statistic(given, errors)
        out = statistic > limit
        first = out & (statistic == np.max(statistic, axis=1, keepdims=True))
        return Found(first, out, np.ones(len(errors), bool))

    def _statistic(self, given: Rows, errors: Errors) -> Errors:
        q, _ = orthonormal(given)
        weigh = compiled(_weigh)
        weights = np.broadcast_to(given.use.astype(float), errors.shape)
        residuals = np.zeros_like(errors)
        for _ in range(TURNS):
            before = residuals
            residuals = errors - _estimate(q, weights, errors) @ q.T
            if np.max(np.abs(residuals - before)) < STILL:
                break
            weights = np.asarray(weigh(self.loss, residuals**2)) * given.use
        redundancy = np.where(given.use, 1 - np.sum(q**2, axis=1), 0.0)
        tested = redundancy > UNTESTABLE
        root = np.sqrt(np.where(tested, redundancy, 1.0))
        return np.where(tested, np.abs(residuals) / root, 0.0)


def _weigh(loss: losses.AbstractWeight, s: Float[Array, "trial row"]) -> Array:
    return jnp.asarray(loss.weight(s))


def displaced(given: Rows, used: Bool[np.ndarray, "trial row"], errors: Errors):
    """Errors of all parameters that the rows determine, in the standard deviations that
    they have with all rows, orthogonal: of least squares with the rows in use."""
    q, _ = orthonormal(given)
    return _estimate(q, (used & given.use).astype(float), errors)


def _estimate(
    q: Float[np.ndarray, "row rank"], weights: Errors, errors: Errors
) -> Float[np.ndarray, "trial rank"]:
    """Weighted least squares of every trial, by the pseudo-inverse where too many rows
    are left out."""
    normal = np.einsum("ri,tr,rj->tij", q, weights, q, optimize=True)
    right = (weights * errors) @ q
    return np.einsum("tij,tj->ti", np.linalg.pinv(normal, hermitian=True), right)


ROW_PROCEDURES: Mapping[str, AbstractRowProcedure] = {
    "data-snooping": Snooping(),
    "tau": Snooping(estimated=True),
    "baarda": Snooping(each=0.001),
    "named-sets": Snooping(together=True),
    "named-sets-tau": Snooping(estimated=True, together=True),
    "huber": Reweighting(losses.Huber()),
    "cauchy": Reweighting(losses.Cauchy()),
    "tukey": Reweighting(losses.Tukey()),
}
"""Every procedure by its name on the command line."""
