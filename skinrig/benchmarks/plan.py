"""Which stages fit into a budget at full size, once all were measured at their small one.

Without names `skinrig bench` measures every stage: first at its small size, which takes
1 to 18 seconds, so that none is missing; then, the quickest first, at full size as long as the
budget lasts. Limits are promises about full sizes and are judged at no other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

TIME_SAFETY_FACTOR: Final = 1.25
"""A stage begins if so many times what it should take is left."""
REPORT_RESERVE_S: Final = 20.0
"""What tables and plots take at the end."""
MIN_PACE_SAMPLE_S: Final = 10.0
"""Seconds of full sizes after which the pace of this machine counts as known."""
DEFAULT_STAGE_S: Final = 120.0
"""Seconds of a stage that :data:`FULL_S` lacks."""


@dataclass(slots=True)
class Pace:
    """How much longer stages take on this machine than :data:`FULL_S` says."""

    told_s: float = 0.0
    took_s: float = 0.0

    def add(self, told_s: float, took_s: float) -> None:
        """Count a stage that was measured at full size."""
        self.told_s += told_s
        self.took_s += took_s

    @property
    def factor(self) -> float:
        """Seconds taken over seconds told; 1 while too little was measured."""
        return self.took_s / self.told_s if self.told_s > MIN_PACE_SAMPLE_S else 1.0

    def fits(self, told_s: float, left_s: float) -> bool:
        """Return whether a stage will end within ``left_s``, with some to spare.

        Examples
        --------
        >>> Pace(told_s=20.0, took_s=40.0).fits(10.0, left_s=24.0)
        False
        >>> Pace(told_s=20.0, took_s=40.0).fits(10.0, left_s=26.0)
        True
        """
        return TIME_SAFETY_FACTOR * self.factor * told_s <= left_s


def in_order(names: Iterable[str]) -> list[str]:
    """Return stages in the order of their small sizes, those that take about a second first.

    Then a budget that is too small for all leaves the fewest out.

    Examples
    --------
    >>> in_order(["traits", "hdr", "normals"])
    ['hdr', 'normals', 'traits']
    """
    return sorted(names, key=lambda name: SMALL_S.get(name, 1.0))


def quickest_first(names: Iterable[str], seconds: Mapping[str, float]) -> list[tuple[str, float]]:
    """Return stages with what each should take at full size, the quickest first.

    Examples
    --------
    >>> quickest_first(["a", "b", "c"], {"a": 2.0, "b": 1.0})
    [('b', 1.0), ('a', 2.0), ('c', 120.0)]
    """
    return sorted(
        ((name, seconds.get(name, DEFAULT_STAGE_S)) for name in names), key=lambda pair: pair[1]
    )


SMALL_S: Final[dict[str, float]] = {
    "brdf": 2,
    "brdf-space": 2,
    "dome-lights": 2,
    "perfusion-curves": 2,
    "photon-transport": 2,
    "subsurface-fit": 2,
    "texture-fill": 2,
    "wrinkles": 2,
    "chromophores": 3,
    "efficiency": 3,
    "expression-alignment": 3,
    "fibre-readings": 3,
    "microstructure": 3,
    "render-flash": 3,
    "texture-matching": 3,
    "reflectance": 4,
    "shared-melanin": 4,
    "head-motion": 6,
    "normal-integration": 7,
    "dome-geometry": 8,
    "render-model": 8,
    "sphere-lights": 8,
    "render-dome": 9,
    "omissions": 10,
    "editing": 10,
    "traits": 10,
    "intervals": 11,
    "gradient-normals": 13,
    "probe-session": 14,
    "render-gradient": 18,
}
"""Processor seconds at small size of the stages that take more than about one."""

MEASURED_S: Final[dict[str, float]] = {
    "light-order": 1,
    "wrinkle-weights": 3,
    "wrinkle-storage": 3,
    "anisotropy": 5,
    "translucency": 6,
    "fibre-readings": 8,
    "normal-histogram": 9,
    "subsurface-batch": 10,
    "diffuse-albedo": 12,
    "efficiency": 12,
    "microstructure-passes": 13,
    "hdr": 15,
    "brdf": 17,
    "wrinkles": 18,
    "wrinkle-sum": 19,
    "dome-lights": 21,
    "misalignment": 22,
    "dome-geometry": 26,
    "color-table": 26,
    "shared-melanin": 28,
    "subsurface-fit": 30,
    "perfusion-curves": 31,
    "skin-stretch": 32,
    "render-gradient": 34,
    "head-motion": 34,
    "texture-fill": 35,
    "lumitexels": 35,
    "normals": 37,
    "facial-color": 38,
    "chromophores": 39,
    "layered-reflectance": 39,
    "expression-alignment": 39,
    "brdf-space": 40,
    "render-flash": 44,
    "reflectance": 46,
    "gradient-normals": 50,
    "texture-matching": 53,
    "probe-session": 41,
    "editing": 42,
    "render-model": 41,
    "subsurface-gather": 64,
    "normal-integration": 65,
    "render-dome": 70,
    "sphere-lights": 85,
    "traits": 90,
    "microstructure": 100,
    "photon-transport": 103,
}
"""About how many seconds each takes at full size on two cores that do nothing else: of a run alone,
the processor seconds of the main thread and half of those of all others, which share two cores.
What errors by melanin band add to that is estimated from small sizes."""

GUESSED_S: Final[dict[str, float]] = {
    "displacement-synthesis": 200,
    "kernel-fit": 300,
    "omissions": 300,
    "intervals": 600,
}
"""The same, not measured: careful guesses. One that is too low makes a run outlast its budget, one
that is too high leaves a stage at its small size."""

FULL_S: Final = {**MEASURED_S, **GUESSED_S}
