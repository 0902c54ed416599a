"""Normalised residuals w of an adjustment, and their correlations: which observations
an adjustment can tell apart.

The whitened residuals are r = (I - H) e, with errors e of standard deviation 1 and the
projection H on the p columns of the design. With the redundancy numbers 1 - h_ii

    w_i = r_i / sqrt(1 - h_ii),    rho_ij = -h_ij / sqrt((1 - h_ii) (1 - h_jj))    (Förstner 1983)

An error that moves w_i by delta moves w_j by rho_ij delta. If |rho| is near 1, nothing
tells whether the error is in i or in j. With one degree of freedom every |rho| is 1.
All n² correlations follow from p numbers a row.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment.critical_values import UNTESTABLE

PerRow = Float[Array, " row"]
Given = Float[Array | np.ndarray, " row"]
Used = Bool[Array | np.ndarray, " row"]


class Normalised(NamedTuple):
    """The normalised residuals `w` of the rows in use, for sigma0 = 1.

    `basis`: p orthonormal columns that span those of the design, each entry divided by
    the root of the redundancy number of its row, so that rho_ij = -b_i · b_j. `tested`:
    the rows in use that others check; w and basis are zero in all other rows.
    `squares`: Σ r² of the rows in use. `freedom`: their number less p, at least zero.
    """

    w: PerRow
    basis: Float[Array, "row p"]
    redundancy: PerRow
    tested: Bool[Array, " row"]
    squares: Float[Array, ""]
    freedom: Float[Array, ""]

    @property
    def parameters(self) -> int:
        """How many parameters the rows determine, p."""
        return self.basis.shape[-1]

    def row(self, one: Int[Array, ""]) -> PerRow:
        """Correlations of the w of one row with the w of all rows: 1 with its own, 0
        where a row is not tested."""
        own = jnp.arange(self.w.shape[0]) == one
        chosen = jnp.sum(jnp.where(own[:, None], self.basis, 0.0), axis=0)
        between = -jnp.sum(self.basis * chosen[None, :], axis=1)
        alone = jnp.where(self.tested, 1.0, 0.0)
        return jnp.where(own, alone, jnp.clip(between, -1.0, 1.0))

    def matrix(self) -> Float[Array, "row row"]:
        """All correlations."""
        between = -jnp.sum(self.basis[:, None, :] * self.basis[None, :, :], axis=-1)
        own = jnp.eye(self.w.shape[0], dtype=bool)
        alone = jnp.where(self.tested, 1.0, 0.0)[:, None]
        return jnp.where(own, alone, jnp.clip(between, -1.0, 1.0))


def normalise(
    residuals: Given,
    spanned: Sequence[Given],
    use: Used,
    squares: ArrayLike,
) -> Normalised:
    """The normalised residuals of whitened `residuals`; `spanned`: p columns that span
    those of the design and are orthonormal over the rows in `use`; `squares`: Σ r² of
    these. Numbers of NumPy stay there until the end."""
    xp: Any = np if isinstance(residuals, np.ndarray) else jnp
    redundancy = xp.where(use, 1 - sum(q * q for q in spanned), 0.0)
    tested = use & (redundancy > UNTESTABLE)
    root = xp.sqrt(xp.where(tested, redundancy, 1.0))
    scale = lambda values: xp.where(tested, values / root, 0.0)
    basis = xp.stack([scale(q) for q in spanned], axis=-1)
    rows = xp.sum(use.astype(basis.dtype))
    return Normalised(
        w=jnp.asarray(scale(residuals)),
        basis=jnp.asarray(basis),
        redundancy=jnp.asarray(redundancy),
        tested=jnp.asarray(tested),
        squares=jnp.asarray(squares),
        freedom=jnp.asarray(xp.maximum(rows - len(spanned), 0.0)),
    )
