"""Select the effects that the fiber probe's images require."""

from dataclasses import replace
from typing import Final

import numpy as np

from capture.rig import Rig
from model import spectra
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.probe import ActualProbe
from rigsim.fiber.probe_tissue import (
    SKIN_WAVELENGTHS_NM,
    HomogeneousTissue,
    ProbedTissue,
    SkinTissue,
)
from rigsim.fiber.white_fiber import log_diffuse_reflectance
from rigsim.needs.effects import (
    Effect,
    EffectSelection,
    PixelNoise,
    SceneEffects,
    decide_effect,
    omitted_effects,
)
from rigsim.needs.face import band_effect, polarization_effect
from rigsim.needs.tissue import select_tissue_effects
from rigsim.subject.person_skin import SITE_NAMES
from rigsim.tissue.skin_layers import TissueProperties
from rigsim.tissue.skin_table import interpolate_rings

TRANSPORT_EFFECT: Final = "paths of photons between source and fibers"
CROSSTALK_EFFECT: Final = "crosstalk between fibers"
WINGS_EFFECT: Final = "light around the spots, from the lens"
COLOR_EFFECT: Final = "tissue traced per color band"
LAYERS_EFFECT: Final = "layers of the tissue"
MIN_SCATTERING_PER_MM: Final = 1e-3
"""Least reduced scattering of a medium for which diffusion is evaluated, 1/mm."""
DARK_CURRENT_EFFECT: Final = "dark current and hot pixels"


def select_probe_effects(
    rig: Rig,
    tissue: ProbedTissue,
    build: ActualProbe,
    *,
    noise: PixelNoise,
    hot: float,
    unit_rgb: Float64Array,
    spots: Float32Array,
    effects: SceneEffects,
) -> EffectSelection:
    """Select the effects that a scene under the probe builds.

    Parameters
    ----------
    rig
        The probe's rig.
    tissue
        The tissue below the head.
    build
        The actual probe.
    noise
        Noise of the sensor, without dark current.
    hot
        Signal of the hottest pixel in the longest exposure, full scales.
    unit_rgb
        Signal of 1/mm^2 in the longest exposure, full scales, shape (3,).
    spots
        Image of each fiber's light, shape (F, H, W).
    effects
        Requested effects.
    """
    view = rig.views[0]
    pixels = equivalent_pixels(spots)
    light = build.gain[:, None] * predict_light(rig, tissue)

    def mixing_effect(name: str, mixing: Float64Array, switch: str, reason: str) -> Effect:
        change = mixing_over_noise(mixing, light, unit_rgb, noise, pixels)
        return decide_effect(name, change, getattr(effects, switch), switch=switch, reason=reason)

    made = [
        polarization_effect(rig, view),
        band_effect(view),
        Effect(
            TRANSPORT_EFFECT,
            "built",
            "photons are followed: all light in the fibers has crossed the tissue",
        ),
        mixing_effect(
            CROSSTALK_EFFECT, build.crosstalk, "crosstalk", "other fibers' light in a reading"
        ),
        mixing_effect(
            WINGS_EFFECT,
            mix_by_wings(build),
            "wings",
            f"{100 * build.wings:.2g} % of each spot's light",
        ),
        decide_effect(
            DARK_CURRENT_EFFECT,
            hot / float(noise.sigma(hot)),
            effects.dark_current,
            switch="dark_current",
            reason=f"up to {100 * hot:.2g} % of full scale in the longest exposure",
        ),
        _color(tissue),
    ]
    if tissue.kind == "layered":
        if isinstance(tissue, SkinTissue):
            made += _tissue_effects(rig, tissue, float(noise.sigma(1.0)) / pixels**0.5, effects)
        made.append(Effect(LAYERS_EFFECT, "built", "epidermis above dermis, thinned by suction"))
        return EffectSelection((*made, *omitted_effects("probe", "probe_layered")))
    asked = tissue.kind == "homogeneous"
    why = "the tissue was asked for as homogeneous" if asked else "fibrous tissue has one layer"
    made.append(Effect(LAYERS_EFFECT, "absent", why))
    return EffectSelection((*made, *omitted_effects("probe")))


def equivalent_pixels(images: Float32Array) -> float:
    """Return the number of pixels of equal light whose sum has the noise of a fiber's spot.

    Parameters
    ----------
    images
        Image of each fiber's light, shape (F, H, W); the spot with the least noise counts.

    Examples
    --------
    >>> equivalent_pixels(np.ones((2, 3, 4), np.float32))
    12.0
    """
    flat = images.reshape(len(images), -1).astype(np.float64)
    return float((flat.sum(axis=1) ** 2 / np.square(flat).sum(axis=1)).max())


def mixing_over_noise(
    mixing: Float64Array,
    light: Float64Array,
    unit_rgb: Float64Array,
    noise: PixelNoise,
    spot_pixels: float,
) -> float:
    """Return the largest change of a reading over its noise by light of other fibers.

    Parameters
    ----------
    mixing
        Fraction of fiber j's light that is read in the spot of fiber i, at [i, j], (F, F).
    light
        Light in the fibers, 1/mm^2, (sites, F, 3).
    unit_rgb
        Signal of 1/mm^2 in the longest exposure, full scales, (3,).
    noise
        Noise of a pixel.
    spot_pixels
        See `equivalent_pixels`.

    Notes
    -----
    Each reading is of the longest exposure in which its spot is not saturated. Nearer fibers, which
    saturate in it, are far brighter.

    Examples
    --------
    >>> leak = np.array([[0.999, 0.001], [0.001, 0.999]])
    >>> light = np.array([[[10.0], [1.0]]])
    >>> args = np.array([1e3]), PixelNoise(1e-4, 0.0), 400.0
    >>> round(mixing_over_noise(leak, light, *args), 6)  # 9e-3 of a reading, noise 5e-4
    18.0
    """
    mixed = np.einsum("ij,sjc->sic", mixing, light)
    signal = light * unit_rgb
    change = np.abs(mixed - light) * unit_rgb / np.maximum(signal, 1.0)
    return float((change / noise.sigma(np.minimum(signal, 1.0))).max()) * spot_pixels**0.5


