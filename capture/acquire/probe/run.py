"""Run a plan on the fibre probe: darks, then series of exposures, placement by placement."""

from capture.acquire.outcome import Acquired, CaptureRun
from capture.acquire.probe.bracket_series import BracketSeries
from capture.acquire.probe.checks import check_cameras, check_probe
from capture.devices.probe import ProbeBox

PROBE_LEASE_S = 5.0
"""A frame may keep the host busy for a while; after this silence the box lets go."""


def run_probe(run: CaptureRun, box: ProbeBox) -> Acquired:
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
    check_probe(run.plan, run.rig, box.limits)
    check_cameras(run)
    series = BracketSeries(run, box)
    try:
        box.dark()  # whatever was going on before
        box.set_lease(PROBE_LEASE_S)
        if not run.session.frames():
            box.new_subject(run.session.id[:32])
        series.darks()
        series.run()
    finally:
        run.tear_down(box)
    return run.account()
