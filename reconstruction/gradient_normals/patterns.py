"""The pictures of a gradient sphere: which there are, and whether they suffice.

Four numbers a polarization are asked for, the full light and its moments along x, y and z. Each
picture is a weighted sum of them: the full light itself, or half of it plus or less half a moment.
"""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import BoolArray, Float64Array, FloatArray

Key = tuple[str, str]

PATTERN_NAMES: Final = ("full", "x", "y", "z", "-x", "-y", "-z", "dark")
POLARIZER_NAMES: Final = ("parallel", "crossed")


class GradientError(ValueError):
    """Pictures that no normals can be computed from."""


class MissingPatterns(GradientError):
    """Too few patterns to tell the light and its three moments."""


@dataclass(frozen=True, slots=True)
class Stack:
    """The pictures of one polarization, by pattern.

    Attributes
    ----------
    pictures : dict of str to ndarray, shape (H, W)
    variance : dict of str to ndarray, broadcastable to (H, W), or None
    valid : dict of str to ndarray of bool, shape (H, W)
        Only those that are not valid everywhere.
    """

    pictures: dict[str, FloatArray]
    variance: dict[str, FloatArray] | None
    valid: dict[str, BoolArray]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = next(iter(self.pictures.values())).shape
        return height, width

    @property
    def dark(self) -> bool:
        """Whether a dark frame is among the pictures, and not yet subtracted."""
        return "dark" in self.pictures

    @property
    def redundant(self) -> int:
        """How many more pictures there are than what is asked for."""
        return redundancy(self.pictures)

    def samples(self, rows: slice, kind: Any) -> FloatArray:
        """Return samples (8, h, W) in the order of :data:`PATTERN_NAMES`, NaN where missing."""
        _, width = self.shape
        height = len(range(*rows.indices(self.shape[0])))
        out = np.full((len(PATTERN_NAMES), height, width), np.nan, kind)
        for k, name in enumerate(PATTERN_NAMES):
            if name in self.pictures:
                out[k] = self.pictures[name][rows]
                if name in self.valid:
                    out[k][~self.valid[name][rows]] = np.nan
        if not np.isfinite(out).all():
            out[~np.isfinite(out)] = np.nan
        return out

    def variances(self, rows: slice, kind: Any) -> FloatArray:
        """Return variances (8, h, W); 1 where no picture is, and a view where it can be."""
        height, width = len(range(*rows.indices(self.shape[0]))), self.shape[1]
        if self.variance is None:
            return np.broadcast_to(np.ones(1, kind), (len(PATTERN_NAMES), height, width))
        out = np.ones((len(PATTERN_NAMES), height, width), kind)
        for k, name in enumerate(PATTERN_NAMES):
            if name in self.pictures:
                given = self.variance[name]
                out[k] = given[rows] if given.ndim else given
        return out


def design(names: list[str], *, dark: bool) -> Float64Array:
    """Return the weights (R, 4 or 5) of full light, moments and dark level in each picture."""
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
    """Return the number of pictures beyond those that tell everything; below 0 where too few.

    Examples
    --------
    >>> redundancy(dict.fromkeys(["full", "x", "y", "z"])), redundancy(dict.fromkeys("xyz"))
    (0, -1)
    """
    chosen = [name for name in PATTERN_NAMES if name in names]
    dark = "dark" in chosen
    A = design(chosen, dark=dark)
    rank = int(np.linalg.matrix_rank(A)) if chosen else 0
    unknowns = 5 if dark else 4
    return len(chosen) - unknowns if rank == unknowns else rank - unknowns


def require(names: Mapping[str, Any], *, polarizer: str, purpose: str) -> None:
    """Refuse patterns that do not tell the full light and its three moments.

    Raises
    ------
    MissingPatterns
        Saying which are missing, and which would do.
    """
    if redundancy(names) >= 0:
        return
    lit = [name for name in PATTERN_NAMES if name in names and name != "dark"]
    axes = [a for a in "xyz" if a not in lit and f"-{a}" not in lit]
    needs = [f"{a} or -{a}" for a in axes]
    if "full" not in lit and not any(a in lit and f"-{a}" in lit for a in "xyz"):
        needs.append("full, or a complement of one more pattern")
    missing = [name for name in PATTERN_NAMES if name not in names]
    raise MissingPatterns(
        f"patterns: {purpose} needs the {polarizer} pictures to tell full light and three"
        f" gradients; got {', '.join(lit) or 'none'}; missing {', '.join(missing)};"
        f" {' and '.join(needs)} would do"
    )


