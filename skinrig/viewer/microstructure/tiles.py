"""Cut a displacement that exceeds page and graphics card into a pyramid of tiles.

Level 0 is the file itself, memory-mapped. Coarser levels are means of two by two pixels, written
once into a folder. A tile has 16-bit words over the range of the whole map, so that its error is
known in advance.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.checks.files import map_array
from skinrig.atomic_file import replace_folder_atomically

TILE_PX: Final = 256
MIN_SIDE_PX: Final = 512
"""Minimum side of a map and of the coarsest level."""
MAX_LEVELS: Final = 8
ROWS_PER_READ: Final = 512
"""Rows of a level per read."""
MAX_WORD: Final = 65535


class TileError(ValueError):
    """An invalid displacement, or a missing tile."""


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Levels of a displacement.

    Attributes
    ----------
    levels : tuple of ndarray or memory map, shape (S / 2^level,) * 2
        Heights, um, row 0 at the top (v = 1).
    low, high : float
        Range of level 0, um, which includes that of coarser levels.
    """

    levels: tuple[Any, ...]
    low: float
    high: float

    @property
    def size(self) -> int:
        """Side of level 0, px."""
        return int(self.levels[0].shape[0])

    @property
    def step_um(self) -> float:
        """Quantization step of heights, um; the maximum error is half of it."""
        return (self.high - self.low) / MAX_WORD

    def tile(self, level: int, row: int, column: int) -> bytes:
        """Return a tile as little-endian words, `TILE_PX` squared, row 0 at the top.

        Parameters
        ----------
        level
            0 is the finest.
        row, column
            Index of the tile from the upper left.

        Returns
        -------
        bytes
            Word 0 is `low`, word 65535 is `high`.

        Raises
        ------
        TileError
            If the pyramid has no such tile.
        """
        if not 0 <= level < len(self.levels):
            raise TileError(f"level: got {level}, expected 0 to {len(self.levels) - 1}")
        source = self.levels[level]
        count = source.shape[0] // TILE_PX
        if not (0 <= row < count and 0 <= column < count):
            raise TileError(f"tile: got row {row}, column {column}, expected 0 to {count - 1}")
        part = np.asarray(
            source[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX],
            np.float64,
        )
        spread = self.high - self.low or 1.0
        words = np.rint(np.clip((part - self.low) / spread, 0.0, 1.0) * MAX_WORD)
        return words.astype("<u2").tobytes()


def build(source: Any, folder: Path) -> Pyramid:
    """Build the levels of a displacement.

    Parameters
    ----------
    source : array or memory map, shape (S, S)
        Heights, um, finite; S is `MIN_SIDE_PX` times a power of two.
    folder : Path
        Folder of the coarser levels, created or replaced; a third of the file's size.

    Raises
    ------
    TileError
        If the shape is invalid, or heights are not finite.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as name:
    ...     made = build(np.ones((1024, 1024), np.float32), Path(name) / "levels")
    ...     made.size, len(made.levels), len(made.tile(1, 0, 1))
    (1024, 2, 131072)
    """
    shape = tuple(int(side) for side in np.shape(source))
    sides = [MIN_SIDE_PX << k for k in range(16)]
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] not in sides:
        raise TileError(
            f"displacement: got shape {shape}, expected a square with sides of {MIN_SIDE_PX} px "
            "times a power of two (such as 4096 or 16384)"
        )
    low, high = _range(source)
    with replace_folder_atomically(folder) as part:
        level, number = source, 1
        while level.shape[0] > MIN_SIDE_PX and number < MAX_LEVELS:
            level = _halved(level, part / f"level_{number}.npy")
            number += 1
    coarser = [
        np.load(folder / f"level_{k}.npy", mmap_mode="r", allow_pickle=False)
        for k in range(1, number)
    ]
    return Pyramid((source, *coarser), low, high)


def open_displacement(path: Path, folder: Path) -> Pyramid:
    """Open a displacement file and build its levels.

    Parameters
    ----------
    path : Path
        A .npy file of float32, um, of `skinrig apply microstructure`; it is memory-mapped.
    folder : Path
        See `build`.

    Raises
    ------
    TileError
        If the file is of another type; see also `build`.
    """
    try:
        source = map_array(path)
    except ValueError as error:
        raise TileError(f"{path}: not a .npy file of heights ({error}); check the file") from error
    if source.dtype.kind != "f":
        raise TileError(f"{path}: got {source.dtype}, expected an array of float32 heights, um")
    return build(source, folder)


def _range(source: Any) -> tuple[float, float]:
    low, high = np.inf, -np.inf
    for top in range(0, source.shape[0], ROWS_PER_READ):
        rows = np.asarray(source[top : top + ROWS_PER_READ])
        if not np.isfinite(rows).all():
            raise TileError(
                f"displacement: got NaN or infinity in rows {top} to {top + len(rows) - 1}, "
                "expected finite heights; fill holes first"
            )
        low, high = min(low, float(rows.min())), max(high, float(rows.max()))
    return low, high


def _halved(source: Any, path: Path) -> Any:
    side = source.shape[0] // 2
    target = np.lib.format.open_memmap(path, "w+", np.float32, (side, side))
    for top in range(0, side, ROWS_PER_READ):
        rows = np.asarray(source[2 * top : 2 * (top + ROWS_PER_READ)], np.float64)
        blocks = rows.reshape(rows.shape[0] // 2, 2, side, 2)
        target[top : top + ROWS_PER_READ] = blocks.mean(axis=(1, 3))
    target.flush()
    return target
