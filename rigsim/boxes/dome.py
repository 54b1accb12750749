"""The dome's box: LEDs stepped by a table, cameras released by a mask."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LedPulse"]


@dataclass(frozen=True, slots=True)
class LedPulse:
    """Light of one LED from one switching to the next."""

    led: int
    """Number of the LED, an index into the rig's lights."""
    level: float
    """Light given relative to full, 0 to 1; a weak LED gives less than it was asked for."""
    t_on_s: float
    """World time when it came on, s."""
    t_off_s: float
    """World time when it went off, s."""
