"""The probe's head on the skin: placed by a person, held by suction, watched.

A placement lasts as long as the head is held or rests in good order. Where the suction ends by
itself, or is not reached, nobody knows whether the head is still where it was: a person places it
anew, and all exposures of the series are taken again.
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
"""Beyond the box's own time for reaching a suction."""
DETACHED_SUCTION_RATIO = 0.5
"""A head under less than this of its suction has come off."""
CAMERA_TEMPERATURE_TIMEOUT_S = 180.0
"""How long a camera that is too warm, or too cold, is waited for, s."""
CAMERA_TEMPERATURE_POLL_S = 1.0


class HeadLost(Exception):
    """Nobody knows whether the head is where it was placed; it can be placed anew."""


class HoldOutOfTolerance(Exception):
    """Suction or temperature went beyond its limits during an exposure; it can be taken again."""


class Head:
    """Where the head is, and whether it is held there.

    Parameters
    ----------
    probe
        For suction, tolerances and times.
    box
        Its driver.
    operator
        Who places it.
    placements
        How often it was placed in earlier runs.

    Attributes
    ----------
    placements : int
        How often it was placed, these included.
    """

    def __init__(self, probe: Probe, box: ProbeBox, operator: Operator, *, placements: int) -> None:
        self._probe, self._box, self._operator = probe, box, operator
        self._place: HeadPlacement | None = None
        self._again = ""
        self.placements = placements

    def require_placement(self, placement: HeadPlacement) -> None:
        """Have the head at a placement; a person is asked where it is not there."""
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
        """Have a person cap the head, so that no light of the room enters the fibres."""
        self.detach()
        self._operator.stop_if_asked()
        self._operator.prompt("put the cap on the head")
        self.keep_capped()

    def keep_capped(self) -> None:
        """Tell a box that has let go of everything meanwhile that the cap is where it was."""
        if not self._box.status().placed:
            self._box.arm()
            self._box.place(CAP_SITE, 0.0)

    def detach(self) -> None:
        """Vent, disarm and forget the placement: a person's hands are at the head now."""
        self._box.dark()
        self._place = None

    def note_loss(self, reason: str) -> None:
        """Have the head placed anew before anything else, and say why."""
        self.detach()
        self._again = f" again: {reason}"

    def hold(self, level: float, next_s: float) -> None:
        """Have the head held, settled, for at least so long, and the LED lit.

        Raises
        ------
        HeadLost
            Where the suction is not reached, or was lost.
        AcquisitionError
            Where the gauge is dead.
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
        """Vent; the head stays where it is, and the skin has its rest."""
        self._box.vent()

    def readings(self) -> tuple[float, float]:
        """Return suction, mbar, and the camera's temperature, degrees Celsius, both within limits.

        Raises
        ------
        NotHeld
            Where one is not; the head is vented then.
        HeadLost
            Where the box has let go of the head, or it has come off.
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
        """Return the camera's temperature, degrees Celsius, after it has come within its limits."""
        return self._wait_for_temperature()

    def placement_error(
        self, placement: HeadPlacement, reason: str, *, captured: bool
    ) -> AcquisitionError:
        """Return the error of a placement at which the measurement cannot be made."""
        return AcquisitionError(
            f"measurement of {placement}: refused, {reason}, {MAX_ATTEMPTS} times; no frame of it"
            f" is "
            "kept. Check that the membrane is whole and the tube is on, and that no fold and no "
            f"hair lies under the rim; {recovery_advice(captured=captured)}"
        )

    # what is waited for -----------------------------------------------------------------------

    def _settle(self) -> None:
        """Wait until the suction has stayed within its limits for as long as the rig says."""
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
        """Wait until the camera is as cold as it is to be; return its temperature."""
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
                )
            self._operator.stop_if_asked()
            self._box.listen(CAMERA_TEMPERATURE_POLL_S)
            waited_s += CAMERA_TEMPERATURE_POLL_S
        return camera_c

    def _check_placement(self) -> None:
        if self._place is not None and not self._box.status().placed:
            raise HeadLost(self._describe_suction_end())

    def _translate_refusal(self, error: CommandRefused) -> Exception:
        """Return what a refusal of the pump or the LED means."""
        if error.code in (Code.WATCHDOG_TRIPPED, Code.NOT_ARMED, Code.IGNORED):
            return HeadLost("the box had let go of the head")
        return error

    def _describe_suction_end(self) -> str:
        """Return in words how the last suction ended."""
        report = self._box.last_suction()
        if report is None:
            return "the box had let go of the head"
        if report.ended == "gauge":
            raise AcquisitionError(
                "the pressure gauge of the probe's box is dead; the head was vented: have it "
                "mended, then run the same command with --resume"
            )
        found = self._format_suction(report.suction_mbar)
        return {
            "low": f"the suction reached only {found}",
            "lost": f"the suction fell to {found}",
            "high": f"the suction rose to {found}",
            "timed": "the suction came to its end too early",
            "asked": "the head was vented",
        }.get(report.ended, "the box had let go of the head")

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