def collect(
    patterns: Mapping[Key, ArrayLike],
    *,
    variance: float | Mapping[Key, ArrayLike] | None,
    valid: BoolArray | Mapping[Key, BoolArray] | None,
    saturation: float | None,
) -> dict[str, Stack]:
    """Check the pictures and sort them by polarization.

    Returns
    -------
    dict of str to Stack
        By polarization, of those that pictures were given of.
    """
    if not patterns:
        raise GradientError("patterns: got none, expected pictures keyed (pattern, polarizer)")
    shape: tuple[int, ...] = ()
    stacks: dict[str, Stack] = {}
    for key, given in patterns.items():
        name, polarizer = _known_key(key)
        image = np.asarray(given)
        if image.dtype.kind not in "fui" or image.ndim != 2 or image.size == 0:
            raise GradientError(
                f"patterns[{name!r}, {polarizer!r}]: got {image.dtype} of shape {image.shape},"
                " expected linear numbers (H, W) or (H, W, C)"
            )
        shape = shape or image.shape
        if image.shape != shape:
            raise GradientError(
                f"patterns[{name!r}, {polarizer!r}]: got shape {image.shape}, expected {shape} as"
                " the others"
            )
        stack = stacks.setdefault(polarizer, Stack({}, None, {}))
        stack.pictures[name] = image
        mask = _mask(valid, (name, polarizer), shape)
        if saturation is not None:
            with np.errstate(invalid="ignore"):
                clear = ~(image >= saturation)
            mask = clear if mask is None else mask & clear
        if mask is not None and not mask.all():
            stack.valid[name] = mask
    if variance is None:
        return stacks
    return {
        polarizer: _with_variance(stack, polarizer, variance, shape)
        for polarizer, stack in stacks.items()
    }


def _known_key(key: Any) -> Key:
    if not (isinstance(key, tuple) and len(key) == 2 and all(isinstance(k, str) for k in key)):
        raise GradientError(f"patterns: got key {key!r}, expected (pattern, polarizer)")
    for word, known, kind in (
        (key[0], PATTERN_NAMES, "pattern"),
        (key[1], POLARIZER_NAMES, "polarizer"),
    ):
        if word not in known:
            near = difflib.get_close_matches(word, known, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise GradientError(
                f"patterns: got {kind} {word!r}, expected one of {', '.join(known)}{hint}"
            )
    return key[0], key[1]


def _mask(
    valid: BoolArray | Mapping[Key, BoolArray] | None, key: Key, shape: tuple[int, ...]
) -> BoolArray | None:
    if valid is None or (isinstance(valid, Mapping) and key not in valid):
        return None
    mask = np.asarray(valid[key] if isinstance(valid, Mapping) else valid)
    if mask.dtype != np.bool_ or mask.shape != shape:
        raise GradientError(
            f"valid: got {mask.dtype} of shape {mask.shape}, expected bool {shape}, or a mapping of"
            " the same keys to such"
        )
    return mask


def _with_variance(stack: Stack, polarizer: str, variance: Any, shape: tuple[int, ...]) -> Stack:
    found: dict[str, FloatArray] = {}
    for name in stack.pictures:
        if isinstance(variance, Mapping):
            if (name, polarizer) not in variance:
                raise GradientError(
                    f"variance: got none of {(name, polarizer)}, expected one of every picture"
                )
            values = np.asarray(variance[name, polarizer], np.float64)
        else:
            values = np.asarray(variance, np.float64)
        if values.shape not in ((), shape):
            raise GradientError(
                f"variance[{name!r}, {polarizer!r}]: got shape {values.shape}, expected () or"
                f" {shape}"
            )
        with np.errstate(invalid="ignore"):
            good = np.isfinite(values) & (values > 0)
        if values.ndim == 0 and not good:
            raise GradientError(
                f"variance[{name!r}, {polarizer!r}]: got {values}, expected a finite number above 0"
            )
        if values.ndim:
            if not good.all():  # of an unknown variance: as if the sample were not there
                before = stack.valid.get(name)
                stack.valid[name] = good if before is None else before & good
                values = np.where(good, values, 1.0)
        found[name] = values
    return Stack(stack.pictures, found, stack.valid)
