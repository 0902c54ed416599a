"""Covariances of the model points of an oriented pair."""

import numpy as np
from jaxtyping import Float

from ..geometry.pairs import Pair
from ..orientation.model_errors import differentiate
from ..orientation.result import Orientation
from ..xla.programs import compiled


def model_covariances(
    pair: Pair, orientation: Orientation, sigma0: float | None = None
) -> Float[np.ndarray, "point 3 3"]:
    """The covariance of (X, Y, Z) of every model point of the pair that was oriented, in
    the frame and scale of `orientation.model`; zero where masked.

        C = sigma0² (J Q Jᵀ + sigma² K Kᵀ)

    J: derivatives of the point by the elements, Q their cofactors; K: by the four
    coordinates, times the roots of their cofactors where these are not 1. There is no
    mixed term, because the corrected coordinates are independent of the misclosures,
    from which the elements come. `sigma0`: the estimated one if None. Of first order.
    """
    found = _differentiate(pair, orientation.elements)
    at, by_elements, own = map(np.asarray, found)
    model = np.stack([np.asarray(c) for c in orientation.model], axis=-1)
    length = float(np.sum(at * model) / max(np.sum(np.square(at)), 1e-300))
    known = float(orientation.sigma0) if sigma0 is None else sigma0
    across = lambda a: np.swapaxes(a, 1, 2)
    of_elements = by_elements @ np.asarray(orientation.cofactor) @ across(by_elements)
    return (known * length) ** 2 * (of_elements + own @ across(own))


_differentiate = compiled(differentiate)
