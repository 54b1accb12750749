"""Common base of controllers that step through LEDs: tables, cameras, eyes, dose.

A table of rows is uploaded and compared by its checksum. Arming makes the controller check the
table against its limits; the trigger starts it. The controller then steps on its own and reports
each camera release. The lease runs meanwhile: `LedBox.listen` renews it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from capture.devices import wire
from capture.devices.box import Box, BoxStatus, StatusBit, parse_whole_number
from capture.devices.port import Port

Eyes = Literal["open", "closed", "shielded"]
EYE_STATES: tuple[str, ...] = ("open", "closed", "shielded")
LEVEL_STEPS = 1000
_PROGRAM_POLL_S = 0.1
"""Interval between two renewals of the lease, s; shorter than the shortest lease."""
_FAILURES_MINOR = 3
"""First revision of the protocol whose controllers list the LEDs that draw no current."""
_MAX_PROGRAM_LINE_BYTES = 200
"""Rows per line: a short line survives a bad cable."""


@dataclass(frozen=True, slots=True)
class TableEvaluation:
    """Load of an accepted table, as the controller computes it."""

    flashes_per_s: float
    """Flashes at the eyes in the worst second."""
    flicker_rms: float
    """Light of 3 to 65 Hz at the eyes, rms over mean; 0 for short tables."""
    duty: float
    """Largest mean level of an LED over the controller's window."""
    heat: float
    """Highest temperature of an LED, relative to its steady state when on."""
    dose_ws: float
    """Largest energy that an LED will have emitted to this subject, Ws."""


@dataclass(frozen=True, slots=True)
class SequencePosition:
    """Progress of a sequence."""

    state: str
    """IDLE, READY (armed), RUN, DONE or STOP (made dark before its end)."""
    row: int
    """Last row whose cameras were released, -1 for none."""
    rows: int
    """Rows of the table."""
    token: str
    """Token of the run; empty when there is none."""


class LedStatus(BoxStatus):
    """Bits of ``STAT?``; the source of light and heat is an LED."""

    __slots__ = ()

    running = StatusBit(4)
    """Whether a sequence is stepping."""
    eyes_safe = StatusBit(9)
    """Whether a person has confirmed that the subject's eyes are closed or shielded."""


class EyeSafetyBox(Box):
    """A box whose light depends on the state of the subject's eyes."""

    def set_eyes(self, eyes: Eyes) -> None:
        """Send the state of the subject's eyes that a person has confirmed."""
        if eyes not in EYE_STATES:
            raise ValueError(f"eyes: got {eyes!r}, expected one of {', '.join(EYE_STATES)}")
        self._port.ask(f"SAFE:EYES {eyes.upper()}")

    def eyes(self) -> str:
        """Return the confirmed state of the subject's eyes."""
        payload = self._port.ask("SAFE:EYES?").lower()
        if payload not in EYE_STATES:
            raise self._bad_answer("SAFE:EYES?", payload, "OPEN, CLOSED or SHIELDED")
        return payload


