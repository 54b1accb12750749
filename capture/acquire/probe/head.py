"""Place the probe's head by a person, hold it by suction, and monitor it.

A placement is valid while the head is held or rests in good order. When the suction ends
unexpectedly, or is not reached, the position of the head is uncertain: a person places it again,
and all exposures of the series are repeated.
"""

import logging

from capture.acquire.outcome import MAX_ATTEMPTS, AcquisitionError, Operator, recovery_advice
from capture.devices.port import CommandRefused
from capture.devices.probe import ProbeBox
from capture.devices.wire import Code
from capture.plan.probe import CAP_SITE
from capture.plan.suction import WIRE_SLACK_S, HeadPlacement
from capture.rig import Probe

log = logging.getLogger(__name__)

SUCTION_POLL_S = 0.1
SUCTION_MARGIN_S = 1.0
"""Margin beyond the controller's own time for reaching a suction, s."""
DETACHED_SUCTION_RATIO = 0.5
"""Fraction of its suction below which a head has come off."""
CAMERA_TEMPERATURE_TIMEOUT_S = 180.0
"""Longest wait for a camera to reach its temperature, s."""
CAMERA_TEMPERATURE_POLL_S = 1.0


class HeadLost(Exception):
    """Raised when the position of the head is uncertain; it can be placed again."""


class HoldOutOfTolerance(Exception):
    """Raised when suction or temperature left their limits; the exposure can be repeated."""


