"""Driver of the dome: one method per command, physical units, no policy.

A table of rows is uploaded and compared by its checksum. Arming makes the controller check the
table against its limits; the trigger starts it. The controller then steps on its own and reports
each camera release. The lease runs meanwhile: `DomeBox.listen` renews it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from capture.devices.led_box import LEVEL_STEPS, LedBox, LedStatus, TableEvaluation


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row of the controller's table."""

    leds: tuple[int, ...]
    """Numbers of the LEDs that are on together; empty: dark."""
    level: float
    """Light relative to full, 0 to 1, in steps of 1/1000."""
    dwell_s: float
    """Duration, s, in steps of 1 microsecond."""
    mask: int
    """Mask of the cameras to release: bit 0 is the first."""

    def text(self) -> str:
        """Return the row in the canonical spelling that the table's checksum covers.

        Examples
        --------
        >>> TableRow((17, 3), 0.5, 0.083333, 0xFFFF).text()
        '3+17:500:83333:FFFF'
        """
        leds = "+".join(map(str, sorted(self.leds))) or "-"
        level = round(self.level * LEVEL_STEPS) if self.leds else 0
        return f"{leds}:{level}:{round(self.dwell_s * 1e6)}:{self.mask:X}"


class DomeBox(LedBox):
    """Driver of the dome's controller; see `capture.devices.box.Box`."""

    kind: ClassVar[str] = "dome"

    def status(self) -> LedStatus:
        """Return the status bits."""
        return LedStatus(int(self._number("STAT?")))

    # sequence ---------------------------------------------------------------------------------

    def load(self, rows: Sequence[TableRow]) -> None:
        """Replace the controller's table and compare its checksum.

        Raises
        ------
        BadAnswer
            When the controller has another table than the one sent.
        """
        self._send_table("SEQ", [row.text() for row in rows], joint=";")

    def arm_sequence(self, rows: int) -> TableEvaluation:
        """Let the controller check its table of `rows` rows and prepare one run of it.

        Raises
        ------
        CommandRefused
            Beyond the limits of duty (101), heat (102), dose (104), or flicker for open eyes (105).
        """
        return self._arm_table(rows)

    # single LEDs ------------------------------------------------------------------------------

    def light(self, leds: Sequence[int], seconds: float, *, level: float = 1.0) -> None:
        """Light LEDs together for `seconds` (at most 0.5) from now."""
        names = "+".join(map(str, sorted(leds)))
        span_ms = f"{seconds * 1e3:.6f}".rstrip("0").rstrip(".")
        self._port.ask(f"LED:ON {names},{span_ms},{round(level * LEVEL_STEPS)}")

    def put_out(self, leds: Sequence[int] = ()) -> None:
        """Switch LEDs off; all of them when none is given."""
        self._port.ask(f"LED:OFF {'+'.join(map(str, leds)) or 'ALL'}")

    def lit(self) -> tuple[int, ...]:
        """Return the numbers of the LEDs that are on."""

        def numbers(payload: str) -> tuple[int, ...]:
            return () if payload == "-" else tuple(int(part) for part in payload.split("+"))

        return self._read("LED?", numbers, "numbers joined by +, or -")


DRIVER: Final = DomeBox
