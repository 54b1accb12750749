"""Define the lights of renderings: near, distant, or the LEDs of a calibrated rig.

The unit of intensity is the value of a perfect white Lambertian patch that faces the light.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from capture.calibration.lights import LightTable
from model import store
from skinrig.arrays import Float32Array, Float64Array
from skinrig.errors import require_choice

Vector = tuple[float, float, float]

FAR_LIGHT_MM: Final = 1e5
"""Distance of a distant light's disc, at which shadow rays end."""
MAX_UNDIVIDED_RAD: Final = 0.04
"""Maximum angular radius of a light that is shaded as one; BRDFs vary over larger ones."""
LIGHT_PARTS: Final = 16
"""Number of parts of a divided light."""
GOLDEN_ANGLE_RAD: Final = math.pi * (3.0 - math.sqrt(5.0))


class LightError(ValueError):
    """Invalid light."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """A circular light, near or distant; either `position_mm` or `direction` is given."""

    name: str
    """Name in messages and records."""
    intensity: Vector = (1.0, 1.0, 1.0)
    """Value of a white Lambertian patch that faces the light, at least 0, in the channels of the
    model; for a near light at `reference_mm` on its axis."""
    position_mm: Vector | None = None
    """Center of its disc, mm, rig frame."""
    direction: Vector | None = None
    """Direction towards a distant light, rig frame, any length; stored as a unit vector."""
    radius: float = 0.0
    """Radius of its disc: mm if near, rad if distant; 0: a point, with hard shadows."""
    reference_mm: float | None = None
    """Distance at which `intensity` is stated, mm; None: that of the rig's origin."""
    axis: Vector | None = None
    """Direction of its axis, any length; None: towards the rig's origin."""
    is_divisible: bool = True
    """Whether a broad light is shaded in parts; False for parts of a larger source."""
    exponent: float = 0.0
    """Exponent of the cosine of the angle from its axis; 0: isotropic."""
    _reference: float = field(default=1.0, init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers and normalize directions."""
        if (self.position_mm is None) == (self.direction is None):
            raise LightError(
                f"light {self.name!r}: got both or neither of position and direction, expected one"
            )
        for name in ("intensity", "position_mm", "direction", "axis"):
            given = getattr(self, name)
            if given is not None:
                object.__setattr__(self, name, _check_triple(self.name, name, given))
        if min(self.intensity) < 0.0:
            raise LightError(f"light {self.name!r}: got intensity {self.intensity}, expected >= 0")
        if not 0.0 <= self.radius < (math.inf if self.direction is None else 0.7):
            raise LightError(
                f"light {self.name!r}: got radius {self.radius}, expected >= 0, in rad below 0.7"
            )
        if not 0.0 <= self.exponent < math.inf:
            raise LightError(f"light {self.name!r}: got exponent {self.exponent}, expected >= 0")
        for name in ("direction", "axis"):
            given = getattr(self, name)
            if given is not None:
                object.__setattr__(self, name, _unit(self.name, name, given))
        if self.position_mm is not None:
            away = self.reference_mm
            distance = math.hypot(*self.position_mm) if away is None else away
            if not 0.0 < distance < math.inf:
                raise LightError(
                    f"light {self.name!r}: got a reference distance of {distance} mm, expected > 0"
                )
            object.__setattr__(self, "_reference", float(distance))
            if self.axis is None and math.hypot(*self.position_mm) > 0.0:
                inward = (-self.position_mm[0], -self.position_mm[1], -self.position_mm[2])
                object.__setattr__(self, "axis", _unit(self.name, "axis", inward))

    @staticmethod
    def from_table(table: LightTable, name: str, *, radius_mm: float) -> Light:
        """Create a calibrated light; renderings then have the unit of the images.

        Parameters
        ----------
        table
            Calibrated lights.
        name
            One of ``table.names``.
        radius_mm
            Radius of its disc, mm.

        Raises
        ------
        LightError
            If the light is unknown, or its calibration is invalid.
        """
        row = table.names.index(require_choice("light", name, table.names, LightError))
        if not table.valid[row]:
            raise LightError(
                f"light {name!r}: defective, or its calibration is invalid; choose another light"
            )
        place = _check_triple(name, "position_mm", table.position_mm[row])
        away = math.hypot(*place)
        return Light(
            name=name,
            position_mm=place,
            radius=radius_mm,
            reference_mm=away,
            intensity=_check_triple(name, "intensity", table.intensity[row] / away**2),
            axis=_check_triple(name, "axis", table.axis[row]),
            exponent=float(table.exponent[row]),
        )

    def directions_and_irradiance(self, points_mm: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Return the directions to the light and the values of a white patch that faces it.

        Parameters
        ----------
        points_mm
            Points, shape (n, 3), mm, rig frame.

        Returns
        -------
        direction, white : ndarray of float64
            Unit vectors towards the light, shape (n, 3), and values, shape (n, 3).

        Examples
        --------
        >>> lamp = Light(name="near", position_mm=(0.0, 0.0, 100.0))
        >>> towards, white = lamp.directions_and_irradiance([[0.0, 0.0, 0.0], [0.0, 0.0, 50.0]])
        >>> towards[1].tolist(), white[1].tolist()
        ([0.0, 0.0, 1.0], [4.0, 4.0, 4.0])
        """
        points = np.atleast_2d(np.asarray(points_mm, np.float64))
        if self.direction is not None:
            shape = points.shape
            return (np.broadcast_to(self.direction, shape), np.broadcast_to(self.intensity, shape))
        offset = np.asarray(self.position_mm) - points
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        if not (distance > 0.0).all():
            raise LightError(f"light {self.name!r}: got a position on the lit surface; move it")
        direction = offset / distance
        strength = (self._reference / distance) ** 2
        if self.exponent > 0.0 and self.axis is not None:
            cosine = np.maximum(-(direction @ np.asarray(self.axis)), 0.0)
            strength = strength * cosine[:, None] ** self.exponent
        return direction, strength * np.asarray(self.intensity)

    def disc(self) -> tuple[Float64Array, float]:
        """Return center, mm, shape (3,), and radius, mm, of the disc at which shadow rays end.

        The disc of a distant light is at `FAR_LIGHT_MM`.
        """
        if self.direction is not None:
            return np.asarray(self.direction) * FAR_LIGHT_MM, FAR_LIGHT_MM * math.tan(self.radius)
        return np.asarray(self.position_mm, np.float64), self.radius

    def parts(self, count: int = LIGHT_PARTS) -> tuple[Light, ...]:
        """Divide a broad light into smaller ones of the same total; return others unchanged."""
        center, radius = self.disc()
        away = float(np.linalg.norm(center))
        if not self.is_divisible or count < 2 or away == 0.0 or radius <= MAX_UNDIVIDED_RAD * away:
            return (self,)
        helper = np.eye(3)[int(np.argmin(np.abs(center)))]
        side = np.cross(helper, center)
        side /= np.linalg.norm(side)
        other = np.cross(center, side) / away
        k = np.arange(count)
        reach = radius * np.sqrt((k + 0.5) / count)
        places = center + reach[:, None] * (
            np.cos(k * GOLDEN_ANGLE_RAD)[:, None] * side
            + np.sin(k * GOLDEN_ANGLE_RAD)[:, None] * other
        )
        # a white patch that faces the center receives the parts at an angle and, for a near light,
        # from a larger distance; intensities are scaled so that the total is kept
        cosine = away / np.linalg.norm(places, axis=-1)
        whole = float(np.sum(cosine if self.direction is not None else cosine**3))
        share = tuple(value / whole for value in self.intensity)
        out = []
        for place in places:
            fields: dict[str, object] = {"radius": self.radius / math.sqrt(count)}
            if self.direction is not None:
                fields["direction"] = _check_triple(self.name, "direction", place)
            else:
                fields |= {"position_mm": _check_triple(self.name, "position_mm", place)}
                fields |= {"reference_mm": self._reference}
            out.append(dataclasses.replace(self, intensity=share, **fields))  # type: ignore[arg-type]
        return tuple(out)


def _check_triple(owner: str, name: str, triple: ArrayLike) -> Vector:
    values = np.asarray(triple, np.float64)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise LightError(
            f"light {owner!r}: got {name} {values.tolist()}, expected three finite numbers"
        )
    x, y, z = values.tolist()
    return x, y, z


def _unit(owner: str, name: str, vector: Vector) -> Vector:
    length = math.hypot(*vector)
    if not length > 0.0:
        raise LightError(f"light {owner!r}: got {name} {vector}, expected a direction")
    return vector[0] / length, vector[1] / length, vector[2] / length


MAX_LIGHT_RADIUS_RAD: Final = 0.35
"""Largest angular radius of a light sampled from an environment map."""
MAX_LIGHTS: Final = 65_536


def compute_pixel_directions(height: int, width: int) -> tuple[Float64Array, Float64Array]:
    """Return unit vectors to the centers of a map's pixels, (H, W, 3), and solid angles, (H, W).

    Examples
    --------
    >>> towards, solid = compute_pixel_directions(90, 180)
    >>> towards[44, 90].round(1).tolist(), bool(abs(solid.sum() - 4 * math.pi) < 1e-9)
    ([-0.0, 0.0, 1.0], True)
    """
    edges = np.linspace(0.0, math.pi, height + 1)
    polar = 0.5 * (edges[1:] + edges[:-1])
    turn = 2.0 * math.pi * ((np.arange(width) + 0.5) / width - 0.5)
    sine = np.sin(polar)[:, None]
    x, y, z = np.broadcast_arrays(
        -np.sin(turn) * sine, np.cos(polar)[:, None] + 0.0 * turn, np.cos(turn) * sine
    )
    towards = np.stack([x, y, z], axis=-1)
    step = np.full(width, 2.0 * math.pi / width)
    solid = (np.cos(edges[:-1]) - np.cos(edges[1:]))[:, None] * step
    return towards, solid


def sample_environment_lights(
    radiance: ArrayLike, count: int, *, rng: np.random.Generator
) -> tuple[Light, ...]:
    """Sample distant lights from an environment map with probability proportional to power.

    Each represents an equal fraction of the map's power: stratified draws from the running sum of
    power along the map's rows, so that the sum over lights has less noise than separate draws.

    Parameters
    ----------
    radiance
        Shape (H, W, 3), at least 0, finite; see this module for frame and unit.
    count
        Number of lights, at least 1.
    rng
        Generator of the positions in the strata.

    Returns
    -------
    tuple of Light
        Lights whose angular radius is that of the represented solid angle, at most
        `MAX_LIGHT_RADIUS_RAD`.

    Raises
    ------
    LightError
        If the map is not such an image, or is black.

    Examples
    --------
    >>> lights = sample_environment_lights(np.ones((8, 16, 3)), 32, rng=np.random.default_rng(0))
    >>> white = sum(light.intensity[0] for light in lights)
    >>> len(lights), round(white, 6)  # over all directions, four times what comes from the front
    (32, 4.0)
    """
    image = np.asarray(radiance, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 2:
        raise LightError(f"environment: got shape {image.shape}, expected (H, W, 3) of 2 or more")
    if not (np.isfinite(image).all() and image.min() >= 0.0):
        raise LightError("environment: got negative or non-finite values, expected radiances")
    if not 1 <= count <= MAX_LIGHTS:
        raise LightError(f"environment lights: got {count}, expected 1 to {MAX_LIGHTS}")
    towards, solid = compute_pixel_directions(*image.shape[:2])
    power = image.mean(axis=-1) * solid
    if not power.sum() > 0.0:
        raise LightError("environment: got a map without light")
    # every second row is reversed (boustrophedon), so that neighbors in the order are neighbors in
    # the map
    order = np.arange(power.size).reshape(power.shape)
    order[1::2] = order[1::2, ::-1]
    order = order.reshape(-1)
    running = np.cumsum(power.reshape(-1)[order])
    # stratified sampling: one draw per stratum of equal power, by inversion of the running sum
    at = (np.arange(count) + rng.random(count)) / count * running[-1]
    pixel = order[np.minimum(np.searchsorted(running, at, side="right"), power.size - 1)]
    chance = power.reshape(-1)[pixel] / running[-1]
    # importance sampling: a pixel of solid angle w, drawn count x p times on average, represents
    # w / (count p) per draw, so that the sum over lights is an unbiased integral of the map
    share = solid.reshape(-1)[pixel] / (chance * count)
    color = image.reshape(-1, 3)[pixel] * (share / math.pi)[:, None]
    radius = np.minimum(np.sqrt(share / math.pi), MAX_LIGHT_RADIUS_RAD)
    return tuple(
        Light(
            name="environment",
            direction=_check_triple("environment", "direction", towards.reshape(-1, 3)[pixel[k]]),
            intensity=_check_triple("environment", "intensity", color[k]),
            radius=float(radius[k]),
            is_divisible=False,
        )
        for k in range(count)
    )


def read_environment(path: str | Path) -> Float32Array:
    """Read a map from an OpenEXR file, shape (H, W, 3); a gray one has one color.

    Raises
    ------
    model.store.StoreError
        If the file is missing or not such an image.
    """
    image = store.read_exr(path)
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
