"""Generate plans of the light dome: one light at a time at several exposures, and its targets."""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from capture.plan.eye_light import eye_irradiance
from capture.plan.light_order import best_order
from capture.plan.rows import LedRow
from capture.plan.steps import Index, Kind, Plan, Step, StepSeries, Value, require_argument
from capture.rig import SCANNER_BOX, LedLimits, Rig
from capture.scanner import STRIPE_AXES

DomeTarget = Literal["charuco", "mirror", "white", "dark"]

DOME_EXPOSURES_S = (0.06, 0.015)
"""Two stops apart; the longer one and its readout fit into a twelfth of a second."""
FRAMES_PER_S = 12.0
TRACKING_INTERVAL_LIGHTS = 25
"""Lights between two tracking frames."""
N_TRACKING_LIGHTS = 6
MIN_TRACKING_LIGHT = 0.25
"""Smallest light of a tracking frame at the eyes, of the brightest single light."""
MIN_PLATE_COSINE = 0.15
"""Cosine of incidence below which a light on the plate is not used."""
N_OUTLINE_LIGHTS = 24
N_MIRROR_LIGHTS = 8
"""Numbers of lights that are on together for a sphere's outline, and in a sphere."""
MIRROR_LEVEL = 0.002
"""Level of these lights: a sphere mirrors an LED's radiance, thousands of times a lit white."""
LEVEL_STEPS = 1000
"""Number of steps of an LED's level."""


def dome_plan(
    rig: Rig,
    *,
    exposures_s: Sequence[float] = DOME_EXPOSURES_S,
    frames_per_s: float = FRAMES_PER_S,
    tracking_interval: int = TRACKING_INTERVAL_LIGHTS,
    darks: int = 2,
    level: float = 1.0,
    iso: int = 100,
    order: Sequence[int] | None = None,
) -> Plan:
    """Plan a capture of a subject: one light at a time, at every exposure.

    Parameters
    ----------
    rig : Rig
        A dome.
    exposures_s : sequence of float
        Exposure of each pass over all lights, s.
    frames_per_s : float
        Lights per second, > 0.
    tracking_interval : int
        Lights between two frames lit by several lights at once, from which motion is estimated; 0
        for none. A pass with tracking also begins and ends with one.
    darks : int
        Frames without light at each exposure, >= 0.
    level : float
        Level of each light, 0 < level <= 1.
    iso : int
    order : sequence of int, optional
        Numbers of all lights; by default the order with the least flicker.

    Returns
    -------
    Plan
        Per exposure: dark frames, then all lights in one order, so that a light's frames of
        different passes are equally far apart in time.

    Raises
    ------
    PlanError
        When the limits of the rig's LEDs are exceeded, or an exposure does not fit.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> dome = load_rig("dome")
    >>> plan = dome_plan(dome)
    >>> sum(step.kind == "olat" for step in plan.steps), round(plan.estimate_duration_s(dome), 1)
    (300, 26.5)
    """
    require_argument(tracking_interval >= 0, "tracking_interval", tracking_interval, ">= 0")
    require_argument(darks >= 0, "darks", darks, ">= 0")
    series = _Series(rig, frames_per_s=frames_per_s, iso=iso)
    shown = best_order(rig, dwell_s=series.dwell_s) if order is None else [int(k) for k in order]
    require_argument(
        sorted(shown) == list(range(len(rig.lights))), "order", shown, "every light once"
    )
    for number, exposure_s in enumerate(exposures_s):
        series.darks(darks, exposure_s, number)
        for place, light in enumerate(shown):
            if tracking_interval and place % tracking_interval == 0:
                series.tracking(number, place, exposure_s, shown[max(place - 1, 0)], level)
            name = rig.lights[light].name
            index: Index = {"light": name, "exposure": number, "pass": number}
            series.expose(f"{name}-{number}", "olat", index, exposure_s, light=name, level=level)
        if tracking_interval:
            series.tracking(number, len(shown), exposure_s, shown[-1], level)
    return series.plan()


