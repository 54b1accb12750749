"""Which stages fit into a budget at full size, once all were measured at their small one.

Without names `skinrig bench` measures every stage: first at its small size, which takes
1 to 18 seconds, so that none is missing; then, the quickest first, at full size as long as the
budget lasts. Limits are promises about full sizes and are judged at no other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

SPARE: Final = 1.25
"""A stage begins if so many times what it should take is left."""
RESERVE_S: Final = 20.0
"""What tables and plots take at the end."""
SETTLED_S: Final = 10.0
"""Seconds of full sizes after which the pace of this machine counts as known."""
UNKNOWN_S: Final = 120.0
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
        return self.took_s / self.told_s if self.told_s > SETTLED_S else 1.0

    def fits(self, told_s: float, left_s: float) -> bool:
        """Return whether a stage will end within ``left_s``, with some to spare.

        Examples
        --------
        >>> Pace(told_s=20.0, took_s=40.0).fits(10.0, left_s=24.0)
        False
        >>> Pace(told_s=20.0, took_s=40.0).fits(10.0, left_s=26.0)
        True
        """
        return SPARE * self.factor * told_s <= left_s


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
        ((name, seconds.get(name, UNKNOWN_S)) for name in names), key=lambda pair: pair[1]
    )


SMALL_S: Final[dict[str, float]] = {
    "brdf": 2, "brdf-space": 2, "dome-lights": 2, "perfusion-curves": 2, "photon-transport": 2,
    "subsurface-fit": 2, "texture-fill": 2, "wrinkles": 2, "chromophores": 3, "efficiency": 3,
    "expression-alignment": 3, "fibre-readings": 3, "microstructure": 3, "render-flash": 3,
    "texture-matching": 3, "reflectance": 4, "shared-melanin": 4, "head-motion": 6,
    "normal-integration": 7, "dome-geometry": 8, "render-model": 8, "sphere-lights": 8,
    "render-dome": 9, "editing": 10, "traits": 10, "gradient-normals": 13, "probe-session": 14,
    "render-gradient": 18,
}  # fmt: skip
"""Processor seconds at small size of the stages that take more than about one."""

FULL_S: Final[dict[str, float]] = {
    "light-order": 1, "wrinkle-weights": 3, "anisotropy": 4, "translucency": 6,
    "normal-histogram": 7, "fibre-readings": 8, "diffuse-albedo": 8, "subsurface-batch": 10,
    "efficiency": 12, "hdr": 15, "misalignment": 22, "subsurface-fit": 23, "perfusion-curves": 29,
    "layered-reflectance": 39, "render-flash": 44,
    "lumitexels": 33, "wrinkle-storage": 3, "texture-fill": 39, "wrinkle-sum": 16,
    "color-table": 30, "chromophores": 30, "facial-color": 40, "microstructure-passes": 40,
    "wrinkles": 40, "head-motion": 40, "probe-session": 50, "shared-melanin": 60,
    "reflectance": 60, "render-dome": 60, "brdf": 60, "brdf-space": 60, "dome-lights": 60,
    "render-gradient": 60, "texture-matching": 60, "gradient-normals": 60, "normals": 90,
    "expression-alignment": 90, "dome-geometry": 90, "normal-integration": 90,
    "subsurface-gather": 90, "editing": 90, "traits": 90, "photon-transport": 120,
    "sphere-lights": 120, "render-model": 120, "skin-stretch": 150, "microstructure": 150,
    "displacement-synthesis": 200, "kernel-fit": 300, "intervals": 900,
}  # fmt: skip
"""At most about how many seconds each takes at full size on two cores that do nothing else: of the
first nineteen their processor seconds, of the others a careful guess. A guess that is too low makes
a run outlast its budget, one that is too high leaves a stage at its small size."""
