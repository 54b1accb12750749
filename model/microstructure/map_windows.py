"""Rectangles of a map that is computed tile by tile."""

from __future__ import annotations

from typing import NamedTuple


class MapWindow(NamedTuple):
    """A rectangle of a map, px: rows [top, bottom), columns [left, right)."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """Return height and width."""
        return self.bottom - self.top, self.right - self.left

    @property
    def rows(self) -> slice:
        """Return the rows as an index."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Return the columns as an index."""
        return slice(self.left, self.right)

    def expand(self, margin: int, shape: tuple[int, int]) -> MapWindow:
        """Return the window with a margin, clipped to the map."""
        return MapWindow(
            max(self.top - margin, 0),
            min(self.bottom + margin, shape[0]),
            max(self.left - margin, 0),
            min(self.right + margin, shape[1]),
        )

    def within(self, other: MapWindow) -> MapWindow:
        """Return the window relative to another's first pixel."""
        return MapWindow(
            self.top - other.top,
            self.bottom - other.top,
            self.left - other.left,
            self.right - other.left,
        )
