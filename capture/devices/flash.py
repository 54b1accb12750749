"""Driver of the flash controller: one method per command, physical units, no policy.

Nothing lights unless the controller is armed. An armed controller that receives nothing during its
lease goes dark and disarms itself. After `BoxRebooted` call `hello` and set everything up again:
the settings are lost.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from capture.devices.box import Box, BoxStatus, StatusBit, format_decimal
from capture.devices.port import PortTimeout

FLASH_KIND = "flash"
Polarizer = Literal["parallel", "crossed"]
_POLARIZER_WORDS: Mapping[str, Polarizer] = {"PAR": "parallel", "CROS": "crossed"}
_REPORT_FIELDS = "token,us,power,PAR|CROS,degrees,count[,LED]"
_MIN_WAIT_S = 0.02
_CHARGE_POLL_S = 0.2
"""Longest silence while waiting, s; shorter than the shortest lease."""


@dataclass(frozen=True, slots=True)
class FlashReport:
    """Report of a flash by the controller."""

    token: str
    """Token given with the command."""
    t_box_s: float
    """Time on the controller's clock, s since power-up."""
    power: float
    """Energy relative to a full flash, 0 to 1."""
    polarizer: Polarizer
    """Polarizer state that was last requested."""
    analyzer_deg: float
    """Reading of the rotator, degrees; 0 parallel, 90 crossed."""
    count: int
    """Number of flashes since manufacture, this one included."""
    led: str = ""
    """Name of the LED that flashed instead of the tube, such as LED-590-20; empty: the tube."""


@dataclass(frozen=True, slots=True)
class ChargeState:
    """Charge of the capacitor, and when a flash is possible."""

    charge: float
    """Energy in the capacitor, 0 to 1 of a full flash."""
    ready: bool
    """Whether an armed controller would fire now."""
    ready_in_s: float
    """Time until it would, s; 0 when ready."""


class FlashStatus(BoxStatus):
    """Bits of ``STAT?``."""

    __slots__ = ()

    turning = StatusBit(4)
    """Whether the analyzer turns."""


