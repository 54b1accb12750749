"""Rectangles of a map, which is computed tile by tile."""

from __future__ import annotations

from typing import NamedTuple


class Window(NamedTuple):
    """A rectangle of a map, px: rows [top, bottom), columns [left, right)."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.bottom - self.top, self.right - self.left

    @property
    def rows(self) -> slice:
        """Rows, as an index."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Columns, as an index."""
        return slice(self.left, self.right)

    def grown(self, by: int, shape: tuple[int, int]) -> Window:
        """Return the window with a margin, as far as the map goes."""
        return Window(
            max(self.top - by, 0),
            min(self.bottom + by, shape[0]),
            max(self.left - by, 0),
            min(self.right + by, shape[1]),
        )

    def within(self, other: Window) -> Window:
        """Return the window counted from another's first pixel."""
        return Window(
            self.top - other.top,
            self.bottom - other.top,
            self.left - other.left,
            self.right - other.left,
        )
