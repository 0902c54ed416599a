"""Options of the compiler, and which of them this compiler knows.

The names are XLA's own, and come and go with its versions.
"""

from functools import lru_cache
from typing import Any

import jax

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

UNSPLIT_LOOPS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""Loops are not split over threads of the compiler's own: for pairs that are spread
over threads as they are. `one_kernel_fusing_points` needs it, as a loop of several
results cannot be split."""

NO_LIBRARY_SUMS = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""No sums by a library, which a kernel cannot call."""


def known_settings(settings: dict[str, Any]) -> dict[str, Any] | None:
    """The settings that the compiler knows, as `jax.jit` takes them."""
    return _known_items(tuple(settings.items()))


@lru_cache
def _known_items(items: tuple[tuple[str, Any], ...]) -> dict[str, Any] | None:
    if jax.default_backend() != "cpu":
        return None

    def has(*some: tuple[str, Any]) -> bool:
        try:
            jax.jit(lambda: 0, compiler_options=dict(some)).lower().compile()
        except jax.errors.JaxRuntimeError:
            return False
        return True

    return dict(items if has(*items) else filter(has, items)) or None