class Head:
    """Placement of the head, and its hold by suction.

    Parameters
    ----------
    probe
        Suction, tolerances and times.
    box
        Driver of its controller.
    operator
        Person who places it.
    placements
        Number of placements in earlier runs.

    Attributes
    ----------
    placements : int
        Number of placements, these included.
    """

    def __init__(self, probe: Probe, box: ProbeBox, operator: Operator, *, placements: int) -> None:
        self._probe, self._box, self._operator = probe, box, operator
        self._place: HeadPlacement | None = None
        self._again = ""
        self.placements = placements

    def require_placement(self, placement: HeadPlacement) -> None:
        """Ensure a placement of the head; a person is prompted when it is elsewhere."""
        if self._place == placement:
            return
        self.detach()
        self._operator.stop_if_asked()
        self._operator.prompt(
            f"place the head on the {placement.site} at {placement.angle_deg:g} degrees"
            + self._again
        )
        self._again = ""
        self._box.arm()
        self._box.place(placement.site, placement.angle_deg)
        self._place = placement
        self.placements += 1
        log.info("placement %d: %s", self.placements, placement)

    def cap(self) -> None:
        """Have a person cap the head, so that no ambient light enters the fibers."""
        self.detach()
        self._operator.stop_if_asked()
        self._operator.prompt("put the cap on the head")
        self.keep_capped()

    def keep_capped(self) -> None:
        """Report the cap again to a controller that has cleared its placement meanwhile."""
        if not self._box.status().placed:
            self._box.arm()
            self._box.place(CAP_SITE, 0.0)

    def detach(self) -> None:
        """Vent, disarm and clear the placement: a person's hands are at the head now."""
        self._box.dark()
        self._place = None

    def note_loss(self, reason: str) -> None:
        """Require a new placement before anything else, and record the reason."""
        self.detach()
        self._again = f" again: {reason}"

    def hold(self, level: float, next_s: float) -> None:
        """Hold the head, settled, for at least a time, with the LED on.

        Raises
        ------
        HeadLost
            When the suction is not reached, or was lost.
        AcquisitionError
            When the gauge has failed.
        """
        state = self._box.suction()
        if state.on and state.left_s >= next_s + WIRE_SLACK_S:
            return
        if state.on:
            self.release()
        self._check_placement()
        while (state := self._box.suction()).left_s > 0.0 and not state.on:
            self._box.listen(min(state.left_s, SUCTION_POLL_S))
        self._wait_for_temperature()
        try:
            self._box.set_level(level)
            self._box.suck(self._probe.suction_mbar, self._probe.max_suction_s)
        except CommandRefused as error:
            raise self._translate_refusal(error) from error
        self._settle()

    def release(self) -> None:
        """Vent; the head stays in its place, and the skin rests."""
        self._box.vent()

    def readings(self) -> tuple[float, float]:
        """Return suction, mbar, and the camera's temperature, degrees Celsius, both within limits.

        Raises
        ------
        NotHeld
            When one is outside; the head is vented then.
        HeadLost
            When the controller has released the head, or it has come off.
        """
        probe = self._probe
        suction_mbar, camera_c = self._box.pressure_mbar(), self._box.camera_c()
        if not self._box.suction().on:
            raise HeadLost(self._describe_suction_end())
        if suction_mbar < DETACHED_SUCTION_RATIO * probe.suction_mbar:
            raise HeadLost(f"the suction fell to {self._format_suction(suction_mbar)}")
        if abs(suction_mbar - probe.suction_mbar) > probe.suction_tolerance_mbar:
            self.release()
            raise HoldOutOfTolerance(f"the suction is {self._format_suction(suction_mbar)}")
        if not self._is_temperature_within(camera_c):
            self.release()
            raise HoldOutOfTolerance(f"the camera is at {self._format_temperature(camera_c)}")
        return suction_mbar, camera_c

    def temperature_c(self) -> float:
        """Return the camera's temperature, degrees Celsius, after it has reached its limits."""
        return self._wait_for_temperature()

    def placement_error(
        self, placement: HeadPlacement, reason: str, *, captured: bool
    ) -> AcquisitionError:
        """Return the error of a placement at which the measurement is not possible."""
        return AcquisitionError(
            f"measurement of {placement}: refused, {reason}, {MAX_ATTEMPTS} times; no frame of "
            "it is kept. Check that the membrane is whole and the tube is on, and that no fold "
            f"and no hair is under the rim; {recovery_advice(captured=captured)} [SR-CAP-019]"
        )

    # waiting ---------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Wait until the suction has stayed within its limits for the rig's settling time."""
        probe = self._probe
        reach_s = float(self._box.limits["reach_ms"]) / 1e3 + SUCTION_MARGIN_S
        waited_s, within_s = 0.0, 0.0
        suction_mbar = 0.0
        while True:
            suction_mbar = self._box.pressure_mbar()
            if not self._box.suction().on:
                raise HeadLost(self._describe_suction_end())
            good = abs(suction_mbar - probe.suction_mbar) <= probe.suction_tolerance_mbar
            if not good:
                within_s = 0.0
                if waited_s >= reach_s + probe.settle_s:
                    raise HeadLost(f"the suction is {self._format_suction(suction_mbar)}")
            elif within_s >= probe.settle_s:
                return
            pause_s = SUCTION_POLL_S if not good else min(SUCTION_POLL_S, probe.settle_s - within_s)
            self._box.listen(max(pause_s, 1e-3))
            waited_s += pause_s
            within_s += pause_s if good else 0.0

    def _wait_for_temperature(self) -> float:
        """Wait until the camera has reached its temperature; return the temperature."""
        waited_s = 0.0
        while not self._is_temperature_within(camera_c := self._box.camera_c()):
            if waited_s == 0.0:
                text = f"the camera is at {self._format_temperature(camera_c)}; waiting for it"
                self._operator.progress(text)
            if waited_s >= CAMERA_TEMPERATURE_TIMEOUT_S:
                raise AcquisitionError(
                    f"camera: still at {self._format_temperature(camera_c)} after"
                    f" {CAMERA_TEMPERATURE_TIMEOUT_S:g} s; its dark current would not be that of"
                    " the dark frames: check its cooling, then run the same command with --resume"
                    " [SR-CAP-020]"
                )
            self._operator.stop_if_asked()
            self._box.listen(CAMERA_TEMPERATURE_POLL_S)
            waited_s += CAMERA_TEMPERATURE_POLL_S
        return camera_c

    def _check_placement(self) -> None:
        if self._place is not None and not self._box.status().placed:
            raise HeadLost(self._describe_suction_end())

    def _translate_refusal(self, error: CommandRefused) -> Exception:
        """Return the meaning of a refusal by the pump or the LED."""
        if error.code in (Code.WATCHDOG_TRIPPED, Code.NOT_ARMED, Code.IGNORED):
            return HeadLost("the controller had released the head")
        return error

    def _describe_suction_end(self) -> str:
        """Return in words how the last suction ended."""
        report = self._box.last_suction()
        if report is None:
            return "the controller had released the head"
        if report.ended == "gauge":
            raise AcquisitionError(
                "the pressure gauge of the probe's controller has failed; the head was vented: "
                "have it repaired, then run the same command with --resume"
            )
        found = self._format_suction(report.suction_mbar)
        return {
            "low": f"the suction reached only {found}",
            "lost": f"the suction fell to {found}",
            "high": f"the suction rose to {found}",
            "timed": "the suction ended too early",
            "asked": "the head was vented",
        }.get(report.ended, "the controller had released the head")

    def _format_suction(self, suction_mbar: float) -> str:
        probe = self._probe
        return (
            f"{suction_mbar:.0f} mbar, expected {probe.suction_mbar:g} "
            f"+- {probe.suction_tolerance_mbar:g} mbar"
        )

    def _is_temperature_within(self, camera_c: float) -> bool:
        return abs(camera_c - self._probe.camera_c) <= self._probe.camera_tolerance_c

    def _format_temperature(self, camera_c: float) -> str:
        probe = self._probe
        return (
            f"{camera_c:.1f} degrees Celsius, expected {probe.camera_c:g} "
            f"+- {probe.camera_tolerance_c:g}"
        )
