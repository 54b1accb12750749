"""Judge an attached controller by its answers alone: nothing lights, moves or sucks.

Each check either returns a figure or raises `CheckupFault` with what was got and expected. The same
checks are the tests of hardware, of firmware under emulators, and of ``skinrig doctor --port``.
"""

import statistics
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Final

from capture.devices import wire
from capture.devices.port import CommandRefused, DeviceError, Port
from capture.devices.wire import Code, Event, Reply, Request

PROTOCOL_MINOR = 3
"""Revision of the protocol's text that this host follows; see `protocol_minor`."""
LEASE_RANGE_MS = (300, 5000)
MAX_CLOCK_ERROR = 0.01
"""Largest deviation of the controller's clock from the host's, relative."""
CLOCK_SPAN_S = 2.0
MAX_LATENCY_S = 0.25
"""A host repeats its request after this time, s."""
PING_COUNT = 30
SLACK_S = 0.2
_UNARMED: Final = {
    "flash": "FLAS:FIRE checkup",
    "dome": "LED:ON 0,10",
    "gradient_sphere": "PATT FULL,10",
    "caliper": "CAL:HOME",
    "probe": "SHUT OPEN,10",
    "scanner": "TRIG checkup,100",
}
"""By kind, a command that is refused unless armed."""
_REFUSED_ARMED: Final = {
    "flash": {
        "FLAS:POW 0": Code.OUT_OF_RANGE,
        "FLAS:POL:ANG 180.1": Code.OUT_OF_RANGE,
        "FLAS:SYNC 50001": Code.OUT_OF_RANGE,
        "FLAS:LED 590": Code.SYNTAX,
        "FLAS:LAMP ON,501": Code.OUT_OF_RANGE,
        "FLAS:FIRE check up": Code.SYNTAX,
    },
    "dome": {
        "SEQ:DEF 0,3:500:1999:1": Code.OUT_OF_RANGE,
        "SAFE:EYES SHUT": Code.SYNTAX,
        "LED:ON 0,501": Code.OUT_OF_RANGE,
        "TRIG checkup": Code.NOT_ARMED,
    },
    "gradient_sphere": {
        "SEQ:DEF 0,X:181:1000:30000:1": Code.OUT_OF_RANGE,
        "SAFE:EYES SHUT": Code.SYNTAX,
        "PATT FULL,501": Code.OUT_OF_RANGE,
        "TRIG checkup": Code.NOT_ARMED,
    },
    "caliper": {
        "CAL:FORC:LIM 0": Code.OUT_OF_RANGE,
        "CAL:FORC:LIM 10.1": Code.OUT_OF_RANGE,
        "CAL:STEP:ABS 1.5": Code.SYNTAX,
        "CAL:ANG 181": Code.OUT_OF_RANGE,
    },
    "probe": {
        "HEAD:SITE checkup,360": Code.OUT_OF_RANGE,
        "LED 1001": Code.OUT_OF_RANGE,
        "SHUT OPEN,0.5": Code.OUT_OF_RANGE,
        "PUMP ON,99,60": Code.OUT_OF_RANGE,
        "PUMP ON,5000,60": Code.IGNORED,
    },
    "scanner": {
        "PROJ 99": Code.OUT_OF_RANGE,
        "PAT COL,999": Code.OUT_OF_RANGE,
        "SAFE:EYES SHUT": Code.SYNTAX,
        "TRIG checkup": Code.SYNTAX,
        "TRIG checkup,100": Code.FLICKER,
    },
}
"""By kind, what an armed controller refuses after `SAFE`, at open eyes."""
_EYES: Final = ("dome", "gradient_sphere", "scanner")
_QUEUED_ERRORS = 16
MAX_NUMBERS_KEPT = 1000
"""More requests than any controller keeps answers of."""


class CheckupPort(Port):
    """A port that can also send what is not a request."""

    def exchange_raw(self, data: bytes, seconds: float) -> list[bytes]:
        """Send bytes as they are and return the first lines that come within `seconds`."""
        self._check_thread()
        lines: list[bytes] = []
        end_s = self.clock.monotonic() + seconds
        with self._translate_errors("exchange bytes"):
            self._serial.write(data)
            while not lines and self.clock.monotonic() < end_s:
                lines += self._splitter.feed(self._serial.read(max(1, self._serial.in_waiting)))
        return lines

    def make_request(self, text: str) -> Request:
        """Return a request with the next number, to be sent by `exchange_raw`."""
        seq, self._seq = self._seq, wire.next_seq(self._seq)
        return Request(seq, self.boot, text)


class CheckupFault(Exception):
    """A controller that breaks a rule of the protocol."""

    @classmethod
    def raise_unless(cls, good: bool, what: str, got: object, expected: object) -> None:
        """Report a fault unless `good`."""
        if not good:
            raise cls(f"{what}: got {got!r}, expected {expected}")


@dataclass(frozen=True, slots=True)
class CheckupResult:
    """One check of a controller."""

    what: str
    """Name of the check."""
    state: str
    """Figure, or what was got and expected."""
    fine: bool