def dome_calibration_plan(
    rig: Rig,
    target: DomeTarget,
    *,
    exposures_s: Sequence[float] = DOME_EXPOSURES_S,
    poses: int = 14,
    spheres: int = 4,
    plates: int = 7,
    plate_normals: Sequence[Sequence[float]] | None = None,
    darks: int = 2,
    level: float = 1.0,
    iso: int = 100,
) -> Plan:
    """Plan the frames of one calibration of the dome.

    Parameters
    ----------
    rig : Rig
        A dome.
    target : {"charuco", "mirror", "white", "dark"}
        "charuco": a board in ``poses`` poses, each lit by several lights at the first exposure;
        "mirror": a mirror sphere at ``spheres`` positions, each once in front of the lit dome, for
        its outline, and then lit by groups of lights, faintly, at the last exposure, because it
        mirrors the lights themselves; "white": a white plate in ``plates`` poses (no pose faces all
        lights), each once lit by several lights, for its markers, and then by every light at the
        first exposure; "dark": ``8 * darks`` frames with the caps on, at every exposure.
    exposures_s : sequence of float
        As for `dome_plan`.
    poses, spheres, plates : int
        Poses of the board, positions of the sphere and poses of the plate, >= 1; a person moves
        them in between.
    plate_normals : sequence of (3,), optional
        Approximate normal of the plate's front in each pose: lights behind it are omitted.
    darks : int
        Frames with no light at the exposure in use, >= 0; none for the mirror.
    level, iso
        As for `dome_plan`.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = dome_calibration_plan(load_rig("dome"), "mirror", spheres=2)
    >>> plan.steps[-1].kind, dict(plan.steps[-1].index)["sphere"], len(plan.steps)
    ('mirror', 1, 40)
    """
    targets = get_args(DomeTarget)
    require_argument(target in targets, "target", target, f"one of {', '.join(targets)}")
    require_argument(darks >= 0, "darks", darks, ">= 0")
    for name, count in (("poses", poses), ("spheres", spheres), ("plates", plates)):
        require_argument(count >= 1, name, count, ">= 1")
    series = _Series(rig, frames_per_s=FRAMES_PER_S, iso=iso)
    if target == "dark":
        for number, exposure_s in enumerate(exposures_s):
            series.darks(8 * darks, exposure_s, number)
        return series.plan()
    if target == "charuco":
        series.darks(darks, exposures_s[0], 0)
        for pose in range(poses):
            series.expose_tracking_lights(
                f"P{pose:02d}", "charuco", {"pose": pose}, exposures_s[0], level
            )
        return series.plan()
    order = best_order(rig, dwell_s=series.dwell_s)
    if target == "mirror":
        series.mirrors(spheres, order, exposures_s)
        return series.plan()
    series.darks(darks, exposures_s[0], 0)
    for pose in range(plates):
        index: Index = {"pose": pose, "light": "several"}
        series.expose_tracking_lights(f"W{pose}-markers", "white", index, exposures_s[0], level)
        normal = None if plate_normals is None else plate_normals[pose]
        for light in order:
            name = rig.lights[light].name
            if normal is None or _cosine(rig.lights[light].position_mm, normal) > MIN_PLATE_COSINE:
                index, at = {"pose": pose, "light": name}, f"W{pose}-{name}"
                series.expose(at, "white", index, exposures_s[0], light=name, level=level)
    return series.plan()


