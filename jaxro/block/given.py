"""What a block is adjusted from: measurements, what is known, and what is unknown beside
photos and points. Approximate values are not part of it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..camera.field import Field
from ..camera.inner import Inner
from .bars import Bars, no_bars
from .measured_block import Ground, MeasuredBlock, nothing_known


class Given(NamedTuple):
    """The places on photos; what is known of the ground; which inner parameters of the
    cameras are unknown; and known distances. None for what there is not."""

    block: MeasuredBlock
    ground: Ground | None = None
    inner: Inner | None = None
    bars: Bars | None = None

    def with_field(self, field: Field) -> "Given":
        """The same, with a displacement field of its cameras."""
        inner = Inner(False, False) if self.inner is None else self.inner
        return self._replace(inner=inner._replace(field=field))

    @property
    def known(self) -> Ground:
        """What is known of the ground, if it is nothing."""
        return nothing_known() if self.ground is None else self.ground

    @property
    def lengths(self) -> Bars:
        """The bars, if there are none."""
        return no_bars() if self.bars is None else self.bars


class Wrong(NamedTuple):
    """What was left out: rays, known coordinates, and bars; `settled`: whether nothing
    more is beyond the limit of the tests."""

    rays: Bool[np.ndarray, " ray"]
    control: Bool[np.ndarray, "known 3"]
    bars: Bool[np.ndarray, " bar"]
    settled: bool = False

    def __or__(self, other: "Wrong") -> "Wrong":
        return Wrong(
            self.rays | other.rays,
            self.control | other.control,
            self.bars | other.bars,
        )

    def __bool__(self) -> bool:
        return any(bool(np.any(part)) for part in self[:3])


def nothing_wrong(given: Given) -> Wrong:
    """Nothing was left out."""
    return Wrong(
        rays=np.zeros(len(given.block.photo), bool),
        control=np.zeros((len(given.known.points), 3), bool),
        bars=np.zeros(len(given.lengths.one), bool),
    )
