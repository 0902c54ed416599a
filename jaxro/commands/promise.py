"""`--promise N` of `jaxro clean`: what the intervals of a cleaned pair really hold, by
simulation."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..assessment.correlated import unit_growth
from ..batches.after_cleaning import AfterCleaning, Agreement, repeat_cleaning
from ..geometry.elements import AbstractElements, RelativePose, convert
from ..geometry.pairs import Pair
from ..orientation.express import express
from ..orientation.orient import Orientation
from ..reports.model import USUAL, Results
from ..reports.reader import report_elements, report_numbers
from ..reports.verdicts import Verdicts
from ..tables.measured import one_pair
from .orient import Job

MOST = 10
"""Pairs of a table that are looked at; each takes some seconds."""

SEED = 1


class _Reported(eqx.Module):
    """What is promised of the elements that are reported."""

    truth: Float[Array, "element"]
    base: Float[Array, ""]
    system: type[AbstractElements] = eqx.field(static=True)

    def __call__(self, pair: Pair, orientation: Orientation) -> tuple[Array, Array]:
        """Their errors, and their deviations."""
        told = express(pair, orientation, self.system, self.base)
        values, deviations = report_elements(told.elements, told.cofactor, told.sigma0)
        return jnp.stack(values) - self.truth, jnp.stack(deviations)


def add(job: Job, results: Results, verdicts: Verdicts, repetitions: int) -> Results:
    """The results with what simulation says of their first usable pairs."""
    chosen = np.flatnonzero(results.usable)[:MOST].tolist()
    kept = verdicts.of_points["kept"]
    begins = job.pairs.begins
    promises = {
        k: _of_pair(job, results, k, kept[begins[k] : begins[k + 1]], repetitions)
        for k in chosen
    }
    return replace(results, promises=promises)


def _of_pair(
    job: Job, results: Results, number: int, kept_rows: np.ndarray, repetitions: int
) -> AfterCleaning:
    """What simulation says of one pair with these points kept."""
    procedure, system = job.task.procedure, job.task.system
    assert procedure is not None
    of_pairs = results.of_pairs
    pose = RelativePose(*jnp.asarray(of_pairs["pose"][number]))
    # of elements without a length of the base any one tells the same
    base = jnp.asarray(of_pairs["bx"][number] if "bx" in of_pairs else 1.0, float)
    elements = convert(pose, system, base)
    truth = report_numbers(elements, elements)
    pair = jax.tree.map(jnp.asarray, one_pair(job.pairs, number))
    kept = jnp.asarray(kept_rows, bool)
    unit = None if job.task.sigma_known else float(of_pairs["sigma0"][number])
    # as the deviations of these results allow for the errors of neighbours
    pattern, agreement = results.pattern, None
    if results.growth is not None and pattern is not None:
        agreement = Agreement(float(pattern.rho), float(pattern.length))
        if unit is not None:
            freedom = jnp.asarray(of_pairs["degrees_of_freedom"][number])
            unit *= float(unit_growth(pair.with_mask(kept), pose, freedom, *agreement))
    return repeat_cleaning(
        pair,
        pose,
        kept,
        procedure,
        jax.random.fold_in(jax.random.key(SEED), number),
        repetitions=repetitions,
        sigma0=unit,
        confidence=job.options.confidence or USUAL,
        tell=_Reported(truth, base, system),
        agreement=agreement,
    )