def add_scan(plan: Plan, rig: Rig, *, iso: int = 100) -> Plan:
    """Return a plan with the stripes of the rig's scanner, where its controller is used.

    A subject is scanned first, along columns; a board in each pose after its own step, along both
    axes, so that the projectors can be calibrated. Other targets are not scanned.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> dome = load_rig("dome")
    >>> plan = dome_plan(dome)
    >>> len(add_scan(plan, dome.with_scanner()).steps) - len(plan.steps), len(plan.steps)
    (24, 318)
    """
    if rig.scanner is None or SCANNER_BOX not in rig.boxes:
        return plan
    subject = any(step.kind == "olat" for step in plan.steps)
    steps: list[Step] = _stripes(rig, STRIPE_AXES[:1], {}, iso) if subject else []
    for step in plan.steps:
        steps.append(step)
        if step.kind == "charuco":
            steps += _stripes(rig, STRIPE_AXES, step.index, iso)
    return Plan(plan.rig, tuple(steps), plan.limits)


def _stripes(rig: Rig, axes: Sequence[str], index: Index, iso: int) -> list[Step]:
    """Return the steps of all patterns of a scanner, projector by projector."""
    if (scanner := rig.scanner) is None:
        return []
    prefix = "".join(f"P{value:02d}-" for value in index.values() if isinstance(value, int))
    steps = []
    for projector in scanner.projectors:
        for axis in axes:
            shown = {"projector": projector.name, "axis": axis}
            for number in range(scanner.pattern_count(projector, axis)):
                name = f"{prefix}{projector.name}-{axis[:3]}{number:02d}"
                taken = {"stripes": number, "exposure_s": scanner.exposure_s, "iso": iso}
                place = {**index, **shown, "pattern": number}
                steps.append(Step(name, "stripes", place, {**shown, **taken}, projector.cameras))
    return steps


def _cosine(a: Sequence[float], b: Sequence[float]) -> float:
    return float(np.dot(a, b) / (np.linalg.norm(a) * np.linalg.norm(b)))


def choose_tracking_lights(rig: Rig) -> list[int]:
    """Return at most 6 lights distributed over the half of the dome in front of the subject.

    Farthest-point selection that begins with the most frontal light.
    """
    place = np.array([light.position_mm for light in rig.lights], np.float64)
    place /= np.linalg.norm(place, axis=1)[:, None]
    front = [k for k in range(len(place)) if place[k, 2] > 0.0] or list(range(len(place)))
    chosen = [max(front, key=lambda k: place[k, 2])]
    while len(chosen) < min(N_TRACKING_LIGHTS, len(front)):
        nearest = (place[front] @ place[chosen].T).max(axis=1)
        chosen.append(front[int(np.argmin(nearest))])
    return sorted(chosen)


