"""The door to numba: one decorator for every CPU kernel of the project.

Kernels are compiled on first use and cached on disk. They use no atomics and no reductions across
threads, so a result never depends on the number of threads.
"""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(*, parallel: bool = False, fastmath: bool = True) -> Callable[[F], F]:
    """Compile a function over numpy arrays to machine code, cached on disk.

    Args:
        parallel: run `numba.prange` loops on all threads; each iteration must write its own memory.
        fastmath: allow reassociation and contraction; switch off where NaN or inf carry meaning.
    """

    def compile_function(function: F) -> F:
        # Runtime type checkers (tests only) wrap every function; numba needs the bare one.
        bare = inspect.unwrap(function)
        compiled: F = numba.njit(
            cache=True, parallel=parallel, fastmath=fastmath, error_model="numpy"
        )(bare)
        return compiled

    return compile_function