class LedBox(EyeSafetyBox):
    """Driver of the commands that controllers with LEDs and a table share.

    Attributes
    ----------
    failed_leds : set of int
        Numbers of the LEDs that the controller has found to draw no current, at any time.
    """

    def __init__(self, port: Port, *, serial: str = "") -> None:
        self.failed_leds: set[int] = set()
        super().__init__(port, serial=serial)

    # sequence ---------------------------------------------------------------------------------

    def _send_table(self, name: str, texts: Sequence[str], *, joint: str) -> None:
        """Replace a table of the controller, ``SEQ`` or another one, and compare its checksum."""
        self._port.ask(f"{name}:CLE")
        first = 0
        while first < len(texts):
            end, size = first, 0
            while end < len(texts) and (
                end == first or size + len(texts[end]) <= _MAX_PROGRAM_LINE_BYTES
            ):
                size += len(texts[end]) + 1
                end += 1
            self._port.ask(f"{name}:DEF {first},{joint.join(texts[first:end])}")
            first = end
        wanted = f"{len(texts)},{wire.crc16(chr(10).join(texts).encode()):04X}"
        payload = self._port.ask(f"{name}:CRC?")
        if payload != wanted:
            raise self._bad_answer(f"{name}:CRC?", payload, f"{wanted}, the table that was sent")

    def _arm_table(self, rows: int) -> TableEvaluation:
        expected = "flashes,rms,duty,heat,Ws"
        return self._read(f"SEQ:ARM {rows}", _parse_evaluation, expected, shown="SEQ:ARM")

    def trigger(self, token: str) -> float:
        """Run the armed table once; return the controller's time of its begin, in s.

        A repeated request never runs it twice. After `PortTimeout` or `LinkLost`, `position`
        reports whether it runs, unless the controller has rebooted.
        """
        return self._token_time("TRIG", token)

    def position(self) -> SequencePosition:
        """Return the progress of the sequence."""
        return self._read("SEQ:POS?", _parse_position, "state,row,rows,token")

    def step_time(self, row: int) -> float | None:
        """Return the controller's time at which a row released its cameras, in s; None: not yet."""
        text, expected = f"SEQ:STEP? {row}", "us or NONE"
        t_us = self._read_or_none(text, parse_whole_number, expected, shown="SEQ:STEP?")
        return None if t_us is None else t_us / 1e6

    def listen(self, seconds: float) -> dict[int, float]:
        """Wait for `seconds`, renew the lease, and return the releases reported: row to time, s.

        Events can be lost on a bad line: `step_time` returns missing ones. LEDs that the controller
        reports as drawing no current are added to `failed_leds`.
        """
        found: dict[int, float] = {}
        left_s = seconds
        while left_s > 0.0:
            for event in self._port.listen(min(left_s, _PROGRAM_POLL_S)):
                if event.name == "SEQ:STEP":
                    row, _, t_us = event.payload.partition(",")
                    if row.isdecimal() and t_us.isdecimal():
                        found[int(row)] = int(t_us) / 1e6
                elif event.name == "LED:FAIL" and event.payload.isdecimal():
                    self.failed_leds.add(int(event.payload))
            self.ping()
            left_s -= _PROGRAM_POLL_S
        return found

    # cameras, eyes, dose ----------------------------------------------------------------------

    def set_cameras(self, mask: int) -> None:
        """Set the mask of the cameras that can be released; bit 0 is the first."""
        self._port.ask(f"CAM:MASK {mask:X}")

    def cameras(self) -> int:
        """Return the mask of the cameras that can be released."""
        return self._read("CAM:MASK?", lambda got: int(got, 16), "hexadecimal digits")

    def trigger_cameras(self, token: str) -> float:
        """Release the cameras without light; return the controller's time, in s."""
        return self._token_time("CAM:TRIG", token)

    def dose_ws(self, led: int) -> float:
        """Return the energy that an LED has emitted to this subject, Ws."""
        return self._number(f"DOSE? {led}")

    @property
    def stops_at_failure(self) -> bool:
        """Whether a new dead LED ends a sequence, as from revision 1.3 on."""
        return int(self.limits.get("protocol_minor", 0)) >= _FAILURES_MINOR

    def find_failed_leds(self) -> frozenset[int]:
        """Return the LEDs that are not driven, and add them to `failed_leds`.

        A bad line can lose the event of such an LED; this query is repeated until it is answered.
        The controller clears its list at a reset. Controllers of revisions before 1.3 have the
        event alone: the result is `failed_leds`.
        """
        if not self.stops_at_failure:
            return frozenset(self.failed_leds)
        mask = self._read("LED:FAIL?", lambda got: int(got, 16), "hexadecimal digits")
        found = frozenset(led for led in range(mask.bit_length()) if mask >> led & 1)
        self.failed_leds |= found
        return found

    def new_subject(self, pseudonym: str) -> None:
        """Restart the dose counter and clear the state of the eyes."""
        self._port.ask(f"DOSE:NEW {pseudonym}")


def _parse_evaluation(payload: str) -> TableEvaluation:
    flashes, rms, duty, heat, dose_ws = (float(field) for field in payload.split(","))
    return TableEvaluation(flashes, rms, duty, heat, dose_ws)


def _parse_position(payload: str) -> SequencePosition:
    state, row, rows, token = payload.split(",")
    return SequencePosition(state, int(row), int(rows), "" if token == "-" else token)
