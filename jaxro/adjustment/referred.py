"""A finished free network, referred to another datum (S-transformation, Baarda 1973).

Movements G change no residual. A datum R asks that R x = 0 of the displacements x of
some parameters; each solution is moved there by P = 1 - G (R G)⁻¹ R, and the cofactors
become

    Q' = P Q Pᵀ = Q - G K Fᵀ - F Kᵀ Gᵀ + G K (R F) Kᵀ Gᵀ,    K = (R G)⁻¹,  F = Q Rᵀ,

whatever datum Q had before. Residuals, redundancies and sigma0 stay, and so does where
the network lies.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ..xla.programs import compiled
from .sparse import SparseAdjustment
from .sparse_factor import CofactorMatrix, change_datum
from .sparse_normals import Data, Roles, Shifts, along_rows

Rows = Mapping[str, Float[np.ndarray, "_ _ _"]]
"""Numbers of the parameters of each family, (member, d, k); zero for families that are not
named."""


class Referred(NamedTuple):
    """The cofactor matrix of all parameters on a datum."""

    before: CofactorMatrix
    movements: Float[np.ndarray, "row k"]
    rows: Float[np.ndarray, "row k"]
    held: Float[np.ndarray, "k k"]
    spread: Float[np.ndarray, "row k"]

    @property
    def number(self) -> int:
        """Of all parameters."""
        return len(self.movements)

    def times(self, right: Float[np.ndarray, "row c"]) -> Float[np.ndarray, "row c"]:
        """Q' times some columns."""
        less = right - self.rows @ (self.held.T @ (self.movements.T @ right))
        found = self.before.times(less)
        return found - self.movements @ (self.held @ (self.rows.T @ found))

    def between(self, rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
        """Q' of some parameters."""
        q = self.before.between(rows)
        return q + self._more(self.movements[rows], self.spread[rows])

    def own(
        self, q: Float[np.ndarray, "member d d"], rows: Int[np.ndarray, "member d"]
    ) -> Float[np.ndarray, "member d d"]:
        """Q' of each member by itself, from Q."""
        return q + self._more(self.movements[rows], self.spread[rows])

    def _more(self, g: np.ndarray, f: np.ndarray) -> np.ndarray:
        """Q' - Q between parameters with these rows of G and of F."""
        return change_datum((g, f), (g, f), self.held, self.rows.T @ self.spread)


def refer(found: SparseAdjustment, movements: Rows, datum: Rows) -> SparseAdjustment:
    """The adjustment with cofactors and shifts on the datum R = `datum`ᵀ; `movements`:
    all that the network is free to do."""
    before = found.all_cofactors
    g, r = (_in_rows(found, before.number, of) for of in (movements, datum))
    held = np.linalg.inv(r.T @ g)
    referred = Referred(before, g, r, held, before.times(r))
    cofactors = {}
    for name, q in found.cofactors.items():
        rows = found.rows({name: np.arange(len(q))}).reshape(q.shape[:2])
        cofactors[name] = referred.own(q, rows)
    roles, members = found.problem.roles, found.problem.members
    rows = found.rows({name: np.arange(members[name]) for name in roles.common})
    common = referred.own(found.common_cofactor[None], rows[None])[0]
    shifts = _shifts(found, referred)
    return replace(
        found,
        cofactors=cofactors,
        common_cofactor=common,
        shifts=shifts,
        referred=referred,
    )


def _in_rows(
    found: SparseAdjustment, number: int, of: Rows
) -> Float[np.ndarray, "row k"]:
    """The numbers of all parameters, in their order."""
    columns = next(iter(of.values())).shape[-1]
    out = np.zeros((number, columns))
    for name, values in of.items():
        rows = found.rows({name: np.arange(len(values))})
        out[rows] = values.reshape(len(rows), columns)
    return out


def _shifts(found: SparseAdjustment, referred: Referred) -> list[Shifts]:
    """N⁻¹ Aᵀ of all terms on the datum: less G K (A F)ᵀ."""
    problem = found.problem
    data, roles = problem.data, problem.roles
    spread = jax.device_put(_by_family(referred.spread, roles))
    along = _along(spread, data, roles=roles)
    g = _by_family(referred.movements, roles)
    moved = []
    every = zip(found.shifts, along, data.terms, problem.groups, strict=True)
    for shift, of_rows, term, groups in every:
        # (group, k, m): by which movements the solution goes back to the datum
        back = np.einsum("kl,gml->gkm", referred.held, np.asarray(of_rows)[:groups])
        links, own = [], None
        touched = [(n, np.asarray(m)[:groups]) for n, m in term.touches]
        linked = [member for name, member in touched if name == roles.linked]
        for member, before in zip(linked, shift.links, strict=True):
            links.append(before - g[roles.linked][member] @ back)
        for name, member in touched:
            if name == roles.eliminated and shift.own is not None:
                own = shift.own - g[name][member] @ back
        moved.append(Shifts(links, own))
    return moved


def _by_family(
    values: Float[np.ndarray, "row k"], roles: Roles
) -> dict[str, Float[np.ndarray, "_ _ _"]]:
    """Rows of all parameters by their families."""
    linked, common = roles.blocks * roles.block_size, roles.common_total
    k = values.shape[1]
    out = {
        roles.linked: values[:linked].reshape(roles.blocks, -1, k),
        roles.eliminated: values[linked + common :].reshape(roles.points, -1, k),
    }
    ends = *roles.begin[1:], common
    for j, name in enumerate(roles.common):
        own = values[linked + roles.begin[j] : linked + ends[j]]
        out[name] = own.reshape(-1, roles.common_sizes[j], k)
    return out


@compiled
def _along(
    values: dict[str, Float[Array, "_ _ _"]], data: Data, *, roles: Roles
) -> list[Float[Array, "_ _ _"]]:
    """A times columns of all parameters, of each term."""
    return along_rows(values, data, roles)
