"""Whether the zones of an image differ: the F test of a model against the same model
with its zones merged.

    F = (S0 - S1) / (f0 - f1) / (S1 / f1)

S1 and f1 are the sum of squares and the degrees of freedom with zones; S0 and f0 those
with one focal length, or with one along x and one along y where the model has both. If
the zones do not differ, F has Fisher's distribution with f0 - f1 and f1 degrees of
freedom.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..adjustment import critical_values
from ..camera.zones import Whole
from ..xla.programs import is_traced
from .calibrate import calibrate
from .images import MeasuredImage
from .known import NOTHING, Known
from .models import Model
from .result import Calibration


class ZoneTest(NamedTuple):
    """What the test found, and both calibrations.

    `f`: the statistic, with `above` and `below` degrees of freedom. `probability`: that
    it is larger by chance where the zones do not differ; NaN where one of the
    calibrations is not `usable`.
    """

    f: Float[Array, "*image"]
    above: Float[Array, "*image"]
    below: Float[Array, "*image"]
    probability: Float[Array, "*image"]
    usable: Bool[Array, "*image"]
    with_zones: Calibration
    merged: Calibration


def test_zones(
    measured: MeasuredImage, model: Model, known: Known = NOTHING
) -> ZoneTest:
    """Test whether the focal lengths of the zones of a model differ.

    Brown's coefficients and a field are unknowns of both models. With a field the test
    holds as far as its a priori variance does. Where the focal length changes linearly,
    the combinations that imitate a tilt (`Model.imitated`) are not tested: no image
    tells them from a tilt.

    Works under jit and vmap. Raises ValueError for a model without zones and for a
    known focal length, which would be known of every zone.
    """
    single = merge(model)
    if single.unknowns == model.unknowns:
        raise ValueError(
            "test_zones: the model has one zone only; give one with zones, as "
            "Model(x=rectangles(2, 2))"
        )
    if not is_traced(known) and np.any(np.isfinite(known.focal_sigma)):
        raise ValueError(
            "test_zones: a focal length is known, of every zone alike; give what is "
            "known of the principal place only"
        )
    with_zones, merged = (calibrate(measured, m, known) for m in (model, single))
    squares, fewer_squares = _squares(merged), _squares(with_zones)
    freedom = merged.degrees_of_freedom.astype(float)
    below = with_zones.degrees_of_freedom.astype(float)
    above = freedom - below
    usable = with_zones.usable & merged.usable & (below > 0)
    safe = lambda value: jnp.where(usable & (value > 0), value, 1.0)
    f = (squares - fewer_squares) / safe(above) / safe(fewer_squares / safe(below))
    # to rounding, no zones explain less than one
    f = jnp.where(usable, jnp.maximum(f, 0.0), jnp.nan)
    return ZoneTest(
        f=f,
        above=above,
        below=below,
        probability=critical_values.fisher_p(f, above, below),
        usable=usable,
        with_zones=with_zones,
        merged=merged,
    )


def merge(model: Model) -> Model:
    """The model with one zone for each of its focal lengths."""
    y = None if model.y is None else Whole()
    return dataclasses.replace(model, x=Whole(), y=y)


def _squares(found: Calibration) -> Float[Array, ""]:
    """The sum of squares of an adjustment, with those of what was known beforehand."""
    of_terms = [jnp.sum(rows**2) for rows in found.adjustment.residuals]
    return jnp.sum(jnp.stack(of_terms))
