"""Draw an actual sphere of polarized LEDs: nominal geometry with manufacturing errors."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Light, Rig
from rigsim.arrays import Float64Array
from rigsim.as_built.polarizers import absorbing_axis
from rigsim.shading import axis_in_plane

MOMENT_NAMES: Final = ("1", "x", "y", "z")
"""Weights of the LEDs by moment; every lighting condition is a sum of these four."""

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
    """Error for invalid values of a sphere."""


INTENSITY_DEVIATION: Final = 0.05
"""Standard deviation of the logarithm of an LED's intensity."""

POSITION_DEVIATION_MM: Final = 1.0
AXIS_DEVIATION_DEG: Final = 1.0
"""Standard deviations of an LED's position along each axis, and of its polarizer's rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class ActualSphere:
    """Ground truth of the LEDs, in the order of the rig."""

    nominal: Rig
    """The nominal rig; the controller weights the LEDs by its directions."""
    position_mm: Float64Array
    """Positions of the LEDs, mm, rig frame, shape (L, 3)."""
    intensity: Float64Array
    """Power over the nominal mean, shape (L,), >= 0; 0 is dead."""
    absorbs: Float64Array
    """Absorbing axes of the polarizers, unit vectors, shape (L, 3)."""
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
        """Return the weights of each LED in the moments, shape (L, 4): 1 and nominal direction."""
        place = np.array([light.position_mm for light in self.nominal.lights])
        direction = place / np.linalg.norm(place, axis=1, keepdims=True)
        return np.column_stack([np.ones(len(place)), direction])

    @property
    def dead(self) -> tuple[str, ...]:
        """Return the names of dead LEDs."""
        return tuple(
            light.name
            for light, power in zip(self.nominal.lights, self.intensity, strict=True)
            if power == 0.0
        )


def nominal_sphere(rig: Rig) -> ActualSphere:
    """Return a sphere without manufacturing errors.

    Parameters
    ----------
    rig
        The nominal rig; its lights must be LEDs with polarizers and one common spectrum.

    Raises
    ------
    SphereError
        When a light is not an LED, or the spectra differ.
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
    """Draw an actual sphere; with the same seed each LED is the same in any subset.

    Parameters
    ----------
    rig
        The drawing.
    seed
        Seed of the manufacturing errors.
    dead, weak
        Names of LEDs that give no light, and a third of their light.

    Returns
    -------
    ActualSphere
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
        raise SphereError(f"light {light.name!r}: is not an LED; give it a power_w")
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
        Positions, any shape, mm.
    extinction
        Extinction ratio of the LEDs' polarizers, > 1; they transmit at least half of unpolarized
        light.

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
