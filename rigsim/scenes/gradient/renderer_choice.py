"""Choose the renderer of a patch of skin: a Mitsuba scene where it is affordable."""

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import View
from rigsim.as_built.sphere import ActualSphere
from rigsim.light.lobe_moments import MicrofacetSurface
from rigsim.mitsuba.variant import VariantChoice, choose_renderer
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.gradient.lighting import PatchLighting, TabulatedLight, lit_leds, tabulate_light
from rigsim.scenes.gradient.rendering import TracedLight
from rigsim.skin_patch.microrelief import MicroSkin, lateral_kernel

MAX_SHADOW_RAYS: Final = 2.5e7
"""Shadow rays of a state that Mitsuba traces, one per sample and LED: 5 s of processor time."""

MIN_TRACED_ALPHA: Final = 0.02
"""Roughness below which rounding to 16 bit and float32 changes a highlight by over 0.2 %."""

HORIZON_SECTORS: Final = 32
"""Default number of directions with horizons."""

GROOVE_SECTORS: Final = 16
"""Number of sky directions for interreflection in grooves."""


@dataclass(frozen=True, slots=True)
class LightSettings:
    """Effects of the light on a patch, and settings of the fast renderer."""

    shadows: bool
    """Whether the relief casts shadows."""
    lateral: bool
    """Whether light scatters laterally in the skin."""
    interreflections: bool
    """Whether the walls of grooves light each other."""
    sectors: int | None = None
    """Number of directions with the fast renderer's horizons, a multiple of 4; None:
    `HORIZON_SECTORS`."""
    table_size: int | None = None
    """Nodes of the fast renderer's table along each axis of the normals; None chooses by
    roughness."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.sectors is not None and (self.sectors < 4 or self.sectors % 4):
            raise SceneError(f"sectors: got {self.sectors}, expected a multiple of 4")


def choose_patch_renderer(
    choice: VariantChoice | None,
    subject: MicroSkin | str,
    sphere: ActualSphere,
    samples: int,
    settings: LightSettings,
) -> VariantChoice:
    """Return the variant for a patch, with the reason for the fast renderer.

    Parameters
    ----------
    choice
        Requested variant; None: the best one of this machine, up to `MAX_SHADOW_RAYS`.
    subject
        A patch of skin, or the name of a target.
    sphere
        The LEDs.
    samples
        Samples of the camera, without margins.
    settings
        Effects; requested settings of the fast renderer choose it.
    """
    rays = float(samples) * len(lit_leds(sphere, shadows=settings.shadows))
    asked = [name for name in ("sectors", "table_size") if getattr(settings, name) is not None]
    if not isinstance(subject, MicroSkin):
        why = f"closed forms render the target {subject}"
    elif asked:
        why = f"{', '.join(asked)}: requested settings of the fast renderer"
    elif choice is None and rays > MAX_SHADOW_RAYS:
        why = f"{rays:.2g} shadow rays per state exceed {MAX_SHADOW_RAYS:.2g}"
    elif float(subject.alpha.min()) < MIN_TRACED_ALPHA:
        why = f"roughness {float(subject.alpha.min()):.2g} is below {MIN_TRACED_ALPHA:g}"
    else:
        return choose_renderer("mitsuba") if choice is None else choice
    return dataclasses.replace(choose_renderer("fast"), why=why)


def scale_leds(sphere: ActualSphere, led_fractions: tuple[float, ...]) -> ActualSphere:
    """Return a sphere with the LEDs' output relative to its nominal one; empty: 1 for all."""
    if not led_fractions:
        return sphere
    if len(led_fractions) != len(sphere.intensity) or min(led_fractions) < 0.0:
        raise SceneError(f"led_shares: got {len(led_fractions)} numbers, expected one >= 0 per LED")
    return dataclasses.replace(sphere, intensity=sphere.intensity * np.array(led_fractions))


def light_patch(
    skin: MicroSkin,
    sphere: ActualSphere,
    surface: MicrofacetSurface,
    view: View,
    variant: VariantChoice,
    settings: LightSettings,
) -> PatchLighting:
    """Return the light of a sphere on a patch of skin, which serves all its states.

    Parameters
    ----------
    skin
        The patch: its roughness and its pigment.
    sphere
        The LEDs.
    surface
        The camera and the polarizers; the roughness is the patch's.
    view
        The camera.
    variant
        Result of `choose_patch_renderer`.
    settings
        Effects, and settings of the fast renderer.
    """
    direct: TracedLight | TabulatedLight
    if variant.renderer == "mitsuba":
        leds = lit_leds(sphere, shadows=settings.shadows)
        direct = TracedLight(sphere, surface, leds, settings.shadows, view, variant)
    else:
        direct = tabulate_light(
            skin,
            sphere,
            surface,
            half_field_mm=0.5 * max(view.field_mm) + 0.1,
            sectors=(settings.sectors or HORIZON_SECTORS) if settings.shadows else 0,
            table_size=settings.table_size,
        )
    kernel = lateral_kernel(skin) if settings.lateral else (np.zeros(0), np.zeros(0))
    return PatchLighting(direct, *kernel, GROOVE_SECTORS if settings.interreflections else 0)