def mix_by_wings(build: ActualProbe) -> Float64Array:
    """Return the fraction of each fiber's light in each spot with the lens's wings, (F, F).

    The wings of a spot of radius R have the density R / (2 pi (d^2 + R^2)^1.5) at distance d, of
    which 1 - 1 / sqrt(2) is inside the spot.

    Parameters
    ----------
    build
        The actual probe.
    """
    apart = np.linalg.norm(build.spot_px[:, None] - build.spot_px[None], axis=-1)
    radius = build.radius_px[None, :]
    density = radius / (2.0 * np.pi * (apart**2 + radius**2) ** 1.5)
    mixing = build.wings * np.pi * build.radius_px[:, None] ** 2 * density
    np.fill_diagonal(mixing, 1.0 - build.wings / np.sqrt(2.0))
    return np.asarray(mixing)


def predict_light(rig: Rig, tissue: ProbedTissue) -> Float64Array:
    """Return the expected light in the fibers without photons, 1/mm^2, (sites, F, 3).

    Skin by the tables; other media by diffusion, up to a factor of a few per fiber.

    Parameters
    ----------
    rig
        The probe's rig.
    tissue
        The tissue below the head.
    """
    if isinstance(tissue, SkinTissue):
        return predict_profiles(rig, tissue, tissue.person.tissue)
    if rig.probe is None:
        raise ValueError(f"rig {rig.name!r}: got no probe, expected one; load the probe's rig")
    optics = tissue.optics(SITE_NAMES[0], 0.0, 0.0)
    radius = np.array(rig.probe.radius_mm)
    media = [stack.layers[-1] for stack in optics.stacks]
    scatterings = [max(one.sigma_s_per_mm * (1.0 - one.g), MIN_SCATTERING_PER_MM) for one in media]
    logs = [
        2.0 * np.log(s) + log_diffuse_reflectance(s * radius, one.sigma_a_per_mm / s)
        for s, one in zip(scatterings, media, strict=True)
    ]
    profile = np.exp(np.stack(logs, axis=-1))
    weights = np.ones((1, 3))
    if optics.wavelength_nm:
        weights = spectra.band_weights(
            rig.views[0].spectral_sensitivity,
            rig.lights[0].illuminant,
            np.asarray(optics.wavelength_nm, np.float64),
        )
    return np.asarray((profile @ weights)[None])


def predict_profiles(rig: Rig, tissue: SkinTissue, properties: TissueProperties) -> Float64Array:
    """Return the light in the fibers at each site of a person by the tables, without photons.

    Parameters
    ----------
    rig
        The probe's rig.
    tissue
        The person's skin.
    properties
        Properties that replace those of the person, except for melanin and blood.

    Returns
    -------
    ndarray
        Reflectance in 1/mm^2, shape (sites, F, 3), of rings as wide as the fibers' cores.
    """
    if rig.probe is None:
        raise ValueError(f"rig {rig.name!r}: got no probe, expected one; load the probe's rig")
    half = 0.5 * rig.probe.fibers[0].core_mm
    radius = np.array(rig.probe.radius_mm)
    inner, outer = radius - half, radius + half
    edges = np.concatenate([[0.0], np.stack([inner, outer], axis=-1).ravel(), [2.0 * outer[-1]]])
    weights = spectra.band_weights(
        rig.views[0].spectral_sensitivity, rig.lights[0].illuminant, SKIN_WAVELENGTHS_NM
    )
    area_mm2 = np.pi * (outer**2 - inner**2)
    other = SkinTissue(replace(tissue.person, tissue=properties))
    rings = [
        interpolate_rings(
            other.melanin(site),
            other.blood(site, 0.0),
            other.person.at(site).tissue,
            SKIN_WAVELENGTHS_NM,
            edges,
        )[1:-1:2]
        for site in SITE_NAMES
    ]
    return np.stack(rings) @ weights / area_mm2[:, None]


def _tissue_effects(
    rig: Rig, tissue: SkinTissue, relative_noise: float, effects: SceneEffects
) -> list[Effect]:
    """Return whether the readings require each property of the tissue.

    ``relative_noise`` is that of a reading at full scale, which every fiber's exposures approach.
    """
    person = tissue.person.tissue
    own: list[Float64Array] = []

    def change_over_noise(other: TissueProperties) -> float:
        if not own:
            own.append(predict_profiles(rig, tissue, person))
        changed = predict_profiles(rig, tissue, other)
        return float(np.abs(changed / own[0] - 1.0).max()) / relative_noise

    return select_tissue_effects(person, change_over_noise, effects)


def _color(tissue: ProbedTissue) -> Effect:
    if tissue.kind == "anisotropic":
        return Effect(COLOR_EFFECT, "absent", "its direction is the measurand; one color is traced")
    if isinstance(tissue, HomogeneousTissue) and not tissue.wavelength_nm:
        return Effect(
            COLOR_EFFECT, "negligible", "the tissue is gray: one color serves all bands", 0.0
        )
    return Effect(COLOR_EFFECT, "built", "absorption differs from band to band")