def protocol_minor(limits: dict[str, object]) -> int:
    """Return the revision of the protocol's text that a controller follows, from its limits.

    Examples
    --------
    >>> protocol_minor({}), protocol_minor({"protocol_minor": 1})
    (0, 1)
    """
    minor = limits.get("protocol_minor", 0)
    return minor if isinstance(minor, int) else 0


def check_identity(port: CheckupPort) -> str:
    """Compare the two names that a controller gives itself."""
    hello = port.hello()
    maker, *rest = port.ask("*IDN?").split(",")
    expected = f"{maker},<model>,{hello.serial},{hello.firmware}"
    same = len(rest) == 3 and rest[1:] == [hello.serial, hello.firmware]
    CheckupFault.raise_unless(same, "*IDN?", ",".join([maker, *rest]), expected)
    CheckupFault.raise_unless(hello.kind in _UNARMED, "kind", hello.kind, ", ".join(_UNARMED))
    return f"{hello.kind} {hello.serial}, {rest[0]}, firmware {hello.firmware}"


def check_limits(port: CheckupPort) -> str:
    """Read the limits in parts and as a whole, and compare version and lease."""
    limits = port.capabilities()
    CheckupFault.raise_unless(
        limits.get("protocol") == wire.PROTOCOL_VERSION,
        "protocol",
        limits.get("protocol"),
        wire.PROTOCOL_VERSION,
    )
    lease = limits.get("lease_min_ms"), limits.get("lease_max_ms")
    CheckupFault.raise_unless(lease == LEASE_RANGE_MS, "lease limits", lease, LEASE_RANGE_MS)
    return f"protocol {wire.PROTOCOL_VERSION}.{protocol_minor(limits)}, {len(limits)} limits"


def _ping(port: CheckupPort) -> tuple[float, float, float]:
    """Return the controller's clock, the host's clock in the middle of the query, and its time."""
    start_s = time.monotonic()
    clock_s = int(port.ask("SYST:PING?")) / 1e6
    end_s = time.monotonic()
    return clock_s, 0.5 * (start_s + end_s), end_s - start_s


def check_latency(port: CheckupPort) -> str:
    """Measure the time of an answer; a host repeats its request when it takes too long."""
    spans_s = [_ping(port)[2] for _ in range(PING_COUNT)]
    middle_s = statistics.median(spans_s)
    CheckupFault.raise_unless(middle_s < MAX_LATENCY_S, "latency", middle_s, "less than 0.25 s")
    return f"median {1e3 * middle_s:.1f} ms, longest {1e3 * max(spans_s):.1f} ms"


def check_clock(port: CheckupPort) -> str:
    """Compare the rates of the controller's clock and of the host's within 1 %.

    Of several queries the quickest counts: its time is known best.
    """

    def best() -> tuple[float, float, float]:
        return min((_ping(port) for _ in range(5)), key=lambda ping: ping[2])

    first = best()
    port.listen(CLOCK_SPAN_S)
    last = best()
    rate = (last[0] - first[0]) / (last[1] - first[1])
    good = abs(rate - 1.0) <= MAX_CLOCK_ERROR
    CheckupFault.raise_unless(good, "clock rate", rate, "1 within 1 %")
    return f"rate {rate:.4f}"


def _code(port: Port, text: str) -> int:
    try:
        port.ask(text)
    except CommandRefused as refused:
        return int(refused.code)
    return int(Code.OK)


def check_refusals(port: CheckupPort) -> str:
    """Send what must be refused: out of range, unarmed, damaged, foreign, repeated and bare."""
    kind = port.hello().kind
    port.ask("SAFE")
    port.ask("*CLS")
    expected = {
        _UNARMED[kind]: {Code.NOT_ARMED, Code.WATCHDOG_TRIPPED},
        "CHECKUP:NONE?": {Code.UNDEFINED_HEADER},
        "SYST:WDOG": {Code.SYNTAX},
        "SYST:WDOG x": {Code.SYNTAX},
        f"SYST:WDOG {LEASE_RANGE_MS[0] - 1}": {Code.OUT_OF_RANGE},
        f"SYST:WDOG {LEASE_RANGE_MS[1] + 1}": {Code.OUT_OF_RANGE},
        "SYST:CAP:PART? 999": {Code.OUT_OF_RANGE},
    }
    for text, codes in expected.items():
        _require_refusal(port, text, codes)
    if kind in _EYES:
        port.ask("SAFE:EYES OPEN")
    port.ask("SYST:ARM")
    for text, code in _REFUSED_ARMED[kind].items():
        _require_refusal(port, text, {code})
    port.ask("SAFE")
    for _ in range(_QUEUED_ERRORS + 1):
        _code(port, "CHECKUP:NONE?")
    errors = [port.ask("SYST:ERR?") for _ in range(_QUEUED_ERRORS)]
    overflow = int(Code.QUEUE_OVERFLOW)
    CheckupFault.raise_unless(
        errors[-1].startswith(f"{overflow},"), "error queue", errors[-1], overflow
    )
    damaged = wire.encode(port.make_request("SYST:PING?")).replace(b"PING", b"PONG")
    foreign = wire.encode(replace(port.make_request("SYST:PING?"), boot=port.boot ^ 1 or 2))
    request = port.make_request("SYST:WDOG?")
    reused, other = wire.encode(request), wire.encode(replace(request, text="SYST:ARM?"))
    _require_frame(port, damaged, lambda f: isinstance(f, Event) and f.name == "NAK", "NAK 204")
    _require_code(port, foreign, Code.BOOT_CHANGED)
    _require_code(port, reused, Code.OK)
    _require_code(port, other, Code.SEQ_REUSED)
    port.ask("*CLS")
    port.exchange_raw(b"SYST:ARM\n", SLACK_S)
    queued = port.ask("SYST:ERR?")
    unframed = queued.startswith(f"{int(Code.UNFRAMED)},")
    CheckupFault.raise_unless(unframed, "bare SYST:ARM", queued, "203 in the error queue")
    CheckupFault.raise_unless(port.ask("SYST:ARM?") == "0", "armed", "1", "0")
    return f"{len(expected) + len(_REFUSED_ARMED[kind]) + 6} refused as specified"


