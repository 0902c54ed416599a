"""The example of `jaxro block`: a simulated block with one wrong place and some check
points, and the tables that a user would have of it."""

from dataclasses import dataclass

import numpy as np

from ...batches.ragged import Ragged
from ...block.measured_block import Ground
from ...block.mock_block import Flight, mock_block, pairs_of

WRONG = 25.0
"""Error of the wrong place in standard deviations."""


@dataclass(frozen=True)
class SimulatedBlock:
    """A simulated block as `block.orient_block` takes it."""

    flight: Flight
    left: list[str]
    right: list[str]
    pairs: Ragged
    points: list[str]
    ground: Ground

    @property
    def names(self) -> list[str]:
        """Of the pairs."""
        both = zip(self.left, self.right, strict=True)
        return [f"{left}/{right}" for left, right in both]

    def tables(self) -> dict[str, str]:
        """pairs.csv and ground.csv, from which the block can be read again."""
        return {"pairs.csv": self._pairs(), "ground.csv": self._ground()}

    def _pairs(self) -> str:
        pairs = self.pairs
        of_row = np.repeat(np.arange(len(self.left)), pairs.lengths)
        places = (pairs.x_left, pairs.y_left, pairs.x_right, pairs.y_right)
        lines = ["left,right,point,x_left,y_left,x_right,y_right"]
        for k, point, row in zip(
            of_row, self.points, np.stack(places, axis=1).tolist(), strict=True
        ):
            cells = [self.left[k], self.right[k], point, *map(repr, row)]
            lines.append(",".join(cells))
        return "\n".join(lines) + "\n"

    def _ground(self) -> str:
        lines = ["point,X,Y,Z,sX,sY,sZ,role"]
        known = self.ground
        for name, at, sigma, check in zip(
            known.points,
            known.coordinates.tolist(),
            known.sigma.tolist(),
            known.check,
            strict=True,
        ):
            role = "check" if check else "control"
            lines.append(",".join([name, *map(repr, [*at, *sigma]), role]))
        return "\n".join(lines) + "\n"


def simulate(strips: int = 1, models: int = 6, seed: int = 1) -> SimulatedBlock:
    """Strips of so many models each; a third of the known points within the block are
    check points."""
    flight = Flight(strips=strips, models=models)
    made = mock_block(seed, flight, control_every=2)
    block, ground = made.block, made.ground
    # a place that several others check
    photos = np.bincount(block.point, minlength=len(block.points))
    most = np.flatnonzero(photos[block.point] == np.max(photos))
    x = block.x.copy()
    y = block.y.copy()
    y[most[len(most) // 2]] += WRONG * flight.sigma
    check = np.zeros(len(ground.points), bool)
    check[2:-2:3] = True
    left, right, pairs, points = pairs_of(block._replace(x=x, y=y), seed)
    return SimulatedBlock(
        flight=flight,
        left=left,
        right=right,
        pairs=pairs,
        points=points,
        ground=ground._replace(check=check),
    )
