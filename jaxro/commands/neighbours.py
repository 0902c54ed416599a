"""What neighbours whose errors agree do to the deviations of a table."""

from typing import Any

import jax
import numpy as np

from ..assessment import Pattern
from ..batches.batch import map_batch
from ..batches.buckets import by_size
from ..batches.padding import plan_for
from ..batches.ragged import Ragged
from ..geometry.elements import AbstractElements, DependentElements
from ..reports.columns import is_given
from ..reports.reader import Agreeing, Correlator

AT_ONCE = 1 << 16
"""Points of the pairs that are worked on together."""


def allow(
    pairs: Ragged,
    of_pairs: dict[str, Any],
    system: type[AbstractElements],
    pattern: Pattern | None,
) -> tuple[dict[str, Any], float | None]:
    """The columns of the pairs with the deviations that they have where neighbours agree
    as this `pattern` of the table says, and by how much these have grown, in the median;
    the columns as they are, and None, where its test finds nothing."""
    if pattern is None or not pattern.flagged:
        return of_pairs, None
    # of dependent elements the base is given
    base = (
        of_pairs["bx"] if system is DependentElements else np.ones(len(pairs.lengths))
    )
    correlate = Correlator(system)
    changed: dict[str, Any] = {}
    most = lambda size: max(1, AT_ONCE // size)
    for members, size in by_size(pairs, plan_for(pairs.lengths), most):
        here = lambda column, members=members: np.asarray(column)[members]
        agreeing = Agreeing(
            pair=pairs.pad_to(members, size),
            pose=here(of_pairs["pose"]),
            base=here(base),
            cofactor=here(of_pairs["cofactor"]),
            sigma0=here(of_pairs["sigma0"]),
            degrees_of_freedom=here(of_pairs["degrees_of_freedom"]),
            rho=np.full(len(members), float(pattern.rho)),
            length=np.full(len(members), float(pattern.length)),
        )
        found = jax.tree.map(np.asarray, map_batch(correlate, agreeing))
        for name, values in found.items():
            column = changed.setdefault(name, np.array(of_pairs[name]))
            column[members] = values
    names = [n for n in changed if n.startswith("sd_") and not is_given(n[3:], system)]
    growth = np.stack([changed[name] / of_pairs[name] for name in names])
    there = growth[np.isfinite(growth)]
    return of_pairs | changed, float(np.median(there)) if there.size else None
