"""Normal equations of parameters of each light and of common ones, solved in O(lights).

Their matrix has arrow form: a block for each light, and a border. The blocks are eliminated one by
one (Schur complement).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class ArrowSystem:
    """Normal equations of two parameters of each of L lights, and of three common ones.

    Attributes
    ----------
    block
        Matrix of each light's own parameters, (L, 2, 2).
    border
        Matrix of a light's and the common parameters, (L, 2, 3).
    corner
        Matrix of the common parameters, (3, 3).
    one, other
        Right sides, (L, 2) and (3,).
    """

    block: Float64Array
    border: Float64Array
    corner: Float64Array
    one: Float64Array
    other: Float64Array

    def solve(
        self, damping: float, otherwise: ArrowSystem | None = None
    ) -> tuple[Float64Array, Float64Array]:
        """Return the lights' parameters, (L, 2), and the common ones, (3,).

        Parameters
        ----------
        damping
            Marquardt's factor of the diagonals, >= 0.
        otherwise
            Gives the common parameters where they have no minimum here.
        """
        damped = self.block + damping * self.block * np.eye(2)
        inverse = np.linalg.inv(damped)
        through = inverse @ self.border
        schur = self.corner + damping * np.diag(np.diag(self.corner))
        schur = schur - np.einsum("kia,kib->ab", self.border, through)
        local = np.einsum("kij,kj->ki", inverse, self.one)
        right = self.other - np.einsum("kia,ki->a", self.border, local)
        if otherwise is not None and np.linalg.eigvalsh(schur)[0] <= 0.0:
            shared = otherwise.solve(damping)[1]
        else:
            shared = np.linalg.solve(schur, right)
        return local - through @ shared, shared

    def covariance(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return covariances of each light's two parameters, with the common ones, and of those."""
        inverse = np.linalg.inv(self.block)
        through = inverse @ self.border
        shared = np.linalg.inv(self.corner - np.einsum("kia,kib->ab", self.border, through))
        both = -through @ shared
        return inverse - both @ through.transpose(0, 2, 1), both, shared
