"""Measure the detail that the gradient rig resolves, by waves through the simulated chain.

Nagano et al. 2015 (doi 10.1145/2766894) state 10 um of detail for 6 um per pixel. A circular pupil
at the working f-number N' transmits no period below N' times the wavelength, here 18 um on the skin
in green. The stated 10 um are therefore about two pixel pitches, but not the lens's resolution.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import load_rig
from rigsim.arrays import Float64Array
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.gradient.patch import Relief
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.skin_patch.stretch import SurfaceSample
from rigsim.world.taped_skin import GripState

REFERENCE_PERIOD_UM: Final = 240.0
"""Period of reference waves without lens and pixels, um; they scale the others."""

FIELD_PX: Final = 96


@dataclass(frozen=True, slots=True)
class SineRelief:
    """Even skin with waves along x; see `rigsim.scenes.gradient.patch.Relief`."""

    period_um: float
    """Period, um, > 0."""
    slope: float
    """Largest slope, dimensionless."""
    albedo: float = 0.2
    """Diffuse reflectance."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not self.period_um > 0.0:
            raise ValueError(f"period_um: got {self.period_um}, expected > 0")

    def sample(self, x_mm: ArrayLike, y_mm: ArrayLike) -> SurfaceSample:
        """Return the waves at points, mm."""
        x = np.asarray(x_mm, np.float64)
        k = 2.0 * math.pi / self.period_um
        height = self.slope / k * np.sin(1e3 * k * x)
        level = np.zeros(x.shape, np.float32)
        return SurfaceSample(
            height.astype(np.float32),
            (self.slope * np.cos(1e3 * k * x)).astype(np.float32),
            level,
            np.full(x.shape, self.albedo, np.float32),
            np.full(x.shape, WAVE_ALPHA, np.float32),
            np.ones(x.shape, np.bool_),
        )


WAVE_ALPHA: Final = 0.25
"""Roughness of the waves."""


class SineReliefScene(GradientScene):
    """The rig with waves instead of skin; call `set_waves` before an exposure."""

    waves = SineRelief(REFERENCE_PERIOD_UM, 0.05)

    def set_waves(self, waves: SineRelief) -> None:
        """Replace the patch's waves."""
        self.waves = waves
        self.clear_caches()

    def _relief_at(self, grip: GripState) -> Relief:
        return self.waves


def make_sine_relief_scene(*, optics: bool = True) -> SineReliefScene:
    """Return the nominal gradient rig with waves, two samples along a pixel's side."""
    skin = make_micro_skin("cheek", size_mm=0.1)  # provides the pigment for lateral scattering
    even = np.full_like(skin.height_um, WAVE_ALPHA)
    rig = load_rig("gradient").cropped(FIELD_PX)
    return SineReliefScene(
        rig, dataclasses.replace(skin, alpha=even), effects=SceneEffects(optics=optics), subpixels=2
    )


def slope_transfer(periods_um: Sequence[float], *, slope: float = 0.05) -> Float64Array:
    """Return the fraction of a wave's slope that the images retain.

    Parameters
    ----------
    periods_um
        Periods of waves along x, um; those below two pixels, 12 um, are aliased.
    slope
        Largest slope of each wave.

    Returns
    -------
    ndarray
        Shape (n,): amplitude of the wave in the ratio of the surface reflection's moments x and 1,
        over its slope, relative to waves of `REFERENCE_PERIOD_UM` without lens and pixels.
    """
    scale = _amplitude(make_sine_relief_scene(optics=False), SineRelief(REFERENCE_PERIOD_UM, slope))
    scene = make_sine_relief_scene()
    return np.array([_amplitude(scene, SineRelief(float(p), slope)) / scale for p in periods_um])


def _amplitude(scene: SineReliefScene, waves: SineRelief) -> float:
    scene.set_waves(waves)
    moments = scene.moments(NEUTRAL_GRIP)
    specular = (moments["parallel"] - moments["crossed"]).astype(np.float64)
    ratio = specular[1] / specular[0]
    x = scene.surface(NEUTRAL_GRIP).x_mm[FIELD_PX // 2] * 1e3
    # whole periods in the center; bulge and view tilt add a parabola
    count = max(int(0.8 * FIELD_PX * 6.0 / waves.period_um), 1)
    inside = np.abs(x) <= 0.5 * count * waves.period_um
    phase = 2.0 * math.pi * x[inside] / waves.period_um
    t = x[inside] / np.abs(x).max()
    design = np.column_stack([np.cos(phase), np.sin(phase), np.ones_like(t), t, t * t])
    row = ratio[10:-10].mean(axis=0)[inside]
    cosine, sine = np.linalg.lstsq(design, row, rcond=None)[0][:2]
    return float(math.hypot(cosine, sine) / waves.slope)
