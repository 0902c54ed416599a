"""The rows of a solution: the whitened residuals of all its conditions and their
derivatives by all parameters. All statistics of residuals start from these numbers."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from ..adjustment.blocks import Families, Linearised, Steps
from ..adjustment.elimination import layout
from ..adjustment.joint import Joint, held_of
from ..adjustment.terms import Term
from ..xla.programs import compiled
from .normalised import Normalised, normalise

SMALL = 1e-9
"""Singular values of the scaled design below which, over the largest, the parameters are
a datum that the conditions leave open."""


class Rows(NamedTuple):
    """The rows of a solution, those of its terms one behind the other: whitened
    `residuals`, their derivatives by all local parameters (zero for held ones), whether
    they take part, and of which `term` and which of its groups they are."""

    residuals: Float[np.ndarray, " row"]
    design: Float[np.ndarray, "row p"]
    use: Bool[np.ndarray, " row"]
    term: Int[np.ndarray, " row"]
    group: Int[np.ndarray, " row"]


def rows(
    terms: Term | Sequence[Term],
    parameters: Families,
    *,
    held: Mapping[str, ArrayLike] | None = None,
) -> Rows:
    """The rows of terms at the parameters of a solution by `adjust`, in the order of
    their families."""
    terms = (terms,) if isinstance(terms, Term) else tuple(terms)
    parts = compiled(_linearise)(terms, dict(parameters), held=held)
    places = layout(parameters, terms, None)
    residuals, designs, uses, numbers, groups = [], [], [], [], []
    for number, (term, part) in enumerate(zip(terms, parts, strict=True)):
        count, m = part.residuals.shape
        design = np.zeros((count, m, places.count))
        for (name, member), columns in zip(term.touches, part.columns, strict=True):
            at = np.asarray(places.places(name, jnp.asarray(member)))
            group, condition = np.arange(count)[:, None, None], np.arange(m)[:, None]
            np.add.at(design, (group, condition, at[:, None, :]), np.asarray(columns))
        residuals.append(np.asarray(part.residuals).ravel())
        designs.append(design.reshape(-1, places.count))
        uses.append(np.repeat(np.asarray(term.mask), m))
        numbers.append(np.full(count * m, number))
        groups.append(np.repeat(np.arange(count), m))
    together = (residuals, designs, uses, numbers, groups)
    return Rows(*(np.concatenate(part) for part in together))


def _linearise(
    terms: tuple[Term, ...],
    families: Families,
    *,
    held: Mapping[str, ArrayLike] | None,
) -> list[Linearised]:
    """The terms linearised where the families are."""
    blocks = layout(families, terms, None)
    fixed = None if held is None else held_of(blocks, held)
    origin: Steps = {
        block.name: jnp.zeros((block.members, block.size)) for block in blocks.blocks
    }
    return Joint(terms, dict(families), blocks, None, None, fixed).linearise(origin)


def normalise_rows(given: Rows) -> Normalised:
    """The normalised residuals of rows. A datum that they leave open (a free network)
    changes nothing in them: p is the rank of the design."""
    use = given.use
    length = np.linalg.norm(given.design[use], axis=0)
    scaled = given.design / np.where(length > 0, length, 1.0)
    left, size, _ = np.linalg.svd(scaled[use], full_matrices=False)
    spanned = left[:, size > SMALL * np.max(size, initial=0.0)]
    columns = np.zeros((spanned.shape[1], len(use)))
    columns[:, use] = spanned.T
    residuals = np.where(use, given.residuals, 0.0)
    return normalise(residuals, list(columns), use, np.sum(residuals**2))
