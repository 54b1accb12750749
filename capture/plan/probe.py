"""Generate plans of the fiber probe: exposures on skin, and its calibration on a phantom.

Between the nearest and the farthest fiber light decreases by more than five decades, of which one
exposure covers three. Each measurement is therefore a series of exposures, from short to long, of
one placement of the head. A pump holds the head for as long as skin tolerates without a rest; the
remaining exposures follow after the rest, at the same placement.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Literal, get_args

from capture.plan.steps import (
    Index,
    Kind,
    Plan,
    Step,
    StepSeries,
    int_if_whole,
    require_argument,
    require_repeats,
)
from capture.plan.suction import HeadPlacement, step_placement
from capture.rig import Probe, Rig, is_id

ProbeTarget = Literal["phantom", "dark"]

PROBE_SITES = ("forehead", "cheek", "chin")
"""Sites of Weyrich et al. (2006); "chin" is below them."""
PHANTOM_SITE = "phantom"
"""Site of the block of known optics."""
CAP_SITE = "cap"
"""Site of the head during frames without light."""
N_BRACKETS = 23
MAX_EXPOSURE_S = 30.0
BRACKET_STEP_EV = 2.0 / 3.0
"""Weyrich et al. (2006), section 8 (doi 10.1145/1141911.1141987): 23 images, 2/3 stop apart, in
about 88 s. From 30 s down they take 81 s, plus 0.3 s of readout each.
"""
DARK_POSITIONS = (0.0, 0.75, 1.0)
"""Positions of dark exposures in the series, from its shortest to its longest exposure."""
MASK_INTERVAL = 3
"""Interval of brackets planned for a covered head: every third, two stops apart."""
MAX_MASK_EXPOSURE_S = 8.0
"""Longest exposure of a covered head, s: cross-talk of a fiber that is dim after this is below the
noise, and can be neglected.
"""


def probe_plan(
    rig: Rig,
    *,
    sites: Sequence[str] = PROBE_SITES,
    repeats: int = 1,
    angles: int = 1,
    brackets: int = N_BRACKETS,
    max_exposure_s: float = MAX_EXPOSURE_S,
    step_ev: float = BRACKET_STEP_EV,
    darks: int = 2,
    level: float = 1.0,
    iso: int = 100,
) -> Plan:
    """Plan measurements of skin at several sites, along one or more directions.

    Parameters
    ----------
    rig : Rig
        Rig with a probe.
    sites : sequence of str
        Sites of the head, in this order.
    repeats : int
        Repeats at each site and angle, >= 1; the head is placed again each time.
    angles : int
        Number of directions of the line of fibers about the source, >= 1: multiples of 360/angles
        degrees. 16 are 22.5 degrees apart over the full circle, as in figure 10 of Weyrich et al.
        (2006), rather than half: tissue with aligned fibers is equal in opposite directions, tissue
        that changes from one side to the other is not, and only a full circle separates the two.
    brackets : int
        Exposures of a series, >= 2; number 0 is the shortest.
    max_exposure_s : float
        Last exposure, s, > 0.
    step_ev : float
        Ratio of successive exposures, stops, > 0.
    darks : int
        Frames without light for each of few exposure times, >= 0, before the head is placed; a cap
        blocks ambient light. Few times are enough: the dark signal of a pixel is an offset plus a
        current times the exposure. The shortest time gives the offset, the longest the current, and
        one between detects deviations.
    level : float
        Level of the LED behind the source fiber, 0 < level <= 1.
    iso : int

    Returns
    -------
    Plan
        Dark frames, then per site, repeat and angle the series from short to long. Ids are like
        "forehead-r0-a000-b07".

    Raises
    ------
    PlanError
        When the limits of the rig's probe are exceeded.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("probe")
    >>> plan = probe_plan(rig, sites=["cheek"], darks=0)
    >>> len(plan.steps), plan.steps[0].id, round(plan.steps[0].settings["exposure_s"], 5)
    (23, 'cheek-r0-a000-b00', 0.00115)
    >>> [step.id for step in probe_plan(rig, sites=["chin"], angles=16).steps][-1]
    'chin-r0-a337.5-b22'
    >>> frames_s = sum(step.settings["exposure_s"] + 0.3 for step in plan.steps)
    >>> round(frames_s), round(plan.estimate_duration_s(rig))
    (88, 99)
    """
    chosen = tuple(sites)
    for site in chosen:
        named = is_id(site) and site not in (PHANTOM_SITE, CAP_SITE)
        require_argument(named, "sites", site, f"a name, not {PHANTOM_SITE!r} or {CAP_SITE!r}")
    require_argument(
        len(set(chosen)) == len(chosen) > 0, "sites", chosen, "at least one, none twice"
    )
    require_repeats(repeats)
    require_argument(1 <= angles <= 360, "angles", angles, "1 to 360")
    series = _Series(
        rig, brackets=brackets, longest_s=max_exposure_s, step_ev=step_ev, level=level, iso=iso
    )
    series.darks(darks)
    for site in chosen:
        for repeat in range(repeats):
            for number in range(angles):
                series.measure("fibers", site, repeat, 360.0 * number / angles)
    return series.plan()


def probe_calibration_plan(
    rig: Rig,
    target: ProbeTarget = "phantom",
    *,
    repeats: int = 1,
    brackets: int = N_BRACKETS,
    max_exposure_s: float = MAX_EXPOSURE_S,
    step_ev: float = BRACKET_STEP_EV,
    darks: int = 4,
    level: float = 1.0,
    iso: int = 100,
) -> Plan:
    """Plan the frames of one calibration of the fiber probe.

    Parameters
    ----------
    rig : Rig
        Rig with a probe.
    target : {"phantom", "dark"}
        "phantom": dark frames; the series of exposures on a block of known optics; then per fiber
        some exposures with all other fibers covered, `MASK_INTERVAL` brackets apart. Of those only
        two useful ones are taken unless all are requested, see
        `capture.acquire.probe.fiber_signal`; "dark": the dark frames only.
    repeats : int
        Placements on the phantom, >= 1; fibers are covered at the first.
    brackets, longest_s, step_ev, level, iso
        As in `probe_plan`.
    darks : int
        Frames without light for each of a few exposure times; >= 1 of the dark.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = probe_calibration_plan(load_rig("probe"))
    >>> [step.id for step in plan.steps if step.kind != "mask"][11:13]
    ['dark-b22-r3', 'phantom-r0-a000-b00']
    >>> masks = [step for step in plan.steps if step.kind == "mask"]
    >>> len(masks), masks[0].id, masks[-1].id, masks[-1].settings["fiber"]
    (196, 'mask-f00-b0', 'mask-f27-b6', 27)
    """
    targets = get_args(ProbeTarget)
    require_argument(target in targets, "target", target, f"one of {', '.join(targets)}")
    require_repeats(repeats)
    require_argument(
        darks >= (1 if target == "dark" else 0), "darks", darks, ">= 0, of the dark >= 1"
    )
    series = _Series(
        rig, brackets=brackets, longest_s=max_exposure_s, step_ev=step_ev, level=level, iso=iso
    )
    series.darks(darks)
    if target == "phantom":
        for repeat in range(repeats):
            series.measure("phantom", PHANTOM_SITE, repeat, 0.0)
            if repeat == 0:
                series.masks()
    return series.plan()


def exposure_series_s(
    brackets: int = N_BRACKETS,
    *,
    max_exposure_s: float = MAX_EXPOSURE_S,
    step_ev: float = BRACKET_STEP_EV,
) -> tuple[float, ...]:
    """Return the exposures of a series, s, from short to long.

    Examples
    --------
    >>> [round(seconds, 2) for seconds in exposure_series_s(4)]
    [7.5, 11.91, 18.9, 30.0]
    """
    return tuple(max_exposure_s * 2.0 ** (-step_ev * (brackets - 1 - k)) for k in range(brackets))


def group_by_series(plan: Plan) -> Iterator[tuple[HeadPlacement, tuple[Step, ...]]]:
    """Return the series of a plan on skin or phantom in its order, each with its steps.

    The steps of a series show one placement of the head; each covered fiber has a series.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = probe_plan(load_rig("probe"), sites=["cheek", "chin"], brackets=3)
    >>> [(str(placement), len(steps)) for placement, steps in group_by_series(plan)]
    [('cheek at 0 degrees', 3), ('chin at 0 degrees', 3)]
    """
    for (placement, _), group in groupby(
        plan.steps, key=lambda step: (step_placement(step), step.settings.get("fiber"))
    ):
        if placement is not None:
            yield placement, tuple(group)


class _Series(StepSeries):
    """Collected steps, for the one camera of a probe."""

    def __init__(
        self, rig: Rig, *, brackets: int, longest_s: float, step_ev: float, level: float, iso: int
    ) -> None:
        require_argument(rig.probe is not None, "rig", rig.name, "one with a probe")
        self._probe: Probe = rig.probe  # type: ignore[assignment]
        probe = self._probe
        require_argument(brackets >= 2, "brackets", brackets, ">= 2")
        require_argument(step_ev > 0, "step_ev", step_ev, "stops > 0")
        readout_s = max(view.readout_s for view in rig.views)
        most_s = min(probe.max_open_s, probe.max_suction_s - probe.settle_s - readout_s)
        room = f"<= {most_s:g}, which one suction of {probe.max_suction_s:g} s has room for"
        require_argument(0 < longest_s <= most_s, "max_exposure_s", longest_s, room)
        require_argument(0 < level <= 1, "level", level, "0 < level <= 1")
        self._exposures_s = exposure_series_s(brackets, max_exposure_s=longest_s, step_ev=step_ev)
        super().__init__(rig, level=float(level), iso=iso)

    def darks(self, count: int) -> None:
        require_argument(count >= 0, "darks", count, ">= 0")
        last = len(self._exposures_s) - 1
        for bracket in dict.fromkeys(round(share * last) for share in DARK_POSITIONS):
            for repeat in range(count):
                index: Index = {"bracket": bracket, "repeat": repeat}
                exposure = {"exposure_s": self._exposures_s[bracket], "level": 0.0}
                self.add(f"dark-b{bracket:02d}-r{repeat}", "dark", index, **exposure)

    def measure(self, kind: Kind, site: str, repeat: int, angle_deg: float) -> None:
        for bracket, exposure_s in enumerate(self._exposures_s):
            index: Index = {"site": site, "repeat": repeat, "angle": int_if_whole(angle_deg)}
            held = {"exposure_s": exposure_s, "suction_mbar": self._probe.suction_mbar}
            identity = f"{site}-r{repeat}-a{_angle_text(angle_deg)}-b{bracket:02d}"
            self.add(identity, kind, {**index, "bracket": bracket}, **held)

    def masks(self) -> None:
        longest_s = max(MAX_MASK_EXPOSURE_S, self._exposures_s[0])
        exposures_s = [t for t in self._exposures_s if t <= longest_s][::-MASK_INTERVAL][::-1]
        for fiber in range(len(self._probe.fibers)):
            for bracket, exposure_s in enumerate(exposures_s):
                index: Index = {"fiber": fiber, "bracket": bracket}
                held = {"exposure_s": exposure_s, "suction_mbar": self._probe.suction_mbar}
                self.add(f"mask-f{fiber:02d}-b{bracket}", "mask", index, **held, fiber=fiber)

    def plan(self) -> Plan:
        require_argument(len(self._steps) > 0, "darks", 0, "something to capture")
        probe = self._probe
        limits = {
            "max_suction_mbar": probe.max_suction_mbar,
            "max_suction_s": probe.max_suction_s,
            "max_open_s": probe.max_open_s,
        }
        if self._rig.leds is not None:
            limits["dose_ws"] = self._rig.leds.dose_ws
        return Plan(self._rig.name, tuple(self._steps), limits)


def _angle_text(angle_deg: float) -> str:
    whole, tenths = divmod(round(10.0 * angle_deg), 10)
    return f"{whole:03d}.{tenths}" if tenths else f"{whole:03d}"
