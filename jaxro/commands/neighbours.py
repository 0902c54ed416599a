"""What neighbours whose errors agree do to the deviations of a table."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from ..assessment import Pattern
from ..batches import table_neighbours
from ..batches.ragged import Ragged
from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    RelativePose,
    convert,
)
from ..reports.columns import element_names, is_given
from ..reports.reader import report_all
from ..xla.programs import compiled


def allow(
    pairs: Ragged,
    of_pairs: dict[str, Any],
    system: type[AbstractElements],
    pattern: Pattern | None,
) -> tuple[dict[str, Any], float | None]:
    """The columns of the pairs with the deviations that they have where neighbours agree
    as this `pattern` of the table says, and by how much these have grown, in the median;
    the columns as they are, and None, where its test is not sure of it."""
    if pattern is None or not pattern.sure:
        return of_pairs, None
    elements = elements_of_poses(of_pairs, system)
    asked = elements, of_pairs["cofactor"], of_pairs["degrees_of_freedom"]
    cofactor = table_neighbours.grow(pairs, *asked, pattern)
    _, deviations = report_all(elements, cofactor, of_pairs["sigma0"])
    told = zip(element_names(system), map(np.asarray, deviations), strict=True)
    changed = {f"sd_{name}": sd for name, sd in told if not is_given(name, system)}
    growth = np.stack([sd / of_pairs[name] for name, sd in changed.items()])
    roots = np.sqrt(np.diagonal(cofactor, axis1=1, axis2=2))
    correlation = cofactor / (roots[:, :, None] * roots[:, None, :])
    changed |= {"cofactor": cofactor, "correlation": correlation}
    there = growth[np.isfinite(growth)]
    return of_pairs | changed, float(np.median(there)) if there.size else None


def elements_of_poses(
    of_pairs: dict[str, Any], system: type[AbstractElements]
) -> AbstractElements:
    """The elements of the pairs in a system."""
    poses = of_pairs["pose"]
    # of dependent elements the base is given
    base = of_pairs["bx"] if system is DependentElements else np.ones(len(poses))
    return _elements(poses, base, system=system)


@compiled
def _elements(
    poses: Float[Array, "pair 7"],
    base: Float[Array, " pair"],
    *,
    system: type[AbstractElements],
) -> AbstractElements:
    """The elements of the poses in a system."""
    of_one = lambda pose, base: convert(RelativePose(*pose), system, base)
    return jax.vmap(of_one)(poses, base)