class FlashBox(Box):
    """Driver of the flash controller.

    Parameters
    ----------
    port
        Open port; the driver closes it.
    serial
        Expected serial number of the controller; empty: any.

    Raises
    ------
    WrongDevice
        When the controller is not a flash controller, or has another serial number.
    """

    kind = FLASH_KIND

    def status(self) -> FlashStatus:
        """Return the status bits."""
        return FlashStatus(int(self._number("STAT?")))

    # analyzer ---------------------------------------------------------------------------------

    def set_polarizer(self, polarizer: str) -> None:
        """Start turning the analyzer to "parallel" or "crossed"."""
        words = {stop: word for word, stop in _POLARIZER_WORDS.items()}
        if polarizer not in words:
            raise ValueError(f"polarizer: got {polarizer!r}, expected 'parallel' or 'crossed'")
        self._port.ask(f"FLAS:POL {words[polarizer]}")

    def polarizer(self) -> Polarizer:
        """Return the polarizer state that was last requested."""
        return self._read("FLAS:POL?", _POLARIZER_WORDS.__getitem__, "PAR or CROS")

    def set_analyzer(self, angle_deg: float) -> None:
        """Start turning the analyzer to a reading, in degrees."""
        self._port.ask(f"FLAS:POL:ANG {format_decimal('angle_deg', angle_deg, 9)}")

    def analyzer_deg(self) -> float:
        """Return the present or target reading of the analyzer, in degrees."""
        return self._number("FLAS:POL:ANG?")

    def is_settled(self) -> bool:
        """Return whether the analyzer is at rest."""
        return self._flag("*OPC?")

    # flash ------------------------------------------------------------------------------------

    def set_power(self, power: float) -> None:
        """Set the power of the next flashes, 0 to 1 of full."""
        self._port.ask(f"FLAS:POW {format_decimal('power', power, 9)}")

    def power(self) -> float:
        """Return the power of the next flash, 0 to 1 of full."""
        return self._number("FLAS:POW?")

    def set_sync_delay(self, seconds: float) -> None:
        """Set the delay from the camera line to the flash, in s; 0 at power-up."""
        self._port.ask(f"FLAS:SYNC {format_decimal('seconds', seconds * 1e6, 9)}")

    def sync_delay_s(self) -> float:
        """Return the delay from the camera line to the flash, in s."""
        return self._number("FLAS:SYNC?") / 1e6

    def set_led(self, center_nm: float, width_nm: float) -> None:
        """Replace the tube by an LED for the next flash: its center and full width, in nm."""
        center, width = (
            format_decimal(name, value, 9)
            for name, value in (("center_nm", center_nm), ("width_nm", width_nm))
        )
        self._port.ask(f"FLAS:LED {center},{width}")

    def led(self) -> str:
        """Return the LED of the next flash, such as LED-590-20; empty: the tube."""
        name = self._port.ask("FLAS:LED?")
        return "" if name == "TUBE" else name

    def charge_state(self) -> ChargeState:
        """Return whether a flash is possible, and when it will be."""
        return self._read("FLAS:CHAR?", _charge_state, "charge,ready,ms")

    def wait_charged(self, timeout_s: float) -> None:
        """Wait until a flash is possible: charged, recovered, and the analyzer at rest.

        Waiting means listening to the line, so that time is the controller's, real or simulated,
        and the lease is renewed.

        Raises
        ------
        PortTimeout
            When the controller is not ready in `timeout_s`.
        """
        waited_s = 0.0
        while not (state := self.charge_state()).ready:
            if waited_s >= timeout_s:
                raise PortTimeout(
                    f"{self._port.url}: the flash is not ready after {timeout_s:g} s (charge "
                    f"{state.charge:.2f}); check its mains and its emergency stop [SR-CAP-010]"
                )
            pause_s = min(max(state.ready_in_s, _MIN_WAIT_S), _CHARGE_POLL_S)
            self._port.listen(pause_s)
            waited_s += pause_s

    def fire(self, token: str) -> FlashReport:
        """Pulse the camera line and flash once, after the set delay.

        A repeated request never flashes twice. After `PortTimeout` or `LinkLost` it is not known
        whether it flashed: `last_pop` reports it, unless the controller has rebooted.
        """
        return self._read(f"FLAS:FIRE {token}", _parse_report, _REPORT_FIELDS, shown="FLAS:FIRE")

    def last_pop(self) -> FlashReport | None:
        """Return the report of the last flash since power-up, None when there was none."""
        return self._read_or_none("FLAS:LAST?", _parse_report, _REPORT_FIELDS)

    def count(self) -> int:
        """Return the number of flashes since manufacture."""
        return int(self._number("FLAS:COUN?"))

    def trigger_cameras(self, token: str) -> float:
        """Pulse the camera line without light; return the controller's time of the pulse, in s."""
        return self._token_time("CAM:TRIG", token)

    # lamps ------------------------------------------------------------------------------------

    def lamp_on(self, seconds: float) -> None:
        """Light the modeling lamps for `seconds` (at most 0.5) from now."""
        self._port.ask(f"FLAS:LAMP ON,{format_decimal('seconds', seconds * 1e3, 9)}")

    def lamp_off(self) -> None:
        """Switch the modeling lamps off."""
        self._port.ask("FLAS:LAMP OFF")

    def is_lamp_lit(self) -> bool:
        """Return whether the modeling lamps are on."""
        return self._flag("FLAS:LAMP?")


def _charge_state(payload: str) -> ChargeState:
    charge, ready, wait_ms, *_ = payload.split(",")
    return ChargeState(float(charge), int(ready) == 1, int(wait_ms) / 1e3)


def _parse_report(payload: str) -> FlashReport:
    token, t_us, power, stop, angle_deg, count, *led = payload.split(",")
    polarizer, t_s = _POLARIZER_WORDS[stop], int(t_us) / 1e6
    return FlashReport(token, t_s, float(power), polarizer, float(angle_deg), int(count), *led)


DRIVER: Final = FlashBox
