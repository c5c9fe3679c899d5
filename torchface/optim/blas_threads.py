"""Small systems, one after the other, without threads that wait for each other."""

import functools
from contextlib import AbstractContextManager, nullcontext

from threadpoolctl import ThreadpoolController

_ALONE = 64  # variables up to which OpenBLAS takes one thread by itself to factor a matrix


@functools.cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()  # at the first solve: all libraries are loaded


def one_blas_thread(variables: int | None = None) -> AbstractContextManager[object]:
    """A context in which NumPy's and SciPy's BLAS take one thread, for 16 microseconds; PyTorch's threads stay.

    OpenBLAS gives the product of a frame's Jacobian with itself to as many threads as the machine has cores, which in
    a loop over frames wait for each other: a take's solve took 2.5 times the processor time on two cores.
    """
    if variables is not None and variables <= _ALONE:
        return nullcontext()
    return _controller().limit(limits=1, user_api="blas")
