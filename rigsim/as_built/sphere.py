"""A sphere of polarized LEDs as it was built: near the drawing, never on it."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Light, Rig
from rigsim.arrays import Float64Array
from rigsim.as_built.polarizers import absorbing_axis
from rigsim.shading import axis_in_plane

MOMENT_NAMES: Final = ("1", "x", "y", "z")
"""What each LED's light is weighted with; every lighting condition is a sum of these four."""

PATTERN_WEIGHTS: Final[dict[str, tuple[float, float, float, float]]] = {
    "full": (1.0, 0.0, 0.0, 0.0),
    "x": (0.5, 0.5, 0.0, 0.0),
    "y": (0.5, 0.0, 0.5, 0.0),
    "z": (0.5, 0.0, 0.0, 0.5),
    "-x": (0.5, -0.5, 0.0, 0.0),
    "-y": (0.5, 0.0, -0.5, 0.0),
    "-z": (0.5, 0.0, 0.0, -0.5),
    "dark": (0.0, 0.0, 0.0, 0.0),
}
"""Each pattern as a sum of the moments: LED k shines with 1, (1 + w_k) / 2 or (1 - w_k) / 2."""


class SphereError(ValueError):
    """A sphere is described wrongly."""


INTENSITY_DEVIATION: Final = 0.05
"""Standard deviation of the logarithm of an LED's intensity."""

POSITION_DEVIATION_MM: Final = 1.0
AXIS_DEVIATION_DEG: Final = 1.0
"""Standard deviations of an LED's place along each axis, and of its film's turn."""


@dataclass(frozen=True, slots=True, eq=False)
class ActualSphere:
    """The truth about the LEDs, in the order of the rig."""

    nominal: Rig
    """As drawn; the box weighs the LEDs by the directions in it."""
    position_mm: Float64Array
    """Where the LEDs are, mm, rig frame, shape (L, 3)."""
    intensity: Float64Array
    """Power over the mean of the drawing's, shape (L,), >= 0; 0 is dead."""
    absorbs: Float64Array
    """Absorbing axes of the films, unit vectors, shape (L, 3)."""
    radius_mm: Float64Array
    """Radii of the LEDs' discs, mm, shape (L,)."""

    def __post_init__(self) -> None:
        """Check shapes and ranges."""
        count = len(self.nominal.lights)
        for name, shape in (
            ("position_mm", (count, 3)),
            ("intensity", (count,)),
            ("absorbs", (count, 3)),
            ("radius_mm", (count,)),
        ):
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise SphereError(f"{name}: got shape {value.shape}, expected finite {shape}")
        if (self.intensity < 0.0).any():
            raise SphereError(f"intensity: got {self.intensity.min()}, expected >= 0")

    @property
    def weights(self) -> Float64Array:
        """Return what the moments weigh each LED with, shape (L, 4): 1 and nominal direction."""
        place = np.array([light.position_mm for light in self.nominal.lights])
        direction = place / np.linalg.norm(place, axis=1, keepdims=True)
        return np.column_stack([np.ones(len(place)), direction])

    @property
    def dead(self) -> tuple[str, ...]:
        """Return the names of LEDs that give no light."""
        return tuple(
            light.name
            for light, power in zip(self.nominal.lights, self.intensity, strict=True)
            if power == 0.0
        )


def nominal_sphere(rig: Rig) -> ActualSphere:
    """Return a sphere that stands exactly as its drawing says.

    Parameters
    ----------
    rig
        The drawing; its lights must be LEDs with polarizers and share one spectrum.

    Raises
    ------
    SphereError
        A light is no LED, or the spectra differ.
    """
    spectra_names = {light.illuminant for light in rig.lights}
    if len(spectra_names) > 1:
        raise SphereError(
            f"lights: got the spectra {', '.join(sorted(spectra_names))}, expected one"
        )
    power = np.array([_power(light) for light in rig.lights])
    return ActualSphere(
        rig,
        np.array([light.position_mm for light in rig.lights], np.float64),
        power / power.mean(),
        np.array([absorbing_axis(light) for light in rig.lights]),
        np.array([light.radius_mm for light in rig.lights], np.float64),
    )


def build_sphere(
    rig: Rig, *, seed: int, dead: tuple[str, ...] = (), weak: tuple[str, ...] = ()
) -> ActualSphere:
    """Draw a sphere as built; the same seed builds each LED the same in any subset.

    Parameters
    ----------
    rig
        The drawing.
    seed
        Seed of what the workshop left.
    dead, weak
        Names of LEDs that give nothing, and a third of their light.

    Returns
    -------
    BuiltSphere
    """
    drawn = nominal_sphere(rig)
    for name in (*dead, *weak):
        rig.light(name)
    position, intensity, absorbs = [], [], []
    for light, power in zip(rig.lights, drawn.intensity, strict=True):
        rng = np.random.default_rng([seed, *light.name.encode()])
        place = np.asarray(light.position_mm) + POSITION_DEVIATION_MM * rng.standard_normal(3)
        share = 0.0 if light.name in dead else 1.0 / 3.0 if light.name in weak else 1.0
        turn_deg = AXIS_DEVIATION_DEG * float(rng.standard_normal())
        position.append(place)
        intensity.append(
            power * share * math.exp(INTENSITY_DEVIATION * float(rng.standard_normal()))
        )
        axis_deg = 0.0 if light.polarizer_axis_deg is None else light.polarizer_axis_deg
        absorbs.append(axis_in_plane(axis_deg + 90.0 + turn_deg, place, (0.0, 1.0, 0.0)))
    return ActualSphere(
        rig, np.array(position), np.array(intensity), np.array(absorbs), drawn.radius_mm
    )


def _power(light: Light) -> float:
    if light.power_w is None:
        raise SphereError(f"light {light.name!r}: is no LED, it has no power_w")
    return light.power_w


REFERENCE_DISTANCE_MM: Final = 600.0
"""Distance at which an LED of intensity 1 gives unit irradiance."""


def diffuser_radiance(
    sphere: ActualSphere, x_mm: Float64Array, y_mm: Float64Array, *, extinction: float = math.inf
) -> Float64Array:
    """Return the radiance of a perfect white diffuser at z = 0 that faces +z, for each moment.

    Parameters
    ----------
    sphere
        The LEDs; they shine at the origin.
    x_mm, y_mm
        Places, any shape, mm.
    extinction
        Of the LEDs' films, > 1; what a film passes of unpolarized light is at least half.

    Returns
    -------
    ndarray
        Shape (4, ...), in the unit of `rigsim.light.lobe_moments`.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> white = diffuser_radiance(nominal_sphere(load_rig("gradient")), np.zeros(1), np.zeros(1))
    >>> bool(abs(white[1, 0] / white[0, 0]) < 0.01), bool(white[3, 0] > 0.5 * white[0, 0])
    (True, True)
    """
    x, y = np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64)
    out = np.zeros((4, *np.broadcast_shapes(x.shape, y.shape)))
    film = 0.5 * (1.0 + 1.0 / extinction)
    for led, (place, weight) in enumerate(zip(sphere.position_mm, sphere.weights, strict=True)):
        if place[2] <= 0.0:
            continue
        square = (place[0] - x) ** 2 + (place[1] - y) ** 2 + place[2] ** 2
        light = (
            film
            / math.pi
            * sphere.intensity[led]
            * REFERENCE_DISTANCE_MM**2
            * place[2]
            / square**1.5
        )
        out += weight.reshape(4, *[1] * (out.ndim - 1)) * light
    return out
