"""What is known of a pair after some steps of a procedure that judges in steps, and what
such a step is."""

import abc
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry.elements import RelativePose, vertical
from ..geometry.pairs import Pair
from ..xla.kernels import if_needed
from ..xla.passes import count
from .fading import is_heavy
from .search import ALL_BLOCKS, Found

RIVALS = 2
"""Consensuses beside the one that is believed of which is told, at most: so many make it
plain that the photos do not say it themselves."""


class Decision(NamedTuple):
    """The pose, the points that agree with it, whether that is believed, and the factor
    of the standard deviations of the pair by which they were judged."""

    pose: RelativePose
    use: Bool[Any, "*pairs point"]
    believed: Bool[Any, "*pairs"]
    scale: Float[Any, "*pairs"]


class Sought(NamedTuple):
    """What is known between the parts of a search: how many times it has begun, whether
    it is to begin `again`, the points that it is to search among, what it has found,
    and the factor of the standard deviations that this shows; the fewest points that
    are worth a look, which is zero but for a search for rivals of what is believed,
    and the most blocks of subsets that it may take."""

    number: Int[Any, "*pairs"]
    again: Bool[Any, "*pairs"]
    among: Bool[Any, "*pairs point"]
    found: Found
    scale: Float[Any, "*pairs"]
    fewest: Float[Any, "*pairs"]
    blocks: Int[Any, "*pairs"]

    @property
    def for_rival(self) -> Bool[Any, "*pairs"]:
        """Whether what is sought is a rival of what is believed."""
        return self.fewest > 0


class Witnesses(NamedTuple):
    """What is to be said of the base of a pose: that a rotation explains all points but
    some that agree by chance (`turned`), that such points carry it (`few`), or that the
    other pose of a plane explains the others (`second`), which is asked of points that
    are `flat`; the `chance` that a wrong point agrees."""

    turned: Bool[Any, "*pairs"]
    few: Bool[Any, "*pairs"]
    flat: Bool[Any, "*pairs"]
    second: Bool[Any, "*pairs"]
    chance: Float[Any, "*pairs"]


class Contest(NamedTuple):
    """The consensuses of a pair (`rivals`). Of the one that is believed: the logarithm of
    the expected number of accidents as good, zero where that was not asked, and whether
    it does not stand out. Of each rival the same number, zero where there is none, its
    pose (qw, qx, qy, qz, bx, by, bz), and its points."""

    own: Float[Any, "*pairs"]
    contested: Bool[Any, "*pairs"]
    accidents: Float[Any, "*pairs rival"]
    pose: Float[Any, "*pairs rival 7"]
    use: tuple[Bool[Any, "*pairs point"], ...]


class OfPoints(NamedTuple):
    """What a judgement holds of every point."""

    use: Any
    among: Any
    unchecked: Any
    doubtful: Any
    rivals: Any


class Judgement(NamedTuple):
    """What is known of a pair after some steps of a procedure: the decision, how many
    points are `kept` and how many are `out` by it, whether their noise is `heavy`
    (`fading`), what was `sought`, the witnesses of the base, the points that are out as
    they are `unchecked`, the `doubtful` points, of which some are wrong, though
    nothing tells which, and the consensuses in contest."""

    decision: Decision
    kept: Float[Any, "*pairs"]
    out: Float[Any, "*pairs"]
    heavy: Bool[Any, "*pairs"]
    sought: Sought
    base: Witnesses
    unchecked: Bool[Any, "*pairs point"]
    doubtful: Bool[Any, "*pairs point"]
    contest: Contest

    def decided(self, pair: Pair, decision: Decision) -> "Judgement":
        """The same with another decision about the pair, which has no unusable points
        and the sigma that its points are judged by."""
        pose, use = decision.pose, decision.use
        return self._replace(
            decision=decision,
            kept=count(use),
            out=count(pair.mask & ~use),
            heavy=is_heavy(pair, pose, use),
        )

    def split(self) -> tuple["Judgement", OfPoints]:
        """What is of the pair, and what is of its points."""
        own = self.decision.use, self.sought.among, self.unchecked, self.doubtful
        of_points = OfPoints(*own, self.contest.use)
        return self.join(OfPoints(*[None] * len(of_points))), of_points

    def join(self, of_points: OfPoints) -> "Judgement":
        """What `split` has taken apart."""
        return self._replace(
            decision=self.decision._replace(use=of_points.use),
            sought=self.sought._replace(among=of_points.among),
            unchecked=of_points.unchecked,
            doubtful=of_points.doubtful,
            contest=self.contest._replace(use=of_points.rivals),
        )


def nothing_known(focal: Float[Any, "*pairs"], mask: Bool[Any, "..."]) -> Judgement:
    """The judgement before the first step, of pairs with these left focal lengths and
    points; no two of its arrays are the same."""
    zero, one, no = lambda: focal * 0, lambda: focal * 0 + 1, lambda: focal * 0 > 1
    none, number = lambda: mask & False, lambda: (focal * 0).astype(int)

    def pose() -> RelativePose:
        numbers = one(), zero(), zero(), zero(), one(), zero(), zero()
        return jax.tree.unflatten(_structure(), numbers)

    found = Found(
        pose=pose(),
        cost=zero(),
        blocks=number(),
        counted=zero(),
        enough=zero(),
        agreed=zero(),
        asked=zero(),
    )
    contest = Contest(
        own=zero(),
        contested=no(),
        accidents=zero()[..., None].repeat(RIVALS, -1),
        pose=zero()[..., None, None].repeat(RIVALS, -2).repeat(7, -1),
        use=tuple(none() for _ in range(RIVALS)),
    )
    return Judgement(
        decision=Decision(pose=pose(), use=none(), believed=no(), scale=one()),
        kept=zero(),
        out=zero(),
        heavy=no(),
        sought=Sought(
            number=number(),
            again=~no(),
            among=~none() & mask,
            found=found,
            scale=one(),
            fewest=zero(),
            blocks=number() + ALL_BLOCKS,
        ),
        base=Witnesses(turned=no(), few=no(), flat=no(), second=no(), chance=one()),
        unchecked=none(),
        doubtful=none(),
        contest=contest,
    )


@lru_cache
def _structure() -> Any:
    """Of a pose, to be filled with arrays of NumPy or JAX."""
    number = jax.ShapeDtypeStruct((), np.float64)
    return jax.tree.structure(jax.eval_shape(vertical, number))


OF_DECISION = ("decision", "kept", "out", "heavy")
"""The fields of a judgement that another decision changes."""


class AbstractStep(eqx.Module):
    """A step of a procedure, a program of its own: it judges the pairs that are open to
    it. Most pairs are open to few steps.

    `reads` and `changes`: the fields of a judgement that it looks at, and that it tells
    anew."""

    reads: eqx.AbstractClassVar[tuple[str, ...]]
    changes: eqx.AbstractClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        """Whether pairs of which so much is known are open to it; in NumPy or JAX."""

    @abc.abstractmethod
    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """What is known of an open pair after the step; works under jit and vmap."""


def if_open(step: AbstractStep, pair: Pair, known: Judgement) -> Judgement:
    """What is known of a pair after a step, if it is open to it; within a program."""

    def judge(open_: Bool[Array, ""]) -> Judgement:
        decision = known.decision._replace(use=known.decision.use & open_)
        own = pair.with_mask(pair.mask & open_)
        return step.judge(own, known._replace(decision=decision))

    return if_needed(step.is_open(known), judge, known)
