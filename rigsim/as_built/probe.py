"""Draw an actual fiber probe: gains, spots in the image, crosstalk and stray light."""

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Rig
from rigsim.arrays import Float64Array

SPOT_RADIUS_PX: Final = 12.0
"""Nominal radius of a fiber's end in the camera's image."""

FIBER_END_UNEVENNESS: Final = 0.05
"""Standard deviation of the tilt and of the curvature of the light over a fiber's end, relative:
its modes are not filled alike."""


class ProbeBuildError(ValueError):
    """Error for invalid values of a probe."""


@dataclass(frozen=True, slots=True)
class ProbeTolerances:
    """Manufacturing tolerances; 0 gives the nominal probe. Values are this project's choice."""

    gain: float = 0.05
    """Relative standard deviation of the fibers' transmissions; errors are at most twice as
    large."""
    position_px: float = 0.6
    """Standard deviation of a spot's position, pixels, per axis."""
    shift_px: float = 1.0
    """Standard deviation of the row's common shift, pixels, per axis."""
    rotation_deg: float = 0.2
    """Standard deviation of the row's rotation about the image's center, degrees."""
    radius: float = 0.02
    """Relative standard deviation of the spots' radii."""
    crosstalk: float = 1e-3
    """Median fraction of a fiber's light that leaks into each neighbor; a tenth into the next."""
    edge_px: float = 1.2
    """Softness of the spots' edges, the lens's included, pixels, > 0."""
    wings: float = 5e-3
    """Fraction of the light in the wide wings of the lens's point spread."""
    veil: float = 3e-5
    """Fraction of all light in the image that a spot's area gets as veiling glare."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (0.0 <= value < math.inf and (value > 0.0 or field.name != "edge_px")):
                raise ProbeBuildError(f"{field.name}: got {value}, expected a finite number >= 0")


@dataclass(frozen=True, slots=True, eq=False)
class ActualProbe:
    """Ground truth of the fibers, in the order of the rig."""

    spot_px: Float64Array
    """Middles of the spots, pixels, x right and y down from the first pixel's middle, (F, 2)."""
    radius_px: Float64Array
    """Radii of the spots at half height, pixels, > 0, shape (F,)."""
    gain: Float64Array
    """Transmission relative to nominal, > 0, shape (F,)."""
    crosstalk: Float64Array
    """Share of fiber j's light that comes out of fiber i, shape (F, F) at [i, j]; columns sum
    to 1."""
    unevenness: Float64Array
    """Light over a spot: 1 + a u + b v + c (2 (u^2 + v^2) - 1) of u, v in radii, shape (F, 3)."""
    edge_px: float
    """Standard deviation of the edges' blur, pixels, > 0."""
    wings: float
    """Share of the light in the lens's wings, which fall with the distance cubed, 0 to 1."""
    veil: float
    """Share of all light that a nominal spot's area gets anywhere, 0 to 0.01."""
    cover_leak: float = 1e-5
    """Transmittance of a covered fiber, 0 to 1."""
    ripple: float = 1e-3
    """Relative standard deviation of the source's energy from opening to opening, 0 to 0.1."""

    def __post_init__(self) -> None:
        count = len(self.spot_px)
        for name, shape in (
            ("spot_px", (count, 2)),
            ("radius_px", (count,)),
            ("gain", (count,)),
            ("crosstalk", (count, count)),
            ("unevenness", (count, 3)),
        ):
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise ProbeBuildError(f"{name}: got shape {value.shape}, expected finite {shape}")
        for name in ("radius_px", "gain"):
            least = float(getattr(self, name).min(initial=math.inf))
            if not least > 0.0:
                raise ProbeBuildError(f"{name}: got {least}, expected > 0")
        if not (self.crosstalk >= 0.0).all() or not np.allclose(self.crosstalk.sum(axis=0), 1.0):
            raise ProbeBuildError("crosstalk: expected shares >= 0 that sum to 1 in each column")
        for name, most in (("wings", 1.0), ("veil", 0.01), ("cover_leak", 1.0), ("ripple", 0.1)):
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                raise ProbeBuildError(f"{name}: got {value}, expected 0 to {most}")
        if not 0.0 < self.edge_px < math.inf:
            raise ProbeBuildError(f"edge_px: got {self.edge_px}, expected > 0")


@functools.lru_cache(maxsize=4)
def build_probe(rig: Rig, *, seed: int, tolerances: ProbeTolerances | None = None) -> ActualProbe:
    """Draw an actual probe; the same object for the same arguments.

    Parameters
    ----------
    rig
        The drawing; it must have a probe and one view.
    seed
        Seed of the manufacturing errors; 0 or more.
    tolerances
        Tolerances; None: the defaults.

    Returns
    -------
    ActualProbe

    Raises
    ------
    ProbeBuildError
        The rig has no probe.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> built = build_probe(load_rig("probe"), seed=1)
    >>> built.gain.shape, bool(abs(built.gain - 1.0).max() <= 0.1)
    ((28,), True)
    """
    if rig.probe is None or len(rig.views) != 1:
        raise ProbeBuildError(f"rig {rig.name!r}: expected a contact probe and one view")
    size = ProbeTolerances() if tolerances is None else tolerances
    view, fibers = rig.views[0], rig.probe.fibers
    count = len(fibers)
    rng = np.random.default_rng([seed, 0x70726F62])
    turn = math.radians(size.rotation_deg) * float(rng.standard_normal())
    middle = 0.5 * np.array([view.width_px - 1.0, view.height_px - 1.0])
    place = np.array([fiber.spot_px for fiber in fibers]) - middle
    c, s = math.cos(turn), math.sin(turn)
    place = place @ np.array([[c, s], [-s, c]]) + middle
    place += size.shift_px * _draw_truncated_normal(
        rng, (1, 2)
    ) + size.position_px * _draw_truncated_normal(rng, (count, 2))
    gain = 1.0 + size.gain * _draw_truncated_normal(rng, (count,))
    radius = SPOT_RADIUS_PX * (1.0 + size.radius * _draw_truncated_normal(rng, (count,)))
    uneven = (
        FIBER_END_UNEVENNESS * _draw_truncated_normal(rng, (count, 3))
        if size.radius > 0.0
        else np.zeros((count, 3))
    )
    return ActualProbe(
        place,
        radius,
        gain,
        _draw_crosstalk(count, size.crosstalk, rng),
        uneven,
        size.edge_px,
        size.wings,
        size.veil,
    )


def _draw_truncated_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Float64Array:
    """Return standard normal numbers truncated to [-2, 2]: outliers are rejected parts."""
    return np.asarray(np.clip(rng.standard_normal(shape), -2.0, 2.0))


def _draw_crosstalk(count: int, neighbor: float, rng: np.random.Generator) -> Float64Array:
    out = np.zeros((count, count))
    for step, share in ((1, neighbor), (2, 0.1 * neighbor)):
        for i in range(count - step):
            leak = share * math.exp(0.3 * float(_draw_truncated_normal(rng, ())))
            out[i, i + step] = out[i + step, i] = leak
    return np.asarray(out + np.diag(1.0 - out.sum(axis=0)))
