"""Judge emitted light against the rig's limits, from the intervals of light alone.

It shares no code with the controllers and the host that keep these limits.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from capture.rig import LedLimits, Rig

POP_WINDOW_S = 60.0
FUSION_S = 1.0 / 65.0
"""Darkness, s, that an eye does not notice."""
MIN_CHANGE = 0.1
"""Least change of light, over the brightest, that is a flash (WCAG 2.2)."""
HALF_FLASH = 0.5
"""Change, flashes, that may lie in another second for the controllers: light that falls slowly has
its change where the fall begins, here where it ends."""
EYE_PLANE_MM = 80.0
"""Distance of the eyes from the head's center, along +z, mm: light from behind does not reach them.
"""
RELATIVE_ROUNDING = 1e-6
TIME_ROUNDING_S = 2e-6


def find_limit_violations(
    rig: Rig,
    *,
    pops: Sequence[Any],
    switched: Sequence[Any],
    earlier_pops: Sequence[Any] = (),
    eyes: str,
) -> Iterator[str]:
    """Yield a sentence per exceeded limit of the light that one subject received.

    Parameters
    ----------
    rig
        The rig with its limits.
    pops, switched
        Flashes, and intervals of other light, in order of time.
    earlier_pops
        Flashes before these, which count for the pops per minute.
    eyes
        "open": the limit of flashes per second applies.
    """
    times_s = np.array([pop.t_s for pop in (*earlier_pops, *pops)])
    if times_s.size:
        ends = np.searchsorted(times_s, times_s + POP_WINDOW_S - TIME_ROUNDING_S)
        most = int((ends - np.arange(times_s.size)).max())
        if most > rig.max_pops_per_min:
            yield f"flicker: {most} flashes in a minute, limit {rig.max_pops_per_min:g}"
    limits = rig.leds or LedLimits()
    by_led: dict[int, list[tuple[float, float, float]]] = defaultdict(list)
    for light in switched:
        # all LEDs of a pattern are bounded by its level; a probe has one LED
        by_led[getattr(light, "led", 0)].append((light.t_on_s, light.t_off_s, light.level))
    for led, intervals in by_led.items():
        on_s, off_s, level = np.array(sorted(intervals)).T
        power_w = rig.lights[led].power_w or 0.0
        dose_ws = float(power_w * (level * (off_s - on_s)).sum())
        if dose_ws > limits.dose_ws * (1.0 + RELATIVE_ROUNDING):
            yield f"dose: LED {led} emitted {dose_ws:.3f} Ws, limit {limits.dose_ws:g}"
        longest_s = float((off_s - on_s).max())
        if longest_s > limits.max_on_s + limits.overlap_s + TIME_ROUNDING_S:
            yield f"dose: LED {led} was lit for {longest_s:.4f} s, limit {limits.max_on_s:g}"
        duty = _find_largest_duty(on_s, off_s, level, limits.duty_window_s)
        if duty > limits.max_duty + TIME_ROUNDING_S * on_s.size:
            yield f"dose: LED {led} had a duty of {duty:.4f}, limit {limits.max_duty:g}"
    seen = [
        (light.t_on_s, light.t_off_s, light.level * weight)
        for light in switched
        if (weight := _weigh_at_eyes(rig, light)) > 0.0
    ]
    if eyes == "open" and seen:
        flashes = _count_flashes_per_s(sorted(seen))
        if flashes >= limits.max_flashes_per_s + HALF_FLASH:
            yield (
                f"flicker: {flashes:g} flashes per second, expected below "
                f"{limits.max_flashes_per_s:g}"
            )


def _find_largest_duty(on_s: Any, off_s: Any, level: Any, window_s: float) -> float:
    """Return the largest mean level over a window; it ends with light or begins with it."""
    edges_s = np.unique(np.concatenate([on_s, off_s]))
    emitted = np.concatenate([[0.0], np.cumsum(level * (off_s - on_s))])

    def light_until(time_s: Any) -> Any:
        last = np.searchsorted(on_s, time_s, side="right")
        over_s = np.clip(off_s[np.maximum(last - 1, 0)] - time_s, 0.0, None)
        return emitted[last] - np.where(last > 0, over_s * level[np.maximum(last - 1, 0)], 0.0)

    ends_s = np.concatenate([edges_s, edges_s + window_s])
    return float(((light_until(ends_s) - light_until(ends_s - window_s)) / window_s).max())


def _weigh_at_eyes(rig: Rig, light: Any) -> float:
    """Return the relative irradiance on the eyes' plane; 0 for a light behind it."""
    if not hasattr(light, "led"):
        return 1.0
    led = rig.lights[light.led]
    away = np.subtract(led.position_mm, (0.0, 0.0, EYE_PLANE_MM))
    return (led.power_w or 0.0) * max(float(away[2]), 0.0) / float(np.linalg.norm(away)) ** 3


def _count_flashes_per_s(intervals: Sequence[tuple[float, float, float]]) -> float:
    """Return the flashes of the worst second: half the changes between light and darkness.

    Darkness shorter than `FUSION_S` is light, and light below `MIN_CHANGE` of the brightest is
    darkness. Controllers locate a change within the fusion time, so that the second is shorter by
    as much.
    """
    on_s, off_s, level = np.array(intervals).T
    edges_s = np.unique(np.concatenate([on_s, off_s]))
    steps = np.zeros(edges_s.size)
    np.add.at(steps, np.searchsorted(edges_s, on_s), level)
    np.add.at(steps, np.searchsorted(edges_s, off_s), -level)
    light = np.cumsum(steps)
    changes_s: list[float] = []
    dark_since_s = -np.inf
    for k in np.flatnonzero(light >= MIN_CHANGE * light.max()).tolist():
        if edges_s[k] > dark_since_s + FUSION_S:
            changes_s += [dark_since_s, edges_s[k]]
        dark_since_s = edges_s[k + 1]
    times_s = np.array([*changes_s[1:], dark_since_s])
    ends = np.searchsorted(times_s, times_s + 1.0 - FUSION_S)
    return float((ends - np.arange(times_s.size)).max()) / 2.0
