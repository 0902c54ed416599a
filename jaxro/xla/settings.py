"""Options of the compiler, which of them this compiler knows, and the switch that does
without them and all else of the seam.

The names of options are XLA's own, and come and go with its versions.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from enum import Flag, auto
from functools import lru_cache
from typing import Any

import jax


class Trick(Flag):
    """What the seam does otherwise than plain JAX."""

    SUMS = auto()
    POINTWISE = auto()
    ONE_KERNEL = auto()
    KERNEL_PART = auto()
    COMPUTED_ONCE = auto()
    WHILE_LOOP = auto()
    IF_NEEDED = auto()
    SELECTION = auto()
    SAME_THREAD = auto()
    FAST_MATH = auto()
    OLD_GENERATOR = auto()
    QUICK_COMPILE = auto()
    OTHER_SETTINGS = auto()


ALL = ~Trick(0)

_switched_off = jax.make_user_context(Trick(0))


def plain(tricks: Trick = ALL) -> AbstractContextManager:
    """`with plain():` traces and compiles everything as plain JAX, or, of the tricks
    given, without these alone. The numbers are the same to rounding.

    It holds in the thread that enters it, and for the programs that are made in it, in
    whatever thread they run. What was compiled outside of it is not used inside.
    """
    return _switched_off(tricks)


def switched_off() -> Trick:
    """The tricks that are switched off here: none, but in `plain`."""
    return _switched_off.value


def is_plain(trick: Trick) -> bool:
    """Whether a trick is switched off here."""
    return trick in _switched_off.value


def keep_plain(function: Callable) -> Callable:
    """The function for another thread, where the same is switched off as here."""
    off = switched_off()

    def within(*arguments):
        with plain(off):
            return function(*arguments)

    return within


RUN_FAST = {
    "xla_cpu_enable_fast_math": True,
    "xla_cpu_fast_math_honor_nans": True,
    "xla_cpu_fast_math_honor_infs": True,
    "xla_cpu_fast_math_honor_division": True,
    "xla_cpu_fast_math_honor_functions": True,
}
"""Sums may be reordered, without which the CPU cannot vectorise them; NaN, infinity and
division stay exact."""

WIDE_VECTORS = {"xla_cpu_prefer_vector_width": 512}
"""Vectors of eight numbers where the processor has them."""

COMPILE_FAST = {
    **RUN_FAST,
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
}
"""For single pairs: the older code generator, which jaxlib has up to 0.11.0, and a
lower level of optimisation."""

COMPILE_FASTEST = {**COMPILE_FAST, "xla_backend_optimization_level": 0}
"""For what runs once or for an instant: no optimisation of the machine code."""

FEW, MOMENT = 32, 1 << 9
"""Points up to which a pair of a user's call, or all pairs of a call that is made once,
are worked on in no time, whatever the compiler does."""


def settings_for(points: int, most: int = FEW) -> dict[str, Any]:
    """The settings of a program of one pair with so many points; `most` as FEW or
    MOMENT."""
    return COMPILE_FASTEST if points <= most else COMPILE_FAST


UNSPLIT_LOOPS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""Loops are not split over threads of the compiler's own: for pairs that are spread
over threads as they are. `one_kernel_fusing_points` needs it, as a loop of several
results cannot be split."""

NO_LIBRARY_SUMS = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""No sums by a library, which a kernel cannot call."""


def compiler_options() -> dict[str, Any] | None:
    """Options of `jax.jit` by which a function of single pairs is compiled in about half
    of the time: `jax.jit(function, compiler_options=jaxro.compiler_options())`.

    For derivatives of an orientation, say, whose programs are large. A function of very
    many pairs runs sooner without. None where the compiler knows none of them.
    """
    return known_settings(COMPILE_FAST)


def known_settings(settings: dict[str, Any]) -> dict[str, Any] | None:
    """The settings that the compiler knows, as `jax.jit` takes them; those that are
    switched off are left out."""
    return _known_items(tuple(settings.items()), switched_off())


def _trick_of(name: str) -> Trick:
    """The trick that an option of the compiler belongs to."""
    if "fast_math" in name:
        return Trick.FAST_MATH
    return {
        "xla_cpu_use_fusion_emitters": Trick.OLD_GENERATOR,
        "xla_backend_optimization_level": Trick.QUICK_COMPILE,
    }.get(name, Trick.OTHER_SETTINGS)


@lru_cache
def _known_items(
    items: tuple[tuple[str, Any], ...], off: Trick
) -> dict[str, Any] | None:
    if jax.default_backend() != "cpu":
        return None

    def has(*some: tuple[str, Any]) -> bool:
        try:
            jax.jit(lambda: 0, compiler_options=dict(some)).lower().compile()
        except jax.errors.JaxRuntimeError:
            return False
        return True

    wanted = [item for item in items if _trick_of(item[0]) not in off]
    return dict(wanted if has(*wanted) else filter(has, wanted)) or None
