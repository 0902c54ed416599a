"""The seam to the compiler: the same numbers as plain JAX, sooner.

`with xla.plain():` switches all of it off, `with xla.plain(Trick.SUMS):` one part. The
rows are those of benchmarks/decisions.md that measure the part.

| name | in plain JAX | what it buys | row |
|---|---|---|---|
| `passes.sums` | `jnp.sum` of each array | one pass for all sums | sums |
| `passes.pointwise` | `jax.vmap` | one loop for all results of a point | pointwise |
| `kernels.one_kernel` | the function | a program that is one call | one kernel |
| `kernels.kernel_part` | the function | a loop that is one call | kernel part |
| `kernels.computed_once` | the function | no repeated work | computed once |
| `kernels.while_loop` | `lax.while_loop` | `vmap` traces its body once | loops |
| `kernels.if_needed` | `jnp.where` of both | a batch skips what nobody needs | if needed |
| `selection.where_needed` | `jnp.where` of both | time and memory of a few | selection |
| `settings.RUN_FAST` | no settings | sums in vectors | fast math |
| `settings.COMPILE_FAST` | no settings | sooner first calls | quick compile |
| `settings.WIDE_VECTORS` | no settings | more numbers at once | other settings |
| `programs.compiled` | `jax.jit` | one program for all numbers | (a cache) |
| `programs.jit_in_this_thread` | `jax.jit` | shorter calls of one pair | same thread |
| `slabs.spread` | a loop over parts | all cores, bounded memory | threads |
| `store` | `jax.jit` | later processes compile nothing | kept on disk |
"""

from .settings import Trick as Trick, plain as plain
