"""Run a plan on the fibre probe: darks, then series of exposures, placement by placement."""

from __future__ import annotations

from collections.abc import Mapping

from capture.acquire.outcome import Acquired, Operator, tear_down
from capture.acquire.probe.bracket_series import BracketSeries
from capture.acquire.probe.checks import check_cameras, check_probe
from capture.acquire.probe.driver import PROBE_LEASE_S, ProbeDriver
from capture.devices.camera import Camera
from capture.plan import Plan
from capture.rig import Rig
from capture.session import Session


def run_probe(
    plan: Plan,
    rig: Rig,
    *,
    box: ProbeDriver,
    cameras: Mapping[str, Camera],
    session: Session,
    operator: Operator,
    all_brackets: bool = False,
) -> Acquired:
    """Capture what the session still lacks of a plan of the fibre probe; see `run_plan`.

    Everything that can be refused is, before anything is lit or sucked at. The dark frames come
    first, under a cap; then a person is asked to place the head, once per series on
    skin. Whatever happens, the shutter ends up shut, the LED out and the head vented.

    Raises
    ------
    AcquisitionError
        Where the suction cannot be held at a placement, three times; where the camera does not come
        to its temperature; or where a frame fails three times.
    """
    check_probe(plan, rig, box.limits)
    check_cameras(rig, cameras)
    series = BracketSeries(rig, box, cameras, session, operator, all_brackets=all_brackets)
    try:
        box.dark()  # whatever was going on before
        box.set_lease(PROBE_LEASE_S)
        if not session.frames():
            box.new_subject(session.id[:32])
        series.darks()
        series.run()
    finally:
        tear_down(box, cameras)
    return Acquired(series.steps, series.frames, series.stale, series.retakes)
