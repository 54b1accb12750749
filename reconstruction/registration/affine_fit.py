"""Fit an affine map to displaced windows with correlated deviations.

The stiffness of skin varies, so that parts move less or more than the mean stretch, and adjacent
windows deviate alike. In a map of a small patch such deviations resemble a larger stretch, and
their scatter alone underestimates its error, as the fit absorbs a part of them. So they are modeled
as a random field of unknown strength and reach plus an independent error of each window, and the
map's error follows from such fields (generalized least
squares with the field's parameters integrated out; Handcock and Stein 1993,
doi:10.1080/00401706.1993.10485354).
"""

import numpy as np
from scipy.linalg import solve_triangular

from reconstruction.arrays import Float64Array

CORRELATION_LENGTHS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Candidate correlation lengths, in windows. A window averages over shorter ones; longer ones move
all of a few windows together and do not scatter in them. On simulated skin (seeds 0 to 8) windows'
displacements are correlated over 0.8 to 1.2 windows of 150 um."""
SHARED_FRACTIONS = (0.0, 0.3, 0.6, 0.8, 0.9, 0.97)
"""Candidate fractions of the deviations' variance that neighbors share."""


def fit_affine(
    points_px: Float64Array, displaced_px: Float64Array, *, window_px: float
) -> tuple[Float64Array, Float64Array]:
    """Fit an affine map to displaced points, with its covariance.

    Parameters
    ----------
    points_px : ndarray, shape (N, 2)
        Points of the first image about its middle, px; at least 7, not on a line.
    displaced_px : ndarray, shape (N, 2)
        Positions in the second image, px.
    window_px : float
        Side of the tracked windows: the unit of `CORRELATION_LENGTHS`.

    Returns
    -------
    map : ndarray of float64, shape (3, 2)
        Linear part (transposed) over the shift: ``[x, y, 1] @ map`` is the position in the second.
    covariance : ndarray of float64, shape (6, 6)
        Of the linear part row by row, then of the shift of the middle, px.

    Raises
    ------
    ValueError
        For fewer points, points on a line, or coordinates that are not finite.

    Examples
    --------
    >>> grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    >>> solution, _ = fit_affine(grid, grid * [1.1, 0.9] + 2.0, window_px=1.0)
    >>> (solution.round(6) + 0.0).tolist()
    [[1.1, 0.0], [0.0, 0.9], [2.0, 2.0]]
    """
    count = len(points_px)
    if not (np.isfinite(points_px).all() and np.isfinite(displaced_px).all()):
        raise ValueError("points_px, found: got values that are not finite, expected finite px")
    design = np.column_stack([points_px, np.ones(count)])
    if count < 7 or np.linalg.matrix_rank(design) < 3:
        raise ValueError(
            f"points_px: got {count} points, expected at least 7, not all on one line; "
            "track more windows"
        )
    apart = np.linalg.norm(points_px[:, None] - points_px[None], axis=-1) / window_px
    free = count - 3
    kept: list[tuple[float, Float64Array, Float64Array, Float64Array]] = []
    for reach in CORRELATION_LENGTHS:
        alike = _correlation(apart / reach)
        for share in SHARED_FRACTIONS:
            if share == 0.0 and reach != CORRELATION_LENGTHS[0]:
                continue  # a field of strength 0 has no length
            kept.append(
                _fit_with_correlation(
                    design, displaced_px, share * alike + (1.0 - share) * np.eye(count)
                )
            )
    log = np.array([each[0] for each in kept])
    # strength 0 occurs once but represents all lengths: equal prior weight
    log[0] += np.log(len(CORRELATION_LENGTHS))
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    solution = np.einsum("k,kij->ij", weight, np.array([each[1] for each in kept]))
    total = np.zeros((6, 6))
    for share_of, (_, one, inverse, scatter) in zip(weight, kept, strict=True):
        # mean of the inverse Wishart posterior of two coordinates, plus the scatter of the means
        total += share_of * np.kron(scatter / max(free - 3, 1), inverse)
        way = (one - solution).T.ravel()
        total += share_of * np.outer(way, way)
    # coordinate by coordinate (x, y, 1 of the first, then of the second) to linear part and shift
    order = [0, 1, 3, 4, 2, 5]
    return solution, total[np.ix_(order, order)]


def _correlation(distance: Float64Array) -> Float64Array:
    """Return a Gaussian correlation, as a window's displacement averages over smooth ones."""
    return np.exp(-(distance**2))


def _fit_with_correlation(
    design: Float64Array, found: Float64Array, correlation: Float64Array
) -> tuple[float, Float64Array, Float64Array, Float64Array]:
    """Return log evidence, map, inverse information, and sums of squares of one correlation."""
    lower = np.linalg.cholesky(correlation + 1e-9 * np.eye(len(design)))
    white = solve_triangular(
        lower, np.column_stack([design, found]), lower=True, check_finite=False
    )
    a, b = white[:, :3], white[:, 3:]
    information = a.T @ a
    solution = np.linalg.solve(information, a.T @ b)
    rest = b - a @ solution
    scatter = rest.T @ rest + 1e-18 * np.eye(2)
    free = len(design) - 3
    log = -2.0 * float(np.log(np.diag(lower)).sum())
    log -= float(np.linalg.slogdet(information)[1])
    log -= 0.5 * free * float(np.linalg.slogdet(scatter)[1])
    return log, solution, np.linalg.inv(information), scatter
