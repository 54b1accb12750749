"""Name the patterns of a gradient sphere, stack their images, and check that they suffice.

There are four unknowns per polarization, the full light and its moments along x, y and z. Each
image is a weighted sum of them: the full light itself, or half of it plus or minus half a moment.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array, FloatArray

Key = tuple[str, str]

PATTERN_NAMES: Final = ("full", "x", "y", "z", "-x", "-y", "-z", "dark")
POLARIZER_NAMES: Final = ("parallel", "crossed")


class GradientError(ValueError):
    """Images that normals cannot be computed from."""


class MissingPatternsError(GradientError):
    """Too few patterns to determine the light and its three moments."""


@dataclass(frozen=True, slots=True)
class PatternStack:
    """The images of one polarization, by pattern.

    Attributes
    ----------
    images : dict of str to ndarray, shape (H, W)
    variance : dict of str to ndarray, broadcastable to (H, W), or None
    valid : dict of str to ndarray of bool, shape (H, W)
        Only masks with invalid pixels.
    """

    images: dict[str, FloatArray]
    variance: dict[str, FloatArray] | None
    valid: dict[str, BoolArray]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = next(iter(self.images.values())).shape
        return height, width

    @property
    def has_dark(self) -> bool:
        """Whether there is a dark frame that is not yet subtracted."""
        return "dark" in self.images

    @property
    def redundancy(self) -> int:
        """Number of images beyond the number of unknowns."""
        return redundancy(self.images)

    def samples(self, rows: slice, kind: Any) -> FloatArray:
        """Return samples (8, h, W) in the order of :data:`PATTERN_NAMES`, NaN where missing."""
        _, width = self.shape
        height = len(range(*rows.indices(self.shape[0])))
        out = np.full((len(PATTERN_NAMES), height, width), np.nan, kind)
        for k, name in enumerate(PATTERN_NAMES):
            if name in self.images:
                out[k] = self.images[name][rows]
                if name in self.valid:
                    out[k][~self.valid[name][rows]] = np.nan
        if not np.isfinite(out).all():
            out[~np.isfinite(out)] = np.nan
        return out

    def variances(self, rows: slice, kind: Any) -> FloatArray:
        """Return variances (8, h, W); 1 without an image, broadcast views where possible."""
        height, width = len(range(*rows.indices(self.shape[0]))), self.shape[1]
        if self.variance is None:
            return np.broadcast_to(np.ones(1, kind), (len(PATTERN_NAMES), height, width))
        out = np.ones((len(PATTERN_NAMES), height, width), kind)
        for k, name in enumerate(PATTERN_NAMES):
            if name in self.images:
                given = self.variance[name]
                out[k] = given[rows] if given.ndim else given
        return out


def design_matrix(names: list[str], *, dark: bool) -> Float64Array:
    """Return the weights (R, 4 or 5) of full light, moments and dark level in each image."""
    rows = []
    for name in names:
        row = [0.0, 0.0, 0.0, 0.0]
        if name != "dark":
            row[0] = 1.0 if name == "full" else 0.5
        if name not in ("full", "dark"):
            row[1 + "xyz".index(name[-1])] = -0.5 if name[0] == "-" else 0.5
        rows.append([*row, 1.0] if dark else row)
    return np.array(rows).reshape(len(names), 5 if dark else 4)


def redundancy(names: Mapping[str, Any]) -> int:
    """Return the number of images beyond the unknowns; below 0 if these are not determined.

    Examples
    --------
    >>> redundancy(dict.fromkeys(["full", "x", "y", "z"])), redundancy(dict.fromkeys("xyz"))
    (0, -1)
    """
    chosen = [name for name in PATTERN_NAMES if name in names]
    dark = "dark" in chosen
    A = design_matrix(chosen, dark=dark)
    rank = int(np.linalg.matrix_rank(A)) if chosen else 0
    unknowns = 5 if dark else 4
    return len(chosen) - unknowns if rank == unknowns else rank - unknowns


def require_patterns(names: Mapping[str, Any], *, polarizer: str, purpose: str) -> None:
    """Refuse patterns that do not determine the full light and its three moments.

    Raises
    ------
    MissingPatterns
        With those that are missing, and which would suffice.
    """
    if redundancy(names) >= 0:
        return
    lit = [name for name in PATTERN_NAMES if name in names and name != "dark"]
    axes = [a for a in "xyz" if a not in lit and f"-{a}" not in lit]
    needs = [f"{a} or -{a}" for a in axes]
    if "full" not in lit and not any(a in lit and f"-{a}" in lit for a in "xyz"):
        needs.append("full, or a complement of one more pattern")
    missing = [name for name in PATTERN_NAMES if name not in names]
    raise MissingPatternsError(
        f"patterns: {purpose} needs the {polarizer} images to determine full light and three"
        f" gradients; got {', '.join(lit) or 'none'}; missing {', '.join(missing)};"
        f" {' and '.join(needs)} would suffice; add them [SR-REC-016]"
    )