class _Series(StepSeries):
    """Numbered steps, for all views of one dome."""

    def __init__(self, rig: Rig, *, frames_per_s: float, iso: int) -> None:
        require_argument(rig.leds is not None, "rig", rig.name, "one with LEDs and their limits")
        require_argument(frames_per_s > 0, "frames_per_s", frames_per_s, "> 0")
        self._limits = rig.leds or LedLimits()
        # the controller counts microseconds
        self.dwell_s = round(1e6 / frames_per_s) / 1e6
        most_s = self._limits.max_on_s
        slowest = f"at least {1.0 / most_s:g} 1/s"
        require_argument(self.dwell_s <= most_s, "frames_per_s", frames_per_s, slowest)
        super().__init__(rig, iso=iso, dwell_s=self.dwell_s)
        self._tracking = choose_tracking_lights(rig)
        self._eye = eye_irradiance(rig)

    def expose(
        self, identity: str, kind: Kind, index: Index, exposure_s: float, **settings: Value
    ) -> None:
        level = float(settings.get("level", 0.0))
        require_argument(0 <= level <= 1, "level", level, "0 to 1")
        limits = self._limits
        # the controller would refuse an LED that is on longer than the duty allows
        on_s = limits.max_duty * limits.duty_window_s
        require_argument(
            level * self.dwell_s <= on_s, "level x dwell", level * self.dwell_s, f"<= {on_s}"
        )
        readout_s = max(view.readout_s for view in self._rig.views)
        room_s = self.dwell_s - limits.settle_s - limits.overlap_s
        fits = exposure_s <= room_s and exposure_s + readout_s <= self.dwell_s
        expected = f"to fit with read-out {readout_s:g} s into {self.dwell_s:g} s a light"
        require_argument(fits, "exposure_s", exposure_s, expected)
        self.add(identity, kind, index, exposure_s=float(exposure_s), **settings)

    def darks(self, count: int, exposure_s: float, number: int) -> None:
        for repeat in range(count):
            index: Index = {"repeat": repeat, "exposure": number}
            identity = f"D{number}-{repeat:02d}"
            self.expose(identity, "dark", index, exposure_s, light="none", level=0.0)

    def tracking(
        self, number: int, after: int, exposure_s: float, before: int, level: float
    ) -> None:
        """Add a tracking frame as bright to the eyes as the light before it, if possible.

        A frame of equal brightness is not a flash among its neighbors.
        """
        brightest = level * float(self._eye.max())
        wanted = max(level * float(self._eye[before]), MIN_TRACKING_LIGHT * brightest)
        each = wanted / max(float(self._eye[self._tracking].sum()), 1e-12)
        index: Index = {"after": after, "exposure": number, "pass": number}
        self.expose_tracking_lights(f"T{number}-{after:03d}", "tracking", index, exposure_s, each)

    def expose_tracking_lights(
        self, identity: str, kind: Kind, index: Index, exposure_s: float, level: float
    ) -> None:
        """Add a step lit by the tracking lights together; ``level`` is limited as for one light."""
        limits = self._limits
        most = min(1.0, limits.max_duty * limits.duty_window_s / self.dwell_s)
        if kind != "tracking":  # together as bright as one light alone
            level = level / len(self._tracking)
        level = min(most, max(1.0, np.ceil(LEVEL_STEPS * level)) / LEVEL_STEPS)
        names = "+".join(self._rig.lights[k].name for k in self._tracking)
        self.expose(identity, kind, index, exposure_s, leds=names, level=float(level))

    def mirrors(self, count: int, order: Sequence[int], exposures_s: Sequence[float]) -> None:
        """Add the steps of mirror spheres: outlines by the lit dome, then lights by groups.

        The lights of a group are far apart in the order, and so on the dome and in the sphere.
        """
        some = max(1, math.ceil(len(order) / min(N_OUTLINE_LIGHTS, self._limits.max_at_once)))
        groups = math.ceil(len(order) / min(N_MIRROR_LIGHTS, self._limits.max_at_once))
        for sphere in range(count):
            index: Index = {"sphere": sphere, "light": "outline"}
            self._lit(f"M{sphere}-outline", index, order[::some], exposures_s[0], 1.0)
            for group in range(groups):
                index = {"sphere": sphere, "light": f"group {group}"}
                lights, exposure_s = order[group::groups], exposures_s[-1]
                self._lit(f"M{sphere}-{group:02d}", index, lights, exposure_s, MIRROR_LEVEL)

    def _lit(
        self, identity: str, index: Index, lights: Sequence[int], exposure_s: float, level: float
    ) -> None:
        names = "+".join(self._rig.lights[k].name for k in lights)
        self.expose(identity, "mirror", index, exposure_s, leds=names, level=level)

    def plan(self) -> Plan:
        limits = self._limits
        return self.plan_within(
            max_duty=limits.max_duty,
            max_on_s=limits.max_on_s,
            max_flashes_per_s=limits.max_flashes_per_s,
            max_flicker_rms=limits.max_flicker_rms,
            dose_ws=limits.dose_ws,
        )


def to_box_rows(rows: Sequence[LedRow]) -> list[tuple[tuple[int, ...], int, int]]:
    """Return rows in the controller's units: LEDs, level in thousandths, time in us.

    Examples
    --------
    >>> to_box_rows([LedRow((3,), 1.0, 0.083333), LedRow((), 0.0, 0.05)])
    [((3,), 1000, 83333), ((), 0, 50000)]
    """
    return [(row.leds, round(LEVEL_STEPS * row.level), round(1e6 * row.dwell_s)) for row in rows]
