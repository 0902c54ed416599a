"""The lens of Brown (1971): corrections of a measured place, as functions of its
coordinates about the principal place.

    dx = x (k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 x²) + 2 p2 x y + b1 x + b2 y
    dy = y (k1 r² + k2 r⁴ + k3 r⁶) + p2 (r² + 2 y²) + 2 p1 x y

The corrected place is the measured one plus these: no iteration leads from a
measurement to its ray.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

NAMES = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
"""The coefficients in their order; their units are powers of the unit of x."""

COEFFICIENTS = len(NAMES)
"""How many there are."""

POWERS = (2, 4, 6, 1, 1, 0, 0)
"""The power of the unit of length by which each coefficient is divided."""


class Brown(eqx.Module):
    """Which of Brown's coefficients are unknowns; the others are zero.

    `radial`: k1, k1 and k2, or all three; `tangential`: p1 and p2. `affinity`: b1, for
    a scale of x that is not that of y, which is part of the focal lengths where these
    differ along x and y. `shear`: b2, for axes that are not at right angles.
    """

    radial: int = eqx.field(static=True, default=3)
    tangential: bool = eqx.field(static=True, default=True)
    affinity: bool = eqx.field(static=True, default=True)
    shear: bool = eqx.field(static=True, default=True)

    @property
    def free(self) -> tuple[bool, ...]:
        """Which coefficients of `NAMES` are unknowns."""
        radial = tuple(power < self.radial for power in range(3))
        return (*radial, *(self.tangential,) * 2, self.affinity, self.shear)


def corrections(place: Float[Array, "2"], k: Float[Array, "7"]) -> Float[Array, "2"]:
    """dx, dy of one place about the principal place."""
    return jnp.sum(patterns(place) * k[None], axis=1)


def patterns(place: Float[Array, "2"]) -> Float[Array, "2 7"]:
    """The corrections that the coefficients make at one place if they are 1."""
    x, y = place[0], place[1]
    r2 = x * x + y * y
    r4, zero = r2 * r2, jnp.zeros_like(x)
    of_x = [x * r2, x * r4, x * r2 * r4, r2 + 2 * x * x, 2 * x * y, x, y]
    of_y = [y * r2, y * r4, y * r2 * r4, 2 * x * y, r2 + 2 * y * y, zero, zero]
    return jnp.stack([jnp.stack(of_x), jnp.stack(of_y)])
