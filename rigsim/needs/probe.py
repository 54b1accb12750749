"""What the fibre probe's pictures must hold, and what they need not."""

from typing import Final

import numpy as np

from capture.rig import Rig
from rigsim.as_built.probe import ActualProbe
from rigsim.fiber.probe_tissue import HomogeneousTissue, ProbedTissue
from rigsim.needs.effects import Effect, EffectSelection, PixelNoise, omitted_effects
from rigsim.needs.face import band_effect, polarization_effect

TRANSPORT_EFFECT: Final = "paths of photons between source and fibres"
CROSSTALK_EFFECT: Final = "light that fibres pass to each other"
WINGS_EFFECT: Final = "light beyond the spots, from the lens"
COLOR_EFFECT: Final = "tissue traced color by color"
LAYERS_EFFECT: Final = "layers of the tissue"
DARK_CURRENT_EFFECT: Final = "dark current and hot pixels"


def select_probe_effects(
    rig: Rig, tissue: ProbedTissue, build: ActualProbe, *, noise: PixelNoise, hot: float
) -> EffectSelection:
    """Decide what a scene under the probe builds.

    Parameters
    ----------
    rig
        The probe's rig.
    tissue
        What the head sits on.
    build
        The probe as it was built.
    noise
        Of the sensor, without dark current.
    hot
        Signal of the hottest pixel in the longest exposure, full scales.
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
            "photons are followed: all light in the fibres has been inside",
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
        made.append(Effect(LAYERS_EFFECT, "built", "epidermis above dermis, thinned by suction"))
        return EffectSelection((*made, *omitted_effects("probe", "probe_layered")))
    asked = tissue.kind == "homogeneous"
    why = "the tissue was asked for as homogeneous" if asked else "fibrous tissue has one layer"
    made.append(Effect(LAYERS_EFFECT, "absent", why))
    return EffectSelection((*made, *omitted_effects("probe")))


def _always_built_effect(name: str, change: float, noise: PixelNoise, because: str) -> Effect:
    """Return an effect of the probe as built that is there at any size."""
    over = change / float(noise.sigma(change))
    return Effect(name, "built", f"{because}: up to {over:.3g} times the noise", over)


def _color(tissue: ProbedTissue) -> Effect:
    if tissue.kind == "anisotropic":
        return Effect(
            COLOR_EFFECT, "absent", "its direction is what is looked for; one color is traced"
        )
    if isinstance(tissue, HomogeneousTissue) and not tissue.wavelength_nm:
        return Effect(
            COLOR_EFFECT, "negligible", "the tissue is gray: one color serves all bands", 0.0
        )
    return Effect(COLOR_EFFECT, "built", "absorption differs from band to band")
