"""What drivers of boxes that step through LEDs share: tables, cameras, eyes, dose.

A table of rows is uploaded and compared by its checksum, then armed, which makes the box judge it,
and triggered; from then on the box steps by itself and reports each release of cameras. The lease
runs meanwhile: `LedBox.listen` renews it.
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
"""Silence between two renewals of the lease; shorter than the shortest lease."""
_MAX_PROGRAM_LINE_BYTES = 200
"""Rows that are sent in one line: a short line survives a bad cable."""


@dataclass(frozen=True, slots=True)
class TableEvaluation:
    """What the box makes of a table that it accepts."""

    flashes_per_s: float
    """Flashes at the eyes in the worst second."""
    flicker_rms: float
    """Light of 3 to 65 Hz at the eyes, rms over mean; 0 for short tables."""
    duty: float
    """Most mean level of an LED over the box's window."""
    heat: float
    """Highest temperature of an LED; 1 is where it would settle when on."""
    dose_ws: float
    """Most that an LED will have sent out to this subject, Ws."""


@dataclass(frozen=True, slots=True)
class SequencePosition:
    """Where a sequence stands."""

    state: str
    """IDLE, READY (armed), RUN, DONE or STOP (made dark before its end)."""
    row: int
    """Last row whose cameras were released, -1 for none."""
    rows: int
    """Rows of the table."""
    token: str
    """Name of the run; empty when there is none."""


class LedStatus(BoxStatus):
    """The bits of ``STAT?``; what is lit or too hot is an LED."""

    __slots__ = ()

    running = StatusBit(4)
    """Whether a sequence is stepping."""
    eyes_safe = StatusBit(9)
    """Whether a person has said that the subject's eyes are closed or shielded."""


class LedBox(Box):
    """Driver of the commands that boxes with LEDs and a table share.

    Attributes
    ----------
    failed_leds : set of int
        Numbers of the LEDs that the box has reported as drawing no current.
    """

    def __init__(self, port: Port, *, serial: str = "") -> None:
        self.failed_leds: set[int] = set()
        super().__init__(port, serial=serial)

    # sequence ---------------------------------------------------------------------------------

    def _send_table(self, name: str, texts: Sequence[str], *, joint: str) -> None:
        """Replace a table of the box, ``SEQ`` or another one, and compare its checksum."""
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
        """Run the armed table once; return the box's time of its beginning, in s.

        A retry on the line never runs it twice. After `PortTimeout` or `LinkLost`, `position` tells
        whether it runs, unless the box has rebooted.
        """
        return self._token_time("TRIG", token)

    def position(self) -> SequencePosition:
        """Tell where the sequence stands."""
        return self._read("SEQ:POS?", _parse_position, "state,row,rows,token")

    def step_time(self, row: int) -> float | None:
        """Return the box's time at which a row released its cameras, in s; None: it has not."""
        text, expected = f"SEQ:STEP? {row}", "us or NONE"
        t_us = self._read_or_none(text, parse_whole_number, expected, shown="SEQ:STEP?")
        return None if t_us is None else t_us / 1e6

    def listen(self, seconds: float) -> dict[int, float]:
        """Let `seconds` pass, renew the lease, and return the releases reported: row to box time.

        Events can be lost on a bad line: `step_time` tells what is missing. LEDs that the box
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
        """Set which cameras are released at all; bit 0 is the first."""
        self._port.ask(f"CAM:MASK {mask:X}")

    def cameras(self) -> int:
        """Return the mask of the cameras that are released at all."""
        return self._read("CAM:MASK?", lambda got: int(got, 16), "hexadecimal digits")

    def trigger_cameras(self, token: str) -> float:
        """Release the cameras without light; return the box's time, in s."""
        return self._token_time("CAM:TRIG", token)

    def set_eyes(self, eyes: Eyes) -> None:
        """Pass on what a person says of the subject's eyes."""
        if eyes not in EYE_STATES:
            raise ValueError(f"eyes: got {eyes!r}, expected one of {', '.join(EYE_STATES)}")
        self._port.ask(f"SAFE:EYES {eyes.upper()}")

    def eyes(self) -> str:
        """Return what was said of the subject's eyes."""
        payload = self._port.ask("SAFE:EYES?").lower()
        if payload not in EYE_STATES:
            raise self._bad_answer("SAFE:EYES?", payload, "OPEN, CLOSED or SHIELDED")
        return payload

    def dose_ws(self, led: int) -> float:
        """Return what an LED has sent out to this subject, Ws."""
        return self._number(f"DOSE? {led}")

    def new_subject(self, pseudonym: str) -> None:
        """Begin to count the dose anew; what was said of the eyes is forgotten."""
        self._port.ask(f"DOSE:NEW {pseudonym}")


def _parse_evaluation(payload: str) -> TableEvaluation:
    flashes, rms, duty, heat, dose_ws = (float(field) for field in payload.split(","))
    return TableEvaluation(flashes, rms, duty, heat, dose_ws)


def _parse_position(payload: str) -> SequencePosition:
    state, row, rows, token = payload.split(",")
    return SequencePosition(state, int(row), int(rows), "" if token == "-" else token)
