"""Select the effects that the fiber probe's images require."""

from typing import Final

import numpy as np

from capture.rig import Rig
from rigsim.as_built.probe import ActualProbe
from rigsim.fiber.probe_tissue import HomogeneousTissue, ProbedTissue
from rigsim.needs.effects import Effect, EffectSelection, PixelNoise, omitted_effects
from rigsim.needs.face import band_effect, polarization_effect

TRANSPORT_EFFECT: Final = "paths of photons between source and fibers"
CROSSTALK_EFFECT: Final = "crosstalk between fibers"
WINGS_EFFECT: Final = "light around the spots, from the lens"
COLOR_EFFECT: Final = "tissue traced per color band"
LAYERS_EFFECT: Final = "layers of the tissue"
DARK_CURRENT_EFFECT: Final = "dark current and hot pixels"


def select_probe_effects(
    rig: Rig, tissue: ProbedTissue, build: ActualProbe, *, noise: PixelNoise, hot: float
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
        made.append(Effect(LAYERS_EFFECT, "built", "epidermis above dermis, thinned by suction"))
        return EffectSelection((*made, *omitted_effects("probe", "probe_layered")))
    asked = tissue.kind == "homogeneous"
    why = "the tissue was asked for as homogeneous" if asked else "fibrous tissue has one layer"
    made.append(Effect(LAYERS_EFFECT, "absent", why))
    return EffectSelection((*made, *omitted_effects("probe")))


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
