"""Driver of the face scanner: one method per command, physical units, no policy.

A projector and a pattern are selected; the trigger shows the pattern for a time and releases the
projector's cameras once the light is steady. Stripes flicker: nothing is shown before a person has
confirmed that the subject's eyes are closed or shielded. The light ends on its own; an armed
controller that receives nothing during its lease goes dark: renew it (`ScannerBox.listen`, or any
query) while cameras expose.
"""

from dataclasses import dataclass
from typing import ClassVar, Final

from capture.devices.box import BoxStatus, StatusBit, format_decimal, parse_whole_number
from capture.devices.led_box import EyeSafetyBox
from capture.scanner import STRIPE_AXES

_LEASE_POLL_S = 0.1
"""Interval between two renewals of the lease, s; shorter than the shortest lease."""
_WORDS: Final = dict(zip(STRIPE_AXES, ("COL", "ROW"), strict=True))


class ScannerStatus(BoxStatus):
    """Bits of ``STAT?``."""

    __slots__ = ()

    showing = StatusBit(4)
    """Whether a pattern is shown."""
    eyes_safe = StatusBit(9)
    """Whether a person has confirmed that the subject's eyes are closed or shielded."""


@dataclass(frozen=True, slots=True)
class ShownPattern:
    """Report of a release by the controller."""

    token: str
    """Token given with the command."""
    t_box_s: float
    """Time of the release on the controller's clock, s since power-up."""
    projector: int
    """Number of the projector, from 0."""
    axis: str
    """"columns" or "rows"; empty: full white."""
    pattern: int
    """Number of the pattern, from 0; 0 for full white."""


class ScannerBox(EyeSafetyBox):
    """Driver of the scanner's controller; see `capture.devices.box.Box`.

    Keys of ``limits``: ``projectors``, ``cameras``, ``columns`` and ``rows`` (of each projector),
    ``period_px``, ``phase_steps``, ``settle_ms`` (command to release of the cameras),
    ``min_show_ms``, ``max_show_ms``, ``dose_ws``.
    """

    kind: ClassVar[str] = "scanner"

    def status(self) -> ScannerStatus:
        """Return the status bits."""
        return ScannerStatus(int(self._number("STAT?")))

    # patterns ---------------------------------------------------------------------------------

    def select_projector(self, number: int) -> None:
        """Select a projector, from 0."""
        self._port.ask(f"PROJ {number}")

    def selected_projector(self) -> int:
        """Return the number of the selected projector."""
        return self._count("PROJ?", "a number", shown="PROJ?")

    def select_pattern(self, axis: str, number: int) -> None:
        """Select stripes of the selected projector, see `capture.scanner.Scanner`.

        Parameters
        ----------
        axis
            "columns" or "rows".
        number
            Number of the pattern, from 0.
        """
        if axis not in _WORDS:
            raise ValueError(f"axis: got {axis!r}, expected one of {', '.join(_WORDS)}")
        self._port.ask(f"PAT {_WORDS[axis]},{number}")

    def select_white(self) -> None:
        """Select full white instead of stripes."""
        self._port.ask("PAT FULL")

    def trigger(self, token: str, seconds: float) -> float:
        """Show the pattern for ``seconds``; return when the cameras were released, in s.

        The time is that of the controller since power-up. A repeated request never shows it twice.

        Raises
        ------
        CommandRefused
            Nothing was shown: not armed (-203), lease expired (108), a pattern is shown (-213),
            eyes open (105), dose (104), emergency stop (107), or a lamp without current (-240).
        """
        span_ms = format_decimal("seconds", 1e3 * seconds, 3)
        payload = self._port.ask(f"TRIG {token},{span_ms}")
        name, _, t_us = payload.partition(",")
        if name != token or not t_us.isdecimal():
            raise self._bad_answer("TRIG", payload, "token,us")
        return int(t_us) / 1e6

    def last_shown(self) -> ShownPattern | None:
        """Return the last pattern shown with a release, None when there was none since power-up."""
        return self._read_or_none("TRIG:LAST?", _shown_pattern, "token,us,projector,pattern")

    def shown_patterns(self) -> int:
        """Return the number of patterns shown since manufacture."""
        return self._count("TRIG:COUN?", "a number", shown="TRIG:COUN?")

    def trigger_cameras(self, token: str) -> float:
        """Release all cameras without light; return the controller's time, in s."""
        return self._token_time("CAM:TRIG", token)

    def listen(self, seconds: float) -> None:
        """Wait for ``seconds`` while the lease is renewed."""
        self._keep_lease(seconds, _LEASE_POLL_S)

    # eyes and dose ----------------------------------------------------------------------------

    def dose_ws(self) -> float:
        """Return the light emitted to this subject, Ws."""
        return self._number("DOSE?")

    def new_subject(self, pseudonym: str) -> None:
        """Restart the dose counter and clear the state of the eyes."""
        self._port.ask(f"DOSE:NEW {pseudonym}")


def _shown_pattern(payload: str) -> ShownPattern:
    token, t_us, projector, *pattern = payload.split(",")
    if pattern == ["FULL"]:
        axis, number = "", 0
    else:
        word, digits = pattern
        axis = {word: axis for axis, word in _WORDS.items()}[word]
        number = parse_whole_number(digits)
    time_s = parse_whole_number(t_us) / 1e6
    return ShownPattern(token, time_s, parse_whole_number(projector), axis, number)


DRIVER: Final = ScannerBox
