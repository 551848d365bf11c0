"""Systems of equations with a positive definite band, solved without keeping other threads waiting."""

from __future__ import annotations

from ctypes import CFUNCTYPE, byref, c_char, c_int, c_void_p

import numpy as np
from numba.extending import get_cython_function_address
from scipy.linalg import cho_solve_banded

from tracker.track import F64

# SciPy's own call of LAPACK's factorization holds the interpreter for its 10 ms and more; ctypes lets go of it.
_factorize = CFUNCTYPE(None, *[c_void_p] * 6)(
    get_cython_function_address("scipy.linalg.cython_lapack", "dpbtrf")
)


def solve_banded(band: F64, right: F64) -> F64:
    """x [N] of A x = right [N] by Cholesky's factorization, which overwrites band.

    band: [N, b+1], band[j, o] = A[j + o, j]; contiguous f64, or a copy is overwritten. Raises LinAlgError if A is not
    positive definite; what is NaN stays so.
    """
    band = np.ascontiguousarray(band, np.float64)
    size, width = band.shape
    code = c_int()
    _factorize(
        byref(c_char(b"L")),
        byref(c_int(size)),
        byref(c_int(width - 1)),
        band.ctypes.data,
        byref(c_int(width)),
        byref(code),
    )
    if code.value:
        raise np.linalg.LinAlgError(f"no positive definite band: {code.value} of {size}")
    return cho_solve_banded((band.T, True), right, check_finite=False)
