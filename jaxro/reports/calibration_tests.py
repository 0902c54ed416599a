"""The F tests of a calibration as names and NumPy values: whether zones differ, and
whether two images have the same distortion."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration import Calibration, Difference, Model, correct
from ..calibration.zone_test import merge


class TestedZones(NamedTuple):
    """The F test of a model with zones against `merged`, the same model with one zone
    for each focal length; `probability`: that F is larger by chance where the zones do
    not differ, NaN where there is no test."""

    merged: Model
    f: float
    above: int
    below: int
    probability: float


def has_zones(model: Model) -> bool:
    """Whether a model has more than one zone of a focal length."""
    return merge(model).unknowns != model.unknowns


class Compared(NamedTuple):
    """The distortion of the image `second` minus that of `first`, both calibrated by
    one `model`.

    `found`: None where a calibration cannot be used; `failed` names these images.
    `refocused`: whether a change of the focal length was taken out. `inside`: which
    nodes lie among the measured places of both images. `sigma0` and `freedom`: of both
    calibrations. `areas`: left, top, right and bottom of both measured areas.
    """

    first: str
    second: str
    model: Model
    refocused: bool
    found: Difference | None
    failed: list[str]
    inside: Bool[np.ndarray, " node"]
    sigma0: tuple[float, float]
    freedom: tuple[int, int]
    areas: Float[np.ndarray, "2 4"]

    @property
    def names(self) -> str:
        """Both images."""
        return f"{self.first} and {self.second}"

    @property
    def counts(self) -> Bool[np.ndarray, " node"]:
        """The nodes that are shown: those inside, if there are any."""
        return self.inside if np.any(self.inside) else np.ones_like(self.inside)

    @property
    def size(self) -> Float[np.ndarray, " node"]:
        """The length of the difference at each node."""
        assert self.found is not None
        return np.hypot(*self.found.difference.T)

    @property
    def in_deviations(self) -> Float[np.ndarray, " node"]:
        """The length of the difference at each node over its standard deviation, that
        is, the root of the sum of both variances: dx alone, or dy, may be known by
        symmetry where it is 0."""
        assert self.found is not None
        deviation = np.hypot(*self.found.deviations.T)
        there = deviation > 0
        return np.where(there, self.size / np.where(there, deviation, 1.0), 0.0)

    def largest(self, values: Float[np.ndarray, " node"]) -> int:
        """The node that counts with the largest value."""
        return int(np.argmax(np.where(self.counts, values, -np.inf)))


def find_inside(
    both: tuple[Calibration, Calibration], nodes: Float[np.ndarray, "node 2"]
) -> Bool[np.ndarray, " node"]:
    """Which nodes lie among the measured places of both images."""
    first, second = (correct(found, nodes).inside for found in both)
    return first & second
