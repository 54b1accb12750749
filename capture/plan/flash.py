"""Generate plans of the flash rig: a subject in several states, and the calibration targets."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Literal, get_args

from capture.plan.led_bands import add_led_frames
from capture.plan.steps import (
    POLARIZER_STATES,
    Index,
    Kind,
    Plan,
    Polarizer,
    StepSeries,
    Value,
    require_argument,
    require_repeats,
)
from capture.rig import Rig

Target = Literal["dark", "flat", "chart", "malus"]

# powers of the photon transfer series: dense in the shadows, up to full scale
FLAT_POWERS = (0.03125, 0.0625, 0.125, 0.1875, 0.25, 0.375, 0.5, 0.625, 0.75, 1.0)
MALUS_ANGLES_DEG = tuple(15.0 * k for k in range(13))


def flash_plan(
    rig: Rig,
    *,
    states: Sequence[str] = ("neutral",),
    repeats: int = 1,
    interleave: bool = False,
    darks: int = 4,
    power: float = 1.0,
    exposure_s: float = 0.008,
    iso: int = 100,
    leds: Sequence[str] = (),
) -> Plan:
    """Plan parallel and crossed flash images of a subject in each of several states.

    Parameters
    ----------
    rig : Rig
    states : sequence of str
        Expressions or physiological states, captured one after the other.
    repeats : int
        Image pairs per state, >= 1.
    interleave : bool
        Whether all other states come between two repeats of one, as in Jimenez et al. 2010: the
        repeats then measure how reproducible a state is, not only how well it is held.
    darks : int
        Frames with no light at the beginning, >= 0.
    power : float
        Flash power, 0 < power <= 1.
    exposure_s : float
        Exposure time, s; it includes the flash.
    iso : int
    leds : sequence of str
        Narrow-band LEDs, each with one more crossed frame per state and repeat; see
        `capture.plan.led_bands.add_led_frames`.

    Returns
    -------
    Plan
        Dark frames, then per state and repeat a parallel and a crossed image; the order of the two
        alternates, so that the analyzer turns once per pair. The repeats of a state follow each
        other, or with ``interleave`` each repeat goes through all states.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash")
    >>> plan = flash_plan(rig, states=("neutral", "anger"), darks=1)
    >>> [(s.id, s.settings["polarizer"]) for s in plan.steps]  # doctest: +NORMALIZE_WHITESPACE
    [('D000', 'parallel'), ('S000', 'parallel'), ('S001', 'crossed'), ('S002', 'crossed'),
     ('S003', 'parallel')]
    >>> round(plan.estimate_duration_s(rig), 2)
    28.79
    >>> plan = flash_plan(rig, states=("neutral", "anger"), repeats=2, darks=0, interleave=True)
    >>> [s.index["state"] for s in plan.steps[::2]]
    ['neutral', 'anger', 'neutral', 'anger']
    """
    require_repeats(repeats)
    require_argument(darks >= 0, "darks", darks, ">= 0")
    require_argument(0 < power <= 1, "power", power, "0 < power <= 1")
    series = _Series(rig, exposure_s=exposure_s, iso=iso)
    series.darks(darks)
    pair: list[Polarizer] = ["parallel", "crossed"]
    order = [(state, repeat) for state in states for repeat in range(repeats)]
    if interleave:
        order = [(state, repeat) for repeat in range(repeats) for state in states]
    for state, repeat in order:
        for polarizer in pair:
            index: Index = {"state": state, "polarizer": polarizer, "repeat": repeat}
            series.number("S", "subject", index, polarizer=polarizer, power=power)
        pair.reverse()
    return add_led_frames(series.plan(), leds)


def flash_calibration_plan(
    rig: Rig,
    target: Target,
    *,
    repeats: int = 2,
    darks: int = 2,
    exposure_s: float = 0.008,
    iso: int = 100,
) -> Plan:
    """Plan the frames of one calibration of the flash rig.

    Parameters
    ----------
    rig : Rig
    target : {"dark", "flat", "chart", "malus"}
        "dark": ``8 * repeats`` frames with the cap on; "flat": 10 flash powers on an even white
        field, ``repeats`` frames each (photon transfer pairs); "chart": ``repeats`` parallel and
        crossed images of a color chart; "malus": 13 analyzer angles from 0 to 180 degrees,
        ``repeats`` frames each.
    repeats : int
        Frames per condition, >= 1 (>= 2 for "flat": pairs).
    darks : int
        Frames with no light before all but "dark", >= 0.
    exposure_s, iso
        Exposure time, s, and sensitivity.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = flash_calibration_plan(load_rig("flash"), "malus", repeats=1, darks=0)
    >>> plan.steps[-1].index["analyzer_deg"], plan.steps[-1].kind
    (180.0, 'malus')
    """
    targets = get_args(Target)
    require_argument(target in targets, "target", target, f"one of {', '.join(targets)}")
    least = 2 if target == "flat" else 1
    require_argument(repeats >= least, "repeats", repeats, f">= {least}")
    require_argument(darks >= 0, "darks", darks, ">= 0")
    series = _Series(rig, exposure_s=exposure_s, iso=iso)
    series.darks(8 * repeats if target == "dark" else darks)
    conditions: Iterable[tuple[dict[str, str | float], dict[str, Value]]]
    if target == "dark":
        conditions = ()
    elif target == "flat":
        conditions = [({"power": p}, {"polarizer": "parallel", "power": p}) for p in FLAT_POWERS]
    elif target == "chart":
        conditions = [({"polarizer": p}, {"polarizer": p, "power": 1.0}) for p in POLARIZER_STATES]
    else:
        conditions = [
            ({"analyzer_deg": a}, {"polarizer": "parallel", "analyzer_deg": a, "power": 1.0})
            for a in MALUS_ANGLES_DEG
        ]
    for index, settings in conditions:
        for repeat in range(repeats):
            series.number(target[0].upper(), target, {**index, "repeat": repeat}, **settings)
    return series.plan()


class _Series(StepSeries):
    """Numbered steps, for all views of one rig at one exposure."""

    def __init__(self, rig: Rig, *, exposure_s: float, iso: int) -> None:
        super().__init__(rig, exposure_s=exposure_s, iso=iso)
        self._counts: Counter[str] = Counter()

    def number(self, letter: str, kind: Kind, index: Index, **settings: Value) -> None:
        """Add a step that is named by a letter and its number among those of that letter."""
        self.add(f"{letter}{self._counts[letter]:03d}", kind, index, **settings)
        self._counts[letter] += 1

    def darks(self, count: int) -> None:
        for repeat in range(count):
            self.number("D", "dark", {"repeat": repeat}, polarizer="parallel", power=0.0)

    def plan(self) -> Plan:
        rig = self._rig
        return self.plan_within(max_pops_per_min=rig.max_pops_per_min, recycle_s=rig.recycle_s)
