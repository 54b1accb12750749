"""Draw an actual face scanner: nominal geometry with manufacturing tolerances."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Scanner, View
from rigsim.arrays import Float64Array
from rigsim.as_built.dome import DomeTolerances, draw_distortion, perturb_view

SCANNER_TOLERANCES: Final = DomeTolerances(distortion=0.05)
"""Tolerances of the scanner's cameras and projectors: those of the dome, with distortion."""
GAMMA_DEVIATION: Final = 0.03
"""Standard deviation of a projector's exponent about 1 after its own linearization; chosen."""


@dataclass(frozen=True, slots=True, eq=False)
class ActualScanner:
    """Ground truth of a scanner; the values of its rig file are ``nominal``."""

    nominal: Scanner
    views: Mapping[str, View]
    """The actual cameras by name."""
    projectors: Mapping[str, View]
    """The actual projectors by name, as inverse cameras."""
    distortion: Mapping[str, Float64Array]
    """k1, k2, p1, p2, k3 of each camera and projector, on coordinates over depth."""
    gamma: Mapping[str, float]
    """Exponent of emitted light over displayed level, by projector."""


def build_scanner(
    scanner: Scanner, *, seed: int, tolerances: DomeTolerances = SCANNER_TOLERANCES
) -> ActualScanner:
    """Draw an actual scanner; with the same seed each part is the same at any image size.

    Parameters
    ----------
    scanner
        As drawn.
    seed
        Seed of the manufacturing errors.
    tolerances
        Standard deviations.
    """
    actual: dict[str, View] = {}
    distortion: dict[str, Float64Array] = {}
    gamma: dict[str, float] = {}
    pinholes = [projector.pinhole for projector in scanner.projectors]
    for view in (*scanner.views, *pinholes):
        rng = np.random.default_rng([seed, *view.serial.encode()])
        actual[view.name] = perturb_view(view, tolerances, rng)
        distortion[view.name] = draw_distortion(tolerances, rng)
        gamma[view.name] = float(np.exp(GAMMA_DEVIATION * rng.standard_normal()))
    names = {pinhole.name for pinhole in pinholes}
    return ActualScanner(
        scanner,
        {name: view for name, view in actual.items() if name not in names},
        {name: view for name, view in actual.items() if name in names},
        distortion,
        {name: gamma[name] for name in names},
    )
