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
from rigsim.needs.effects import Effect, EffectSelection, PixelNoise, omitted_effects
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
DARK_CURRENT_EFFECT: Final = "dark current and hot pixels"


def select_probe_effects(
    rig: Rig,
    tissue: ProbedTissue,
    build: ActualProbe,
    *,
    noise: PixelNoise,
    hot: float,
    spot_pixels: float,
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
    spot_pixels
        Pixels of equal light with the noise of a fiber's spot, see `equivalent_pixels`.
    """
    view = rig.views[0]
    others = np.array(build.crosstalk, np.float64)
    np.fill_diagonal(others, 0.0)
    leaked = float(others.max(initial=0.0))
    made = [
        polarization_effect(rig, view),
        band_effect(view),
        Effect(
            TRANSPORT_EFFECT,
            "built",
            "photons are followed: all light in the fibers has crossed the tissue",
        ),
        _always_built_effect(
            CROSSTALK_EFFECT, leaked, noise, f"up to {100 * leaked:.2g} % of a neighbor's light"
        ),
        _always_built_effect(
            WINGS_EFFECT, build.wings, noise, f"{100 * build.wings:.2g} % of a spot's light"
        ),
        _always_built_effect(
            DARK_CURRENT_EFFECT,
            hot,
            noise,
            f"up to {100 * hot:.2g} % of full scale in the longest exposure",
        ),
        _color(tissue),
    ]
    if tissue.kind == "layered":
        if isinstance(tissue, SkinTissue):
            made += _tissue_effects(rig, tissue, float(noise.sigma(1.0)) / spot_pixels**0.5)
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


def _tissue_effects(rig: Rig, tissue: SkinTissue, relative_noise: float) -> list[Effect]:
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

    return select_tissue_effects(person, change_over_noise, None)


def _always_built_effect(name: str, change: float, noise: PixelNoise, because: str) -> Effect:
    """Return an effect of the actual probe that is built at any size."""
    over = change / float(noise.sigma(change))
    return Effect(name, "built", f"{because}: up to {over:.3g} times the noise", over)


def _color(tissue: ProbedTissue) -> Effect:
    if tissue.kind == "anisotropic":
        return Effect(COLOR_EFFECT, "absent", "its direction is the measurand; one color is traced")
    if isinstance(tissue, HomogeneousTissue) and not tissue.wavelength_nm:
        return Effect(
            COLOR_EFFECT, "negligible", "the tissue is gray: one color serves all bands", 0.0
        )
    return Effect(COLOR_EFFECT, "built", "absorption differs from band to band")
