"""The door to numba: one decorator for every CPU kernel of the project.

Kernels are compiled on first use and cached on disk. They use no atomics and no reductions across
threads, so a result never depends on the number of threads. Nor does it on the compiler's mood:
reassociation and contraction are off, because numba optimises a parallel kernel once for the
process that compiles it and once more for the disk, and the two took different liberties, so that a
first run ended with other bytes than the second. It costs 6 % of phase 1's CPU.
"""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])

# What never changes the rounding of a finite number: no NaN, no infinity, no sign of zero.
FAST = {"nnan", "ninf", "nsz"}


def kernel(*, parallel: bool = False, fastmath: bool = True) -> Callable[[F], F]:
    """Compile a function over numpy arrays to machine code, cached on disk.

    Args:
        parallel: run `numba.prange` loops on all threads; each iteration must write its own memory.
        fastmath: take it that there are no NaN and inf; switch off where they carry meaning.
    """

    def compile_function(function: F) -> F:
        # Runtime type checkers (tests only) wrap every function; numba needs the bare one.
        bare = inspect.unwrap(function)
        compiled: F = numba.njit(
            cache=True,
            parallel=parallel,
            fastmath=FAST if fastmath else False,
            error_model="numpy",
        )(bare)
        return compiled

    return compile_function
