"""Judge the flash rig's intervals on voxels of people whose optics differ as skins in papers do.

    python tools/judge_reference_people.py SEED COUNT

People are drawn by ``tools/make_independent_skins.py``: nothing in the package assumes their laws,
and ranges are those of publications. Mitsuba's `tissue` renders each as voxels under the flashes.
The patches of ``skinrig bench --stage reference-world`` are of people that the simulator draws,
whose optics differ by a tenth of those ranges.
"""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from math import atan2, degrees, pi

import numpy as np
from make_independent_skins import coefficients, draw_skin

from capture.rig import load_rig
from model import spectra
from reconstruction.chromophores.shading_prior import LOG_SHADING_SOFTNESS
from reconstruction.pipeline.flash.stages import load_skin_colors
from rigsim.scenes.reference.flat_layers import describe_flat_layers, render_voxels
from rigsim.scenes.reference.patch import SMOOTH_ROUGHNESS, PatchImage, fast_shading
from rigsim.tissue.skin_layers import ETA, SKIN_ANISOTROPY
from rigsim.tissue.tissue_mc import Layer, LayerStack
from skinrig.benchmarks.flash_rig.independent_skin import MELANOSOME_550_PER_MM
from skinrig.benchmarks.simulation.reference_world import estimate_patch, ramp_shading

WAVELENGTH_NM = np.arange(400.0, 701.0, 20.0)
SAMPLES = 64
WIDTH_PX = 16
IMAGE_NOISE = 0.01


def render_color(
    skin: dict[str, float], light_deg: float, weights: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return white-balanced color over a white reference, and its relative noise, (3,) each."""
    rgb = np.zeros((64, 3))
    for band, wavelength_nm in enumerate(WAVELENGTH_NM.tolist()):
        epidermis, dermis, reduced = coefficients(skin, wavelength_nm)
        scattering = reduced / (1.0 - SKIN_ANISOTROPY)
        stack = LayerStack(
            (
                Layer(skin["epidermis_mm"], epidermis, scattering, SKIN_ANISOTROPY, ETA),
                Layer(math.inf, dermis, scattering, SKIN_ANISOTROPY, ETA),
            )
        )
        scene = describe_flat_layers(stack, alpha=SMOOTH_ROUGHNESS, light_deg=light_deg)
        image = render_voxels(scene, samples=SAMPLES, seed=len(WAVELENGTH_NM) * seed + band)
        found = pi * image[..., -1].ravel() / math.cos(math.radians(light_deg))
        rgb += found[:, None] * weights[band]
    mean = rgb.mean(axis=0)
    return mean, rgb.std(axis=0, ddof=1) / math.sqrt(len(rgb)) / mean


def main(seed: int, count: int) -> None:
    """Print error and coverage per shading and chromophore."""
    rig = load_rig("flash")
    view, illuminant = rig.views[0], rig.lights[0].illuminant
    weights = spectra.band_weights(view.spectral_sensitivity, illuminant, WAVELENGTH_NM)
    colors = load_skin_colors(view.spectral_sensitivity, illuminant, has_white=True)
    light = ramp_shading(colors[1], WIDTH_PX)
    x, _, z = rig.lights[0].position_mm
    angle = degrees(atan2(abs(x), z))
    rng = np.random.default_rng(seed)
    found, noises = defaultdict(list), []
    for number in range(count):
        skin = draw_skin(number, rng)
        color, noise = render_color(skin, angle, weights, seed=count * seed + number)
        noises.append(noise)
        depth = skin["c_m"] * skin["epidermis_mm"] * MELANOSOME_550_PER_MM
        shape = (WIDTH_PX, WIDTH_PX, 3)
        rgb = color * (1.0 + IMAGE_NOISE * rng.standard_normal(shape))
        image = PatchImage(rgb, np.broadcast_to((IMAGE_NOISE * color) ** 2, shape))
        truths = [
            np.full(shape[:2], part)
            for part in (depth / colors[0].constants.melanin_depth_factor, skin["c_hd"])
        ]
        # a face off the white reference's position has other light than the reference
        step = np.random.default_rng([seed, number]).standard_normal()
        off = light * math.exp(LOG_SHADING_SOFTNESS * step)
        for place, lit in (("", light), (", off the position", off)):
            given = image, fast_shading(rig), lit, colors, *truths
            for (shading, name), one in estimate_patch(*given).items():
                if shading == "free" or not place:
                    found[shading + place, name].append(one)
        print(number, np.round(color, 3), file=sys.stderr, flush=True)
    print(f"noise of a color, %: {100 * float(np.mean(noises)):.2f}")
    for (shading, name), people in found.items():
        valid = [one for one in people if one.valid > 0.0]
        print(
            f"{shading} {name}: n {len(valid)} of {count}, "
            f"median error {np.median([one.error for one in valid]):.0f} %, "
            f"median ratio {np.median([one.bias for one in valid]):.2f}, coverage "
            f"{100 * np.mean([one.coverage for one in valid]):.0f}; "
            f"{100 * np.mean([one.wide_coverage for one in valid]):.0f} %"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
