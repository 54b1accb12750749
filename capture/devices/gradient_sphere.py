"""Driver of the gradient sphere: one method per command, physical units, no policy.

A pattern lights all LEDs at once: full, or weighted by a coordinate of the direction to each
(`capture.plan.steps.LIGHT_PATTERNS`). A scan is a table of patterns: uploaded, compared by its
checksum, armed, which makes the controller check it against its limits, and triggered. The
controller then steps on its own, turns the analyzer in the dark where a row has another reading,
releases the cameras once each light is steady, and reports each release. The lease runs meanwhile:
`listen` renews it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

from capture.devices.box import StatusBit, format_decimal
from capture.devices.led_box import LEVEL_STEPS, LedBox, LedStatus, TableEvaluation
from capture.plan.steps import LIGHT_PATTERNS

Polarizer = Literal["parallel", "crossed"]
ANALYZER_DEG: dict[str, float] = {"parallel": 0.0, "crossed": 90.0}
"""Reading of the analyzer per polarizer state, degrees."""
_ANALYZER_POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class PatternRow:
    """One row of a scan."""

    pattern: str
    """full, x, y, z, -x, -y, -z or dark."""
    analyzer_deg: float
    """Reading of the analyzer, degrees, 0 to 180; 0 is parallel, 90 crossed. Where it differs from
    the row before, the controller turns it first, in the dark; that time is not part of
    ``dwell_s``.
    """
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
        >>> PatternRow("-x", 90.0, 0.5, 0.03, 1).text()
        '-X:90:500:30000:1'
        >>> PatternRow("dark", 0.0, 1.0, 0.03, 1).text()
        'DARK:0:0:30000:1'
        """
        level = 0 if self.pattern == "dark" else round(self.level * LEVEL_STEPS)
        angle = format_decimal("analyzer_deg", self.analyzer_deg, 3)
        dwell_us = round(self.dwell_s * 1e6)
        return f"{_pattern(self.pattern).upper()}:{angle}:{level}:{dwell_us}:{self.mask:X}"


class SphereStatus(LedStatus):
    """Bits of ``STAT?``."""

    __slots__ = ()

    turning = StatusBit(10)
    """Whether the analyzer turns."""


class GradientSphereBox(LedBox):
    """Driver of the gradient sphere's controller; see `capture.devices.box.Box`.

    Keys of ``limits`` are those of the dome, and ``move_s_per_deg`` (time in which the analyzer
    turns by one degree, s), ``analyser_min_deg`` and ``analyser_max_deg``.
    """

    kind: ClassVar[str] = "gradient_sphere"

    def status(self) -> SphereStatus:
        """Return the status bits."""
        return SphereStatus(int(self._number("STAT?")))

    # analyzer ---------------------------------------------------------------------------------

    def set_polarizer(self, polarizer: str) -> None:
        """Start turning the analyzer to "parallel" or "crossed"; refused while a light is on."""
        if polarizer not in ANALYZER_DEG:
            raise ValueError(f"polarizer: got {polarizer!r}, expected 'parallel' or 'crossed'")
        self._port.ask(f"POL {ANALYZER_DEG[polarizer]:.0f}")

    def set_analyzer(self, angle_deg: float) -> None:
        """Start turning the analyzer to a reading of 0 to 180 degrees."""
        self._port.ask(f"POL:ANG {format_decimal('angle_deg', angle_deg, 3)}")

    def analyzer_deg(self) -> float:
        """Return the present or target reading of the analyzer, in degrees."""
        return self._number("POL?")

    def is_settled(self) -> bool:
        """Return whether the analyzer is at rest and no scan is running."""
        return self._flag("*OPC?")

    def wait_settled(self, timeout_s: float = 5.0) -> None:
        """Wait until the analyzer is at rest; the lease is renewed.

        Raises
        ------
        PortTimeout
            When it still turns after `timeout_s`.
        """
        fault = f"the analyzer still turns after {timeout_s:g} s; check it"
        self._wait_settled(timeout_s, _ANALYZER_POLL_S, self.listen, fault)

    # single patterns --------------------------------------------------------------------------

    def light(self, pattern: str, seconds: float, *, level: float = 1.0) -> None:
        """Light a pattern for `seconds` (at most 0.5) from now; "dark" switches the light off.

        Refused (-213) while the analyzer turns.
        """
        if pattern == "dark":
            self.put_out()
            return
        span_ms = format_decimal("seconds", seconds * 1e3, 6)
        self._port.ask(f"PATT {_pattern(pattern).upper()},{span_ms},{round(level * LEVEL_STEPS)}")

    def put_out(self) -> None:
        """Switch the light off."""
        self._port.ask("PATT DARK")

    def lit(self) -> str:
        """Return the pattern that is on, "dark" for none."""
        payload = self._port.ask("PATT?").lower()
        if payload not in LIGHT_PATTERNS:
            raise self._bad_answer("PATT?", payload, "a pattern")
        return payload

    # scans ------------------------------------------------------------------------------------

    def load(self, rows: Sequence[PatternRow]) -> None:
        """Replace the controller's table and compare its checksum.

        Raises
        ------
        BadAnswer
            When the controller has another table than the one sent.
        """
        self._send_table("SEQ", [row.text() for row in rows], joint=";")

    def arm_scan(self, rows: int) -> TableEvaluation:
        """Let the controller check its table of `rows` rows and prepare one run of it.

        Raises
        ------
        CommandRefused
            Beyond the limits of duty (101), heat (102), dose (104), or flicker for open eyes (105);
            -213 while the analyzer turns.
        """
        return self._arm_table(rows)

    # gains ------------------------------------------------------------------------------------

    def set_gains(self, gains: Sequence[float]) -> None:
        """Scale each LED by a factor of 0 to 1, so that all give equal light.

        Parameters
        ----------
        gains
            One per LED, 0 to 1, in steps of 1/1000. A reset clears them.

        Raises
        ------
        BadAnswer
            When the controller has other gains than those sent.
        """
        for number, gain in enumerate(gains):
            if not 0.0 <= gain <= 1.0:
                raise ValueError(f"gains[{number}]: got {gain}, expected 0 to 1")
        self._send_table("GAIN", [str(round(gain * LEVEL_STEPS)) for gain in gains], joint="+")

    def clear_gains(self) -> None:
        """Reset the gains of all LEDs to 1."""
        self._port.ask("GAIN:CLE")


def _pattern(name: str) -> str:
    if name not in LIGHT_PATTERNS:
        raise ValueError(f"pattern: got {name!r}, expected one of {', '.join(LIGHT_PATTERNS)}")
    return name


DRIVER: Final = GradientSphereBox
