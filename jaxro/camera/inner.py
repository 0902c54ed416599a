"""Inner parameters of the cameras of a block as unknowns: the focal length, the
principal point, Brown's coefficients, a displacement field. They are common to many
photos, and touched by each of their rays.

Unknown are small numbers in units of the focal length, from the camera that was given:
they are zero where this is right.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .brown import Brown
from .condition import Camera, Measured, Station, misfit, perspective
from .field import Field

NAMES = ("focal", "x0", "y0", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
"""The inner parameters; Brown's as in `camera.brown`."""

MODES = 48
"""Functions of a displacement field for each of dx and dy: the many photos of a block
show what those of a single image leave out."""


class Inner(NamedTuple):
    """Which inner parameters are unknown: the focal length, the principal point,
    `radial` of k1, k2, k3, the `tangential` p1 and p2, and `affinity`, b1 and b2.

    `field`: corrections that change over the photo in any smooth way, as far as the
    other inner parameters and the poses do not make them; True: how smooth and how
    large is found by the evidence (`field_choice`)."""

    focal: bool = True
    principal: bool = True
    radial: int = 0
    tangential: bool = False
    affinity: bool = False
    field: Field | bool = False

    @property
    def free(self) -> tuple[int, ...]:
        """The unknown ones of `NAMES`."""
        radial = [number < self.radial for number in range(3)]
        two = lambda one: [one] * 2
        every = [self.focal, *two(self.principal), *radial]
        every += [*two(self.tangential), *two(self.affinity)]
        return tuple(k for k, is_free in enumerate(every) if is_free)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknown ones."""
        return tuple(NAMES[k] for k in self.free)

    @property
    def brown(self) -> Brown:
        """Which of Brown's coefficients are among them."""
        both = self.affinity, self.affinity
        return Brown(self.radial, self.tangential, *both)

    @property
    def modes(self) -> int:
        """The coefficients of the field, which stand behind the others. Raises
        ValueError where its strength is yet to be found."""
        if self.field is True:
            raise ValueError(
                "Inner: the strength of the displacement field is not known yet: "
                "Inner(field=Field(length, strength)), or orient_block, which finds it"
            )
        return 2 * MODES if self.field else 0

    @property
    def count(self) -> int:
        """The unknowns of a camera."""
        return len(self.free) + self.modes


def names_of(inner: Inner) -> tuple[str, ...]:
    """The unknown inner parameters as `--inner` names them."""
    groups = {
        "focal": inner.focal,
        "principal": inner.principal,
        "k1": inner.radial > 0,
        "k2": inner.radial > 1,
        "k3": inner.radial > 2,
        "tangential": inner.tangential,
        "affinity": inner.affinity,
        "field": bool(inner.field),
    }
    return tuple(name for name, is_unknown in groups.items() if is_unknown)


@dataclass(frozen=True)
class OfRay:
    """The misfit of one ray of a camera with unknown inner parameters, `free` of `NAMES`
    and the coefficients of a field; of the ray its place, and the displacements there
    that each coefficient makes. It is compared by value: compiled programs are kept by
    it."""

    free: tuple[int, ...]

    def __call__(
        self,
        station: Station,
        own: Float[Array, " parameter"],
        point: Float[Array, "3"],
        seen: tuple[Float[Array, "2"], Float[Array, "2 mode"]],
    ):
        parameters = [jnp.zeros(())] * len(NAMES)
        for value, k in enumerate(self.free):
            parameters[k] = own[value]
        camera = Camera(
            principal=jnp.stack(parameters[1:3]),
            focal=jnp.stack([1 + parameters[0]]),
            brown=jnp.stack(parameters[3:]),
            field=own[len(self.free) :],
        )
        place, field = seen
        measured = Measured(place, point, jnp.ones((2, 1)), field)
        return misfit(perspective, station, camera, measured)
