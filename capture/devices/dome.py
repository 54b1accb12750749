"""The dome's box: one method a command, units in and out, no policy.

A table of rows is uploaded and compared by its checksum, then armed, which makes the box judge it,
and triggered; from then on the box steps by itself and reports each release of cameras. The lease
runs meanwhile: `DomeBox.listen` renews it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from capture.devices.led_box import LEVEL_STEPS, LedBox, LedStatus, TableEvaluation


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row of the box's table."""

    leds: tuple[int, ...]
    """Numbers of the LEDs that are on together; empty: dark."""
    level: float
    """Light relative to full, 0 to 1; the box sets thousandths."""
    dwell_s: float
    """How long, s; the box counts microseconds."""
    mask: int
    """Cameras that are released: bit 0 is the first."""

    def text(self) -> str:
        """Return the row in the one spelling that the table's checksum is taken of.

        Examples
        --------
        >>> TableRow((17, 3), 0.5, 0.083333, 0xFFFF).text()
        '3+17:500:83333:FFFF'
        """
        leds = "+".join(map(str, sorted(self.leds))) or "-"
        level = round(self.level * LEVEL_STEPS) if self.leds else 0
        return f"{leds}:{level}:{round(self.dwell_s * 1e6)}:{self.mask:X}"


class DomeBox(LedBox):
    """Driver of the dome's box; see `capture.devices.box.Box`."""

    kind: ClassVar[str] = "dome"

    def status(self) -> LedStatus:
        """Return the status bits."""
        return LedStatus(int(self._number("STAT?")))

    # sequence ---------------------------------------------------------------------------------

    def load(self, rows: Sequence[TableRow]) -> None:
        """Replace the box's table and compare its checksum.

        Raises
        ------
        BadAnswer
            When the box holds another table than was sent.
        """
        self._send_table("SEQ", [row.text() for row in rows], joint=";")

    def arm_sequence(self, rows: int) -> TableEvaluation:
        """Let the box judge its table of `rows` rows and make it ready for one run.

        Raises
        ------
        CommandRefused
            Beyond duty (101), heat (102), dose (104), or flicker for open eyes (105).
        """
        return self._arm_table(rows)

    # single LEDs ------------------------------------------------------------------------------

    def light(self, leds: Sequence[int], seconds: float, *, level: float = 1.0) -> None:
        """Light LEDs together for `seconds` (at most 0.5) from now."""
        names = "+".join(map(str, sorted(leds)))
        span_ms = f"{seconds * 1e3:.6f}".rstrip("0").rstrip(".")
        self._port.ask(f"LED:ON {names},{span_ms},{round(level * LEVEL_STEPS)}")

    def put_out(self, leds: Sequence[int] = ()) -> None:
        """Put LEDs out; all of them when none is named."""
        self._port.ask(f"LED:OFF {'+'.join(map(str, leds)) or 'ALL'}")

    def lit(self) -> tuple[int, ...]:
        """Return the numbers of the LEDs that are on."""

        def numbers(payload: str) -> tuple[int, ...]:
            return () if payload == "-" else tuple(int(part) for part in payload.split("+"))

        return self._read("LED?", numbers, "numbers joined by +, or -")


DRIVER: Final = DomeBox
