"""The elements of relative orientation in three systems, and the conversions between
them.

Every system says the same two things: the rotation R that turns an image vector of the
right photo into the frame of the left one, and the base b in that frame,

    left X = λ p1,    right X = b + μ R p2,    p = (x, y, -f).

* `RelativePose`: unit base and unit quaternion. Exists for every position of the
  photos; the default.
* `IndependentElements` (phi1, kappa1, omega2, phi2, kappa2): the papers' alpha, chi,
  omega', alpha', chi'. The base is the X axis of the model; left R1 = R_alpha R_chi,
  right R2 = R_alpha' R_omega' R_chi' (Dorozhinsky 1971).
* `DependentElements` (by, bz, omega, phi, kappa): left photo fixed, bx given; right M =
  R3(kappa) R2(phi) R1(omega) turns the object into the image (Wolf, Mikhail).

All fields are scalars (arrays over the pairs in a batch); angles are radians.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..adjustment.parameters import AbstractParameters, Step
from . import rotations as rot
from .rotations import Matrix, Vector

Scalar = Float[Array, "..."]
TINY = 1e-100
"""What stands for a zero that would be divided by."""

NOTHING = 1e-6
"""Component of a unit base that cannot be told from zero."""


class AbstractElements(AbstractParameters):
    """Five numbers that orient the right photo to the left one."""

    names: eqx.AbstractClassVar[tuple[str, ...]]
    angles: eqx.AbstractClassVar[tuple[bool, ...]]

    @abc.abstractmethod
    def relative(self) -> tuple[Matrix, Vector]:
        """(R, b): right-photo vectors into the left frame (up to a positive factor),
        base in the left frame."""

    @abc.abstractmethod
    def model_frame(self) -> Matrix:
        """The rotation R1 that turns vectors of the left photo into the model frame of
        this system."""

    @property
    def count(self) -> int:
        return len(self.names)

    def arguments(self) -> tuple[Matrix, Vector]:
        return self.relative()

    @abc.abstractmethod
    def move(self, step: Step | Float[Array, " count"]) -> "AbstractElements":
        """The elements after a small displacement of their five (local) parameters."""

    @abc.abstractmethod
    def normalise(self) -> "AbstractElements":
        """The same elements in their standard form (unit quaternion and base)."""

    @abc.abstractmethod
    def values(self) -> tuple[Scalar, ...]:
        """The five element values in the order of `names`; for RelativePose the local
        parameters, all zero."""

    @classmethod
    @abc.abstractmethod
    def from_relative(
        cls, rotation: Matrix, base: Vector, length: Scalar
    ) -> "AbstractElements":
        """The elements of a rotation matrix and unit base; `length` is what the system
        takes as given of the base."""

    @classmethod
    @abc.abstractmethod
    def scale(cls, base: Vector, length: Scalar) -> Scalar:
        """What a unit base is multiplied by in the model of the system."""

    @classmethod
    @abc.abstractmethod
    def exist(cls, base: Vector, length: Scalar) -> Bool[Array, "..."]:
        """Whether the system has elements for such a unit base, of which this is
        given."""


class RelativePose(AbstractElements):
    """Unit quaternion (qw, qx, qy, qz) of R and unit base (bx, by, bz), both in the
    frame of the left photo.

    Five local parameters displace it: half the rotation vector enters as the vector
    part of a quaternion (1, w/2), and the base moves by stereographic projection from
    its antipode. Both are polynomials: no angle, no square root, no singular position
    nearer than half a turn.
    """

    qw: Scalar
    qx: Scalar
    qy: Scalar
    qz: Scalar
    bx: Scalar
    by: Scalar
    bz: Scalar

    names: ClassVar[tuple[str, ...]] = ("rx", "ry", "rz", "b1", "b2")
    angles: ClassVar[tuple[bool, ...]] = (True, True, True, True, True)

    @property
    def quaternion(self) -> Float[Array, "... 4"]:
        """(w, x, y, z), Hamilton convention, right-photo vectors into the left
        frame."""
        return jnp.stack([self.qw, self.qx, self.qy, self.qz], axis=-1)

    @property
    def base(self) -> Float[Array, "... 3"]:
        """The base vector in the left frame."""
        return jnp.stack([self.bx, self.by, self.bz], axis=-1)

    def relative(self) -> tuple[Matrix, Vector]:
        rotation = rot.from_quaternion(self.qw, self.qx, self.qy, self.qz)
        return rotation, (self.bx, self.by, self.bz)

    def turn_base(self, sign: Scalar) -> "RelativePose":
        """The pose with its base times 1 or -1, which the condition does not tell
        apart."""
        quaternion = self.qw, self.qx, self.qy, self.qz
        return RelativePose(*quaternion, *rot.scale((self.bx, self.by, self.bz), sign))

    def model_frame(self) -> Matrix:
        return rot.identity(self.qw)

    def move(self, step: Step | Float[Array, " count"]) -> "RelativePose":
        a, b, c, u, v = step
        a, b, c = a / 2, b / 2, c / 2
        w, x, y, z = self.qw, self.qx, self.qy, self.qz
        base = (self.bx, self.by, self.bz)
        first, second = rot.tangents(base)
        along = 1 - (u * u + v * v) / 4
        return RelativePose(
            w - x * a - y * b - z * c,
            x + w * a + y * c - z * b,
            y + w * b + z * a - x * c,
            z + w * c + x * b - y * a,
            *(
                along * p + u * q + v * r
                for p, q, r in zip(base, first, second, strict=True)
            ),
        )

    def step_to(self, near: "RelativePose") -> Step:
        """The step that moves this pose to one that is near, to first order."""
        w, turn = self.qw, (self.qx, self.qy, self.qz)
        other = near.qx, near.qy, near.qz
        crossed = rot.cross(turn, other)
        rotation = (
            2 * (w * n - near.qw * o - c)
            for o, n, c in zip(turn, other, crossed, strict=True)
        )
        tangents = rot.tangents((self.bx, self.by, self.bz))
        base = near.bx, near.by, near.bz
        return *rotation, *(rot.dot(tangent, base) for tangent in tangents)

    def slopes(
        self, function: Callable, x: Step = (), *, bilinear: bool = False
    ) -> tuple[Any, list[Any]]:
        """The right photo turns about its own axes: R [e_k]x is R with two columns
        exchanged, one of them negative, and the third zero. The base moves by its
        stereographic coordinates."""
        rotation, base = self.at(x).arguments()

        def along(argument: int, direction: Any) -> Any:
            at = [rotation, base]
            if bilinear:
                at[argument] = direction
                return function(*at)
            of_one = lambda value: function(*at[:argument], value, *at[argument + 1 :])
            return jax.jvp(of_one, (at[argument],), (direction,))[1]

        columns = rot.transpose(rotation)
        nothing = (jnp.zeros_like(base[0]),) * 3
        slopes = []
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            minus = tuple(-entry for entry in columns[i])
            turned = {k: nothing, i: columns[j], j: minus}
            turning = rot.transpose((turned[0], turned[1], turned[2]))
            slopes.append(along(0, turning))
        first = self.bx, self.by, self.bz
        for number, tangent in enumerate(rot.tangents(first), 3):
            # d/du of the base in `move`, (1 - u²/4 - v²/4) b + u q + v r
            moving = rot.add_scaled(tangent, first, -x[number] / 2) if x else tangent
            slopes.append(along(1, moving))
        return function(rotation, base), slopes

    def further(self, x: Step, step: Step) -> Step:
        """Of two rotations with halved parameters a and then e those of both are (a + e
        + a x e) / (1 - a . e)."""
        a, e = ((s[0] / 2, s[1] / 2, s[2] / 2) for s in (x, step))
        twice = 2 / (1 - rot.dot(a, e))
        turn = (
            twice * (p + q + r) for p, q, r in zip(a, e, rot.cross(a, e), strict=True)
        )
        return *turn, x[3] + step[3], x[4] + step[4]

    def normalise(self) -> "RelativePose":
        """The same pose with quaternion and base of unit length, qw >= 0."""
        q = (self.qw, self.qx, self.qy, self.qz)
        length = jnp.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
        scale = jnp.where(self.qw < 0, -1.0, 1.0) / length
        return RelativePose(
            *(entry * scale for entry in q), *rot.unit((self.bx, self.by, self.bz))
        )

    def values(self) -> tuple[Scalar, ...]:
        return (jnp.zeros_like(self.qw),) * 5

    @classmethod
    def from_relative(
        cls, rotation: Matrix, base: Vector, length: Scalar
    ) -> "RelativePose":
        del length
        return cls(*rot.to_quaternion(rotation), *base)

    @classmethod
    def scale(cls, base: Vector, length: Scalar) -> Scalar:
        return length

    @classmethod
    def exist(cls, base: Vector, length: Scalar) -> Bool[Array, "..."]:
        return jnp.ones_like(length, bool)


class IndependentElements(AbstractElements):
    """phi1, kappa1, omega2, phi2, kappa2 (the papers' alpha, chi, omega', alpha',
    chi'); base (b, 0, 0)."""

    phi1: Scalar
    kappa1: Scalar
    omega2: Scalar
    phi2: Scalar
    kappa2: Scalar

    names: ClassVar[tuple[str, ...]] = ("phi1", "kappa1", "omega2", "phi2", "kappa2")
    angles: ClassVar[tuple[bool, ...]] = (True, True, True, True, True)

    def relative(self) -> tuple[Matrix, Vector]:
        back = rot.transpose(self.model_frame())
        right = rot.product(
            rot.r_alpha(self.phi2),
            rot.product(rot.r_omega(self.omega2), rot.r_chi(self.kappa2)),
        )
        return rot.product(back, right), (back[0][0], back[1][0], back[2][0])

    def model_frame(self) -> Matrix:
        return rot.product(rot.r_alpha(self.phi1), rot.r_chi(self.kappa1))

    def move(self, step: Step | Float[Array, " count"]) -> "IndependentElements":
        return IndependentElements(
            *(value + s for value, s in zip(self.values(), step, strict=True))
        )

    def normalise(self) -> "IndependentElements":
        return self

    def values(self) -> tuple[Scalar, ...]:
        return self.phi1, self.kappa1, self.omega2, self.phi2, self.kappa2

    @classmethod
    def from_relative(
        cls, rotation: Matrix, base: Vector, length: Scalar
    ) -> "IndependentElements":
        del length
        phi1 = jnp.arctan2(-base[2], rot.length(base[0], base[1]))
        kappa1 = jnp.arctan2(-base[1], base[0])
        left = rot.product(rot.r_alpha(phi1), rot.r_chi(kappa1))
        phi2, omega2, kappa2 = rot.alpha_omega_chi(rot.product(left, rotation))
        return cls(phi1, kappa1, omega2, phi2, kappa2)

    @classmethod
    def scale(cls, base: Vector, length: Scalar) -> Scalar:
        return length

    @classmethod
    def exist(cls, base: Vector, length: Scalar) -> Bool[Array, "..."]:
        return (
            (rot.length(base[0], base[1]) >= NOTHING)
            & jnp.isfinite(length)
            & (length > 0)
        )


class DependentElements(AbstractElements):
    """by, bz (unit of bx), omega, phi, kappa; bx is given and fixes the scale of the
    model."""

    by: Scalar
    bz: Scalar
    omega: Scalar
    phi: Scalar
    kappa: Scalar
    bx: Scalar

    names: ClassVar[tuple[str, ...]] = ("by", "bz", "omega", "phi", "kappa")
    angles: ClassVar[tuple[bool, ...]] = (False, False, True, True, True)

    def relative(self) -> tuple[Matrix, Vector]:
        return rot.transpose(rot.m_omega_phi_kappa(self.omega, self.phi, self.kappa)), (
            self.bx,
            self.by,
            self.bz,
        )

    def model_frame(self) -> Matrix:
        return rot.identity(self.bx)

    def move(self, step: Step | Float[Array, " count"]) -> "DependentElements":
        return DependentElements(
            *(value + s for value, s in zip(self.values(), step, strict=True)), self.bx
        )

    def normalise(self) -> "DependentElements":
        return self

    def values(self) -> tuple[Scalar, ...]:
        return self.by, self.bz, self.omega, self.phi, self.kappa

    @classmethod
    def from_relative(
        cls, rotation: Matrix, base: Vector, length: Scalar
    ) -> "DependentElements":
        scale = cls.scale(base, length)
        return cls(
            scale * base[1],
            scale * base[2],
            *rot.omega_phi_kappa(rot.transpose(rotation)),
            length,
        )

    @classmethod
    def scale(cls, base: Vector, length: Scalar) -> Scalar:
        # an infinite scale would make the derivatives of a whole batch 0 * inf, though
        # nobody uses it
        return length / jnp.where(base[0] == 0, TINY, base[0])

    @classmethod
    def exist(cls, base: Vector, length: Scalar) -> Bool[Array, "..."]:
        return (jnp.abs(base[0]) >= NOTHING) & jnp.isfinite(length) & (length != 0)


def vertical(like: Scalar) -> RelativePose:
    """The normal case of aerial photography: parallel axes, base along x."""
    one, zero = jnp.ones_like(like), jnp.zeros_like(like)
    return RelativePose(qw=one, qx=zero, qy=zero, qz=zero, bx=one, by=zero, bz=zero)


def to_pose(elements: AbstractElements) -> RelativePose:
    """Any elements as a unit `RelativePose`."""
    if isinstance(elements, RelativePose):
        return elements.normalise()
    rotation, base = elements.relative()
    return RelativePose(*rot.to_quaternion(rotation), *rot.unit(base))


def convert(
    pose: AbstractElements, system: type[AbstractElements], length: Scalar
) -> AbstractElements:
    """Any elements in another system. `length`: bx of the dependent system, on the side
    where the right photo lies (the other sign gives the elements of the opposite base);
    unused by the others."""
    if not isinstance(pose, RelativePose):
        pose = to_pose(pose)
    if system is RelativePose:
        return pose
    rotation, base = pose.relative()
    return system.from_relative(rotation, base, length)


def essential_matrix(elements: AbstractElements) -> Matrix:
    """E with p1ᵀ E p2 = b . (p1 x R p2) = 0."""
    return essential(*elements.relative())


def essential(rotation: Matrix, base: Vector) -> Matrix:
    """E of R and b; column c is (column c of R) x b."""
    first, second, third = rot.transpose(rotation)
    columns = rot.cross(first, base), rot.cross(second, base), rot.cross(third, base)
    return rot.transpose(columns)
