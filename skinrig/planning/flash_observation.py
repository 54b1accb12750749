"""Simulated observation of a face by the flash rig's cross-polarized camera."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture import raw
from capture.rig import Rig
from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores.face import estimate_face
from reconstruction.pipeline.flash.stages import load_skin_colors
from rigsim.population import files as subject_file
from rigsim.scenes.flash.scene import FlashScene
from rigsim.sensor import make_sensor, vignetting_map
from skinrig.arrays import BoolArray, Float64Array
from skinrig.simulating.flash_truth import to_superpixels

CHROMOPHORE_NAMES = ("melanin", "hemoglobin")
TEXTURE_TEXELS = 512
"""Side of the face's texture, texels; finer than the forecast's pixels."""
WIDTH_PX = 256
"""Pixels across the face that the forecast looks at, each as noisy as one of the whole camera."""
CONFIRM_PX = 640
"""Pixels across that are simulated: coarser ones mix the colors of different skin."""
BIAS_PIXELS = 1000
"""Pixels of a face from which its common error is estimated."""
BIAS_NOISE = 2e-3
"""Relative noise of these pixels, far below the model error."""
SESSION_BIAS: Final[Mapping[str, float]] = {"melanin": 0.047, "hemoglobin": 0.038}
"""Relative error of sessions beyond that of the estimator on colors without noise.

Means of three faces of one calibration, see docs/validation/forecasts.md; its cause is unknown.
"""
MIXING_POWER = 1.6
"""Exponent of the model error's variance over pixel size, for pixels wider than `CONFIRM_PX` gives.

Large pixels mix different skin colors. Set on faces at 256 px width, see
docs/validation/forecasts.md.
"""


@dataclass(frozen=True, slots=True, eq=False)
class FlashObservation:
    """A face under full flash power as the cross-polarized camera records it, per superpixel."""

    melanin: Float64Array
    """(H, W) melanosome volume fraction, blurred by lateral scattering."""
    hemoglobin: Float64Array
    """(H, W) blood volume fraction, blurred by lateral scattering."""
    light: Float64Array
    """(H, W, 3) signal, fraction of full scale."""
    skin: BoolArray
    """(H, W)."""
    gain: float
    """Shot noise variance of a pixel at full scale."""
    floor: float
    """Variance of a pixel without light."""
    shares: Float64Array
    """(3,) ratio of a superpixel's variance to a sensor pixel's, per channel."""
    table: Any
    """Color table of the camera and the light, for errors within a face: with exact optics."""
    log_light_sd: float
    """Standard deviation of log illumination under the prior alone."""
    bias: Mapping[str, float]
    """Relative error that all pixels of the face share, by chromophore."""
    mixing: float = 1.0
    """Ratio of the model error's variance to that at `CONFIRM_PX` image width."""


def simulate_observation(
    rig: Rig, subject: str, *, seed: int = 0, width_px: int = WIDTH_PX
) -> FlashObservation:
    """Simulate the signal and the noise of a face through crossed polarizers.

    Parameters
    ----------
    rig
        The flash rig.
    subject, seed
        Preset and seed of the face, see `rigsim.subject.PRESETS`.
    width_px
        Image width, px; fewer pixels show the same face with the same noise per pixel.
    """
    small = rig.resized(width_px) if width_px < rig.views[0].width_px else rig
    view = small.views[0]
    scene = FlashScene(
        small, subject_file.load_subject(subject).face(seed=seed, size=TEXTURE_TEXELS), seed=seed
    )
    truth = scene.truth()
    chip = make_sensor(view)
    radiance = scene.radiance("crossed")
    light = radiance * vignetting_map(chip.vignetting, view.height_px, view.width_px)[..., None]
    bare = np.asarray(truth["mask"], bool) & (np.asarray(truth["melanin"]) > 0)
    table = color_table.build(
        view.spectral_sensitivity,
        small.lights[0].illuminant,
        anisotropy=ANISOTROPY_SKIN,
        exact_optics=True,
    )
    melanin, hemoglobin = (
        to_superpixels(np.asarray(truth[f"{name}_blurred"], np.float64), bare)
        for name in CHROMOPHORE_NAMES
    )
    skin = to_superpixels(bare.astype(np.float64)) == 1.0
    skin &= (melanin > 0) & (melanin <= table.c_m_max)
    skin &= (hemoglobin > 0) & (hemoglobin <= table.c_hd_max)
    gain, floor = chip.noise_profile(0.008)
    over_white = to_superpixels((radiance / scene.white_rgb()).astype(np.float64))
    bias = estimate_face_bias(over_white[skin], melanin[skin], hemoglobin[skin], small)
    return FlashObservation(
        melanin,
        hemoglobin,
        to_superpixels(light.astype(np.float64)),
        skin,
        gain,
        floor,
        _superpixel_variance_ratio(view.cfa),
        table,
        log_light_information(),
        bias,
        max(1.0, CONFIRM_PX / rig.views[0].width_px) ** MIXING_POWER,
    )


def estimate_face_bias(
    colors: Float64Array, melanin: Float64Array, hemoglobin: Float64Array, rig: Rig
) -> dict[str, float]:
    """Return the relative error that the pixels of a face share, by chromophore.

    It is the median over some pixels of the error of the estimator itself, without noise: of the
    optics that it infers from the face, of its color table and of its prior. `SESSION_BIAS` is
    added.

    Parameters
    ----------
    colors
        (n, 3) crossed-polarized light over that of a white reference.
    melanin, hemoglobin
        (n,) true volume fractions.
    rig
        The flash rig.
    """
    names = rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    table, prior = load_skin_colors(*names, has_white=True)
    step = max(1, len(colors) // BIAS_PIXELS)
    rgb = colors[::step].astype(np.float32)
    found = estimate_face(
        rgb,
        table,
        prior=prior,
        variance=np.square(BIAS_NOISE * rgb),
        model_error=model_error.load_covariance(),
        has_white=True,
    ).found
    bias = {}
    for name, truth in zip(CHROMOPHORE_NAMES, (melanin, hemoglobin), strict=True):
        ratio = getattr(found, name)[found.valid] / truth[::step][found.valid]
        bias[name] = SESSION_BIAS[name] + (float(np.median(ratio)) - 1.0 if ratio.size else 0.0)
    return bias


def log_light_information() -> float:
    """Return the standard deviation of log illumination from the prior's Fisher information.

    It is below that of the prior itself. The prior has a steep edge, as hardly any skin receives
    more light than a white reference at the same position.
    """
    prior = shading_prior.face_prior()
    # Fisher information of a shift of the density p(x): I = integral of p'(x)^2 / p(x) dx
    slope = np.gradient(prior.density, prior.step)
    return float(1.0 / np.sqrt(np.sum(slope**2 / prior.density) * prior.step))


def _superpixel_variance_ratio(pattern: str) -> Float64Array:
    """Return the ratio of a superpixel's variance to a sensor pixel's, by channel, (3,)."""
    frame = raw.RawFrame(
        cfa=np.full((8, 8), 500, np.uint16), pattern=pattern, black=(0.0,) * 4, white=1000
    )
    image = raw.linear_rgb(frame, demosaic="centered", gain=1.0, read_noise=0.0)
    return np.asarray(image.variance[2, 2] / (0.5 / 1000.0), np.float64)