def check_retries(port: CheckupPort) -> str:
    """Send one frame twice: the answer is the same, and the clock in it has not moved."""
    request = port.make_request("SYST:PING?")
    frame = wire.encode(request)
    answers = [port.exchange_raw(frame, SLACK_S) for _ in range(2)]
    CheckupFault.raise_unless(
        answers[0] == answers[1] != [], "retry", answers[1], f"the first answer, {answers[0]}"
    )
    if protocol_minor(port.capabilities()) < 2:
        return "a repeated frame gets its first answer"
    behind = replace(request, seq=(request.seq - MAX_NUMBERS_KEPT) % (wire.MAX_SEQ + 1))
    _require_code(port, wire.encode(behind), Code.SEQ_REUSED)
    return "a repeated frame gets its first answer, an old one is refused"


def check_lease(port: CheckupPort) -> str:
    """Arm, fall silent, and find the controller disarmed by itself."""
    lease_ms = LEASE_RANGE_MS[0]
    port.ask(f"SYST:WDOG {lease_ms}")
    port.ask("SYST:ARM")
    port.listen(0.0)
    events = [event.name for event in port.listen(lease_ms / 1e3 + SLACK_S)]
    CheckupFault.raise_unless("WDOG:TRIP" in events, "events", events, "WDOG:TRIP")
    CheckupFault.raise_unless(port.ask("SYST:ARM?") == "0", "armed", "1", "0")
    CheckupFault.raise_unless(bool(int(port.ask("STAT?")) & 2), "STAT?", "no bit 2", "bit 2")
    _require_refusal(port, _UNARMED[port.hello().kind], {Code.WATCHDOG_TRIPPED})
    port.ask("SYST:ARM")
    port.ask("SAFE")
    CheckupFault.raise_unless(port.ask("SYST:ARM?") == "0", "armed after SAFE", "1", "0")
    return f"disarmed itself after {lease_ms} ms, and at SAFE"


def check_stop(port: CheckupPort) -> str:
    """Report the emergency stop; a person opens and closes it for the bring-up."""
    return "open" if int(port.ask("STAT?")) & 256 else "closed"


CONTROLLER_CHECKS: Final[dict[str, Callable[[CheckupPort], str]]] = {
    "identity": check_identity,
    "limits": check_limits,
    "latency": check_latency,
    "clock": check_clock,
    "refusals": check_refusals,
    "retries": check_retries,
    "lease": check_lease,
    "emergency stop": check_stop,
}
"""What is judged, in order."""


def judge_controller(port: CheckupPort) -> list[CheckupResult]:
    """Run all checks on an open port and return their results; it is disarmed at the end.

    Raises
    ------
    DeviceError
        When nothing answers at the other end.
    """
    port.hello()
    results = []
    for what, check in CONTROLLER_CHECKS.items():
        try:
            results.append(CheckupResult(what, check(port), fine=True))
        except (CheckupFault, DeviceError) as fault:
            results.append(CheckupResult(what, str(fault), fine=False))
    port.ask("SAFE")
    return results


def _require_refusal(port: Port, text: str, codes: Collection[Code]) -> None:
    got = _code(port, text)
    names = " or ".join(str(int(code)) for code in sorted(codes))
    CheckupFault.raise_unless(got in codes, text, got, names)


def _require_frame(
    port: CheckupPort, data: bytes, fits: Callable[[object], bool], expected: object
) -> None:
    frames = [wire.decode(line) for line in port.exchange_raw(data, SLACK_S)]
    CheckupFault.raise_unless(any(map(fits, frames)), repr(data), frames, expected)


def _require_code(port: CheckupPort, data: bytes, code: Code) -> None:
    _require_frame(
        port, data, lambda frame: isinstance(frame, Reply) and frame.code == code, int(code)
    )
