"""Stored sparse matrices as differentiable functions.

Whatever is linear in the unknowns (the prefilter, the lookup of a fixed set of pixels) is computed
once as a matrix; its gradient is the product with the transpose, which is made when first needed.
"""

import functools
from typing import Any

import numba
import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel


class SparseOperator:
    """A matrix [rows, columns] that maps [columns, c] to [rows, c], channel by channel.

    On the CPU a compiled product runs in parallel over rows (each row is summed by one thread, in
    stored order, so the result does not depend on the number of threads); elsewhere torch's CSR
    product does.
    """

    def __init__(self, matrix: scipy.sparse.csr_matrix) -> None:
        """Keep `matrix`; duplicates must be summed already."""
        self.shape: tuple[int, int] = matrix.shape
        self.forward_matrix = CsrMatrix(matrix)

    @functools.cached_property
    def adjoint_matrix(self) -> "CsrMatrix":
        """The transpose, made when the first gradient asks for it."""
        return CsrMatrix(self.forward_matrix.scipy().T.tocsr())

    @property
    def stored(self) -> int:
        """Number of stored entries."""
        return len(self.forward_matrix.values)

    def __call__(self, x: Float[Tensor, "columns c"]) -> Float[Tensor, "rows c"]:
        """The product; differentiable in `x`."""
        product: Tensor = _Product.apply(x, self, False)  # type: ignore[no-untyped-call]
        return product

    def adjoint(self, y: Float[Tensor, "rows c"]) -> Float[Tensor, "columns c"]:
        """The product with the transpose; differentiable in `y`."""
        product: Tensor = _Product.apply(y, self, True)  # type: ignore[no-untyped-call]
        return product


class CsrMatrix:
    """One CSR matrix, with a copy per device and dtype that has asked for it."""

    def __init__(self, matrix: scipy.sparse.csr_matrix) -> None:
        self.pointers: NDArray[np.int64] = matrix.indptr.astype(np.int64)
        self.columns: NDArray[np.int32] = matrix.indices.astype(np.int32, copy=False)
        self.values: NDArray[Any] = matrix.data
        self.shape: tuple[int, int] = matrix.shape
        self._values: dict[np.dtype[Any], NDArray[Any]] = {}
        self._tensors: dict[tuple[torch.device, torch.dtype], Tensor] = {}

    def scipy(self) -> scipy.sparse.csr_matrix:
        """The matrix for scipy, sharing memory."""
        return scipy.sparse.csr_matrix((self.values, self.columns, self.pointers), self.shape)

    def multiply(self, x: Tensor) -> Tensor:
        """The product, without a gradient, on the device and in the dtype of `x`."""
        if x.device.type != "cpu":
            return self.tensor(x) @ x
        dense = x.detach().contiguous().numpy()
        if dense.dtype not in self._values:
            self._values[dense.dtype] = self.values.astype(dense.dtype, copy=False)
        product = np.empty((self.shape[0], dense.shape[1]), dense.dtype)
        _multiply(self.pointers, self.columns, self._values[dense.dtype], dense, product)
        return torch.from_numpy(product)

    def tensor(self, like: Tensor) -> Tensor:
        """The matrix as a torch CSR tensor in the dtype and on the device of `like`."""
        key = (like.device, like.dtype)
        if key not in self._tensors:
            self._tensors[key] = torch.sparse_csr_tensor(
                torch.from_numpy(self.pointers),
                torch.from_numpy(self.columns.astype(np.int64)),
                torch.from_numpy(self.values).to(like.dtype),
                self.shape,
            ).to(like.device)
        return self._tensors[key]


class _Product(torch.autograd.Function):
    """y = A x, dx = A^T dy."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, operator: SparseOperator, transposed: bool) -> Tensor:
        ctx.operator, ctx.transposed = operator, transposed
        return (operator.adjoint_matrix if transposed else operator.forward_matrix).multiply(x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        back = ctx.operator.forward_matrix if ctx.transposed else ctx.operator.adjoint_matrix
        return back.multiply(grad), None, None


@kernel(parallel=True)
def _multiply(
    pointers: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: NDArray[Any],
    x: NDArray[Any],
    product: NDArray[Any],
) -> None:
    """CSR times dense, one row per iteration."""
    for row in numba.prange(len(pointers) - 1):
        for c in range(x.shape[1]):
            product[row, c] = 0.0
        for k in range(pointers[row], pointers[row + 1]):
            for c in range(x.shape[1]):
                product[row, c] += values[k] * x[columns[k], c]
