"""Which stages fit into a budget at full size, once all were measured at their small one.

Without names `skinrig bench` measures every stage: first at its small size, which takes about a
second each, so that none is missing; then, the quickest first, at full size as long as the
budget lasts. Limits are promises about full sizes and are judged at no other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

SPARE: Final = 1.25
"""A stage begins if so many times what it should take is left."""
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


FULL_S: Final[dict[str, float]] = {
    "light-order": 2, "diffuse-albedo": 4, "wrinkle-weights": 4, "hdr": 6, "misalignment": 8,
    "perfusion-curves": 8, "render-flash": 8, "fibre-readings": 8, "anisotropy": 8,
    "normal-histogram": 10, "translucency": 12, "subsurface-fit": 12, "subsurface-batch": 12,
    "layered-reflectance": 12, "efficiency": 15, "lumitexels": 15, "wrinkle-storage": 15,
    "texture-fill": 15, "wrinkle-sum": 15, "color-table": 20, "chromophores": 20,
    "facial-color": 20, "microstructure-passes": 20, "wrinkles": 25, "shared-melanin": 25,
    "head-motion": 25, "probe-session": 25, "reflectance": 30, "render-dome": 30, "brdf": 30,
    "brdf-space": 40, "dome-lights": 40, "render-gradient": 40, "texture-matching": 40,
    "gradient-normals": 40, "normals": 45, "expression-alignment": 60, "dome-geometry": 60,
    "skin-stretch": 60, "sphere-lights": 60, "normal-integration": 60, "subsurface-gather": 60,
    "render-model": 60, "editing": 60, "photon-transport": 90, "microstructure": 90,
    "displacement-synthesis": 120, "kernel-fit": 250,
}  # fmt: skip
"""About how many seconds each takes at full size on two cores that do nothing else."""
