"""Simulated observation of a face by the flash rig's cross-polarized camera."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from capture import raw
from capture.rig import Rig
from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import shading_prior
from rigsim.population import files as subject_file
from rigsim.scenes.flash.scene import FlashScene
from rigsim.sensor import make_sensor, vignetting_map
from skinrig.arrays import BoolArray, Float64Array
from skinrig.simulating.flash_truth import to_superpixels

CHROMOPHORE_NAMES = ("melanin", "hemoglobin")
TEXTURE_TEXELS = 512
"""Side of the face's texture: finer than what the forecast's pixels show."""
WIDTH_PX = 256
"""Pixels across the face that the forecast looks at, each as noisy as one of the whole camera."""
CONFIRM_PX = 640
"""Pixels across that are simulated: coarser ones mix the colors of different skin."""
MIXING_POWER = 2.4
"""The model error's variance grows so with the size of pixels wider than these, which mix the
colors of different skin: at 320 across its share of the errors of three faces was 2 to 2.8 times
that at 640."""


@dataclass(frozen=True, slots=True, eq=False)
class FlashObservation:
    """What the crossed camera sees of a face at full power, by superpixels."""

    melanin: Float64Array
    """(H, W) volume fraction, as the light's spreading leaves it to be seen."""
    hemoglobin: Float64Array
    """(H, W)."""
    light: Float64Array
    """(H, W, 3) fraction of full scale."""
    skin: BoolArray
    """(H, W)."""
    gain: float
    """Variance of a pixel of full scale by its photons."""
    floor: float
    """Variance of a pixel without light."""
    shares: Float64Array
    """(3,) variance of a superpixel's channels over that of a sensor's pixel."""
    table: Any
    """Color table of the camera and the light."""
    light_spread: float
    """Standard error of log light that the prior of faces alone would leave."""
    mixing: float = 1.0
    """Variance of the model error over that of pictures `CONFIRM_PX` across."""


def simulate_observation(
    rig: Rig, subject: str, *, seed: int = 0, width_px: int = WIDTH_PX
) -> FlashObservation:
    """Look at a simulated face through the crossed polarizers.

    Parameters
    ----------
    rig
        The flash rig.
    subject, seed
        The face, see `rigsim.subject.PRESETS`.
    width_px
        Pixels across; fewer see the same face with the same noise a pixel.
    """
    small = rig.resized(width_px) if width_px < rig.views[0].width_px else rig
    view = small.views[0]
    scene = FlashScene(
        small, subject_file.load_subject(subject).face(seed=seed, size=TEXTURE_TEXELS), seed=seed
    )
    truth = scene.truth()
    chip = make_sensor(view)
    light = (
        scene.radiance("crossed")
        * vignetting_map(chip.vignetting, view.height_px, view.width_px)[..., None]
    )
    bare = np.asarray(truth["mask"], bool) & (np.asarray(truth["melanin"]) > 0)
    table = color_table.build(
        view.spectral_sensitivity, small.lights[0].illuminant, anisotropy=ANISOTROPY_SKIN
    )
    melanin, hemoglobin = (
        to_superpixels(np.asarray(truth[f"{name}_blurred"], np.float64), bare)
        for name in CHROMOPHORE_NAMES
    )
    skin = to_superpixels(bare.astype(np.float64)) == 1.0
    skin &= (melanin > 0) & (melanin <= table.c_m_max)
    skin &= (hemoglobin > 0) & (hemoglobin <= table.c_hd_max)
    gain, floor = chip.noise_profile(0.008)
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
        max(1.0, CONFIRM_PX / rig.views[0].width_px) ** MIXING_POWER,
    )


def log_light_information() -> float:
    """Return the standard deviation of the log of a pixel's light by the prior's information.

    It is below that of the prior itself: the prior has a steep edge, as hardly any skin gets more
    light than a white reference in its place.
    """
    prior = shading_prior.face_prior()
    # Fisher information of a shift of the density p(x): I = integral of p'(x)^2 / p(x) dx
    slope = np.gradient(prior.density, prior.step)
    return float(1.0 / np.sqrt(np.sum(slope**2 / prior.density) * prior.step))


def _superpixel_variance_ratio(pattern: str) -> Float64Array:
    """Return the variance of superpixels over that of the sensor's pixels, by channel, (3,)."""
    frame = raw.RawFrame(
        cfa=np.full((8, 8), 500, np.uint16), pattern=pattern, black=(0.0,) * 4, white=1000
    )
    image = raw.linear_rgb(frame, demosaic="centered", gain=1.0, read_noise=0.0)
    return np.asarray(image.variance[2, 2] / (0.5 / 1000.0), np.float64)
