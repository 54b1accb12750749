"""Simulated observation of a face by the flash rig's cross-polarized camera."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture import raw
from capture.rig import Rig
from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores.face import estimate_face
from reconstruction.pipeline.flash.stages import MIN_SIGNAL_SIGMAS, load_skin_colors
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
    shares, signal = _superpixel_variance_ratio(view.cfa), to_superpixels(light.astype(np.float64))
    over_white = to_superpixels((radiance / scene.white_rgb()).astype(np.float64))
    # one frame at full power, less one dark frame
    noise = np.sqrt((gain * np.maximum(signal, 0.0) + 2.0 * floor) * shares)
    with np.errstate(divide="ignore", invalid="ignore"):
        noise *= np.where(signal > 0.0, over_white / signal, np.inf)
    truth_of = {"melanin": melanin, "hemoglobin": hemoglobin}
    bias = estimate_face_bias(over_white, noise, truth_of, skin, small)
    return FlashObservation(
        melanin,
        hemoglobin,
        signal,
        skin,
        gain,
        floor,
        shares,
        table,
        log_light_information(),
        bias,
        max(1.0, CONFIRM_PX / rig.views[0].width_px) ** MIXING_POWER,
    )


def estimate_face_bias(
    colors: Float64Array,
    noise: Float64Array,
    truth: Mapping[str, Float64Array],
    skin: BoolArray,
    rig: Rig,
) -> dict[str, float]:
    """Return the relative error that the pixels of a face share, by chromophore.

    It is the median over the skin of the error of the estimator itself, on the image without noise:
    of the optics that it infers from the face, of its color table and of its prior. As in a
    session, the estimator gets all pixels with enough signal, also those at outlines and of lips.

    Parameters
    ----------
    colors
        (H, W, 3) crossed-polarized light over that of a white reference.
    noise
        (H, W, 3) standard deviation of `colors`, for the estimator's weights.
    truth
        (H, W) true volume fractions by chromophore.
    skin
        (H, W) pixels to compare.
    rig
        The flash rig.
    """
    names = rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    table, prior = load_skin_colors(*names, has_white=True)
    usable = np.asarray((colors > MIN_SIGNAL_SIGMAS * noise).all(axis=-1), np.bool_)
    rgb = np.where(usable[..., None], colors, np.nan).astype(np.float32)
    variance = np.where(usable[..., None], np.square(noise), 0.0)
    errors = model_error.image_covariance(np.nan_to_num(rgb), variance, usable)
    given: dict[str, Any] = {"prior": prior, "variance": variance, "model_error": errors}
    found = estimate_face(rgb, table, **given, has_white=True).found
    good = skin & found.valid
    return {
        name: float(np.median(getattr(found, name)[good] / truth[name][good])) - 1.0
        if good.any()
        else 0.0
        for name in CHROMOPHORE_NAMES
    }


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
