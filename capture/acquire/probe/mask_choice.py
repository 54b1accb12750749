"""Which exposures of a covered head serve: one that shows the fibre, one that shows its neighbors.

With all fibres covered but one, its own spot is to be seen unsaturated, and the light that strays
to others, of a thousandth of it, above the noise. The phantom has told how bright each fibre is.
"""

from collections.abc import Sequence

import numpy as np

from capture.acquire.probe.fiber_signal import FiberSignal
from capture.arrays import Float64Array
from capture.plan import Step
from capture.session import Session

MAX_UNSATURATED_LEVEL = 0.7
"""Share of full scale up to which a spot is safely unsaturated."""
MAX_OVEREXPOSURE = 64.0
"""How many times longer its neighbors are looked at: a thousandth of it then stands at some per
cent of full scale, and what is saturated does not yet spill over."""


def usable_exposures(steps: Sequence[Step], rate_per_s: Float64Array) -> set[str]:
    """Return the ids of those exposures of covered heads that serve.

    Parameters
    ----------
    steps : sequence of Step
        Of kind "mask".
    rate_per_s : ndarray of float64, shape (F, C)
        Peak of each fibre in each color on the same phantom, full scales per second.

    Examples
    --------
    >>> steps = [
    ...     Step(f"m{k}", "mask", {"fibre": 0, "bracket": k},
    ...          {"exposure_s": 0.01 * 4.0**k, "fibre": 0}, ("cam",)) for k in range(6)]
    >>> sorted(usable_exposures(steps, np.array([[1.0, 3.0, 0.2]])))
    ['m2', 'm5']
    """
    kept: set[str] = set()
    by_fibre: dict[int, list[Step]] = {}
    for step in steps:
        by_fibre.setdefault(int(step.settings["fibre"]), []).append(step)
    for fibre, some in by_fibre.items():
        ordered = sorted(some, key=lambda step: float(step.settings["exposure_s"]))
        seconds = np.array([float(step.settings["exposure_s"]) for step in ordered])
        brightest = float(rate_per_s[fibre].max())
        own = max(int(np.count_nonzero(seconds * brightest <= MAX_UNSATURATED_LEVEL)) - 1, 0)
        # exposures are whole milliseconds on some boxes: a hair of room
        others = int(np.count_nonzero(seconds <= 1.01 * MAX_OVEREXPOSURE * seconds[own])) - 1
        kept |= {ordered[own].id, ordered[others].id}
    return kept


def masks_not_needed(session: Session) -> tuple[list[Step], str]:
    """Return which exposures of covered heads a session can do without, and why.

    They are chosen once: where one was taken or left out before, or where the phantom has not been
    seen at its first placement, none.
    """
    masks = [step for step in session.plan.steps if step.kind == "mask"]
    left_out = session.left_out()
    phantom = session.frames("phantom", repeat=0)
    chosen = session.frames("mask") or any(step.id in left_out for step in masks)
    if not phantom or chosen or session.rig.probe is None:
        return [], ""
    camera = masks[0].cameras[0]
    signal = FiberSignal(session.rig.probe, session.rig.view(camera))
    for record in phantom:
        if record.camera == camera:
            signal.look(np.asarray(session.read(record).cfa), float(record.settings["exposure_s"]))
    kept = usable_exposures(masks, signal.rate_per_s)
    rest = [step for step in masks if step.id not in kept]
    return rest, (
        f"{len(rest)} of {len(masks)} exposures of the covered head left out: per fibre one that "
        "shows it unsaturated serves, and one that shows light astray from it"
    )
