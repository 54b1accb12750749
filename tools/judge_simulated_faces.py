"""Judge the skin of simulated faces: borders of regions, colors over the face, slopes of relief.

    python tools/judge_simulated_faces.py [--seeds 2] [--size-px 256]

It prints three tables:

1. Per region, the 90th percentile of the gradient of log R_d at its border, over the 99th
   percentile elsewhere. It is the largest over bands and people. The limit is 1; the border of lips
   is anatomy and has none.
2. Per skin type, the part of `N_SPOTS` spots with lightness, chroma and hue within 1 to 99 % of
   measured skin, and within 5 to 95 %. Measured skin is of the same band of the typology angle. The
   limit of the first part is 95 %.
3. Per site of microrelief, the RMS slope over that of Beckmann facets that fit measured faces, and
   the distribution of its variance over wavelengths. The slope's limit is 20 %.

The exit status is 1 if a limit is missed.

References
----------
Weyrich et al. 2006, Analysis of human faces using a measurement-based skin reflectance model,
doi:10.1145/1141911.1141987.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter
from scipy.spatial import cKDTree

from model import skin_tone
from rigsim.skin_patch.microrelief import SITE_NAMES, SiteName, make_micro_skin
from rigsim.subject import make_subject
from rigsim.subject.face_regions import region_masks, to_mean_head
from rigsim.subject.person import SimulatedSubject
from rigsim.subject.person_skin import draw_tissue
from rigsim.subject.thickness import thickness_ratio
from rigsim.tissue.site_thickness import interpolate_thickness
from rigsim.tissue.skin_table import interpolate_spectra

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

TYPES = ("I", "II", "III", "IV", "V", "VI")
WAVELENGTH_NM = np.arange(400.0, 701.0, 20.0)
BANDS_NM = ((400.0, 500.0), (500.0, 600.0), (600.0, 701.0))
FRONT_MM = -60.0
"""Skin farther back is not judged: it is outside of most images."""
ANATOMICAL = "lips"
"""Region whose border is visible on real faces, too."""
SMOOTHING_PX = 1.0
MAX_STEP_MM = 3.0
"""Neighboring texels farther apart are of different parts of the face."""
N_SPOTS = 300
SPOT_RADIUS_MM = 4.0
"""Radius of the aperture of a spectrophotometer."""
MIN_INSIDE_PERCENT = 95.0
"""Of measured skin itself, 94 to 98 % is within 1 to 99 % of three quantities."""
BECKMANN_RANGE = (0.3, 0.35)
"""Roughness m of Beckmann facets, their RMS slope, of measured facial skin."""
SLOPE_TOLERANCE = 0.2
PERIODS_UM = (2000.0, 800.0, 400.0, 200.0, 100.0, 50.0, 20.0)


def skin_spectra(face: SimulatedSubject, seed: int) -> tuple[Mask, Floats]:
    """Return texels of bare skin, and their diffuse reflectance at `WAVELENGTH_NM`, (n, w)."""
    points = to_mean_head(face.atlas.position_mm, face.mesh)
    front = face.atlas.covered & (points[..., 2] > FRONT_MM)
    bare = binary_erosion(front, iterations=3) & (face.hair < 0.02)
    tissue = draw_tissue(seed)
    melanin, blood = (x[bare].astype(float) for x in (face.melanin, face.hemoglobin()))
    regions = {name: mask[bare] for name, mask in region_masks(points).items()}
    ratio = thickness_ratio(regions, tissue.site_contrast)
    found = interpolate_thickness(
        tissue, ratio, lambda skin: interpolate_spectra(melanin, blood, skin, WAVELENGTH_NM)
    )
    return bare, np.asarray(found)


def gradient_per_mm(values: Floats, valid: Mask, points_mm: Floats) -> Floats:
    """Return the change of a smoothed map to the next valid texels, per mm, (N, N)."""
    weight = gaussian_filter(valid.astype(float), SMOOTHING_PX)
    smooth = gaussian_filter(np.where(valid, values, 0.0), SMOOTHING_PX) / np.maximum(weight, 1e-9)
    square = np.zeros(valid.shape)
    for axis in (0, 1):
        away = np.linalg.norm(np.roll(points_mm, -1, axis) - points_mm, axis=-1)
        good = valid & np.roll(valid, -1, axis) & (away > 0.0) & (away < MAX_STEP_MM)
        rise = np.roll(smooth, -1, axis) - smooth
        square += np.where(good, rise / np.maximum(away, 1e-6), 0.0) ** 2
    return np.sqrt(square)


def judge_borders(face: SimulatedSubject, bare: Mask, spectra: Floats) -> dict[str, float]:
    """Return the gradient at the border of each region over that of the skin elsewhere."""
    points = face.atlas.position_mm.astype(float)
    masks = region_masks(to_mean_head(face.atlas.position_mm, face.mesh))
    borders = {n: bare & (mask > 0.25) & (mask < 0.75) for n, mask in masks.items()}
    own = bare & ~np.logical_or.reduce(list(borders.values()))
    away = masks[ANATOMICAL] < 0.01
    borders = {n: border & (away | (n == ANATOMICAL)) for n, border in borders.items()}
    worst: dict[str, float] = {}
    for low, high in BANDS_NM:
        band = (low <= WAVELENGTH_NM) & (high > WAVELENGTH_NM)
        log = np.zeros(bare.shape)
        log[bare] = np.log(spectra[:, band].mean(axis=1))
        steep = gradient_per_mm(log, bare, points)
        usual = np.percentile(steep[own], 99)
        for name, border in borders.items():
            if border.any():
                ratio = float(np.percentile(steep[border], 90) / usual)
                worst[name] = max(worst.get(name, 0.0), ratio)
    return worst


def judge_colors(
    face: SimulatedSubject, bare: Mask, spectra: Floats, rng: np.random.Generator
) -> Floats:
    """Return the farthest percentile of lightness, chroma and hue from 50, per spot, (n,)."""
    points = face.atlas.position_mm[bare].astype(float)
    lips = region_masks(to_mean_head(face.atlas.position_mm, face.mesh))["lips"][bare]
    spots = rng.choice(np.flatnonzero(lips < 0.05), N_SPOTS, replace=False)
    near = cKDTree(points).query_ball_point(points[spots], SPOT_RADIUS_MM)
    mean = np.array([spectra[rows].mean(axis=0) for rows in near])
    lab = skin_tone.lab_of_spectra(mean + skin_tone.sphere_specular(), WAVELENGTH_NM)
    hue, chroma = skin_tone.hue_chroma(lab)
    measured = skin_tone.measured_skin()
    far = []
    for number, one in enumerate(lab):
        band = skin_tone.ITA_BANDS[int(skin_tone.ita_band(skin_tone.ita(one))) - 1]
        values = {"lightness": one[0], "chroma": chroma[number], "hue_deg": hue[number]}
        ranks = [float(measured.rank(band, name, value)) for name, value in values.items()]
        far.append(np.abs(np.array(ranks) - 50.0).max())
    return np.array(far)


def judge_slopes(site: SiteName, seed: int) -> tuple[float, Floats]:
    """Return the RMS slope of a patch, and the parts of its variance between `PERIODS_UM`."""
    skin = make_micro_skin(site, seed=seed, size_mm=4.0)
    height = skin.height_um.astype(float)
    window = np.outer(*(np.hanning(n) for n in height.shape))
    power = np.abs(np.fft.fft2((height - height.mean()) * window)) ** 2
    per_um = np.hypot(
        np.fft.fftfreq(height.shape[0], skin.texel_um)[:, None],
        np.fft.fftfreq(height.shape[1], skin.texel_um)[None],
    )
    slope = power * per_um**2
    period = 1.0 / np.maximum(per_um, 1e-9)
    parts = [slope[(period <= a) & (period > b)].sum() for a, b in pairwise(PERIODS_UM)]
    rise = np.gradient(height, skin.texel_um)
    return float(np.sqrt(np.mean(rise[0] ** 2 + rise[1] ** 2))), np.array(parts) / slope.sum()


def main() -> int:
    """Print the tables; return 1 if a limit is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--size-px", type=int, default=256)
    asked = parser.parse_args()
    missed = False
    borders: dict[str, float] = {}
    print("type | spots within 1 to 99 % | within 5 to 95 %")
    for preset in TYPES:
        far = []
        for seed in range(asked.seeds):
            face = make_subject(preset, seed=seed, size=asked.size_px)
            bare, spectra = skin_spectra(face, seed)
            for name, ratio in judge_borders(face, bare, spectra).items():
                borders[name] = max(borders.get(name, 0.0), ratio)
            far.append(judge_colors(face, bare, spectra, np.random.default_rng(seed)))
        spots = np.concatenate(far)
        inside = [100.0 * float(np.mean(spots <= limit)) for limit in (49.0, 45.0)]
        missed |= inside[0] < MIN_INSIDE_PERCENT
        print(f"{preset} | {inside[0]:.1f} % | {inside[1]:.1f} %", flush=True)
    print("region | gradient of log R_d at its border over that of other skin")
    for name, ratio in sorted(borders.items(), key=lambda item: -item[1]):
        missed |= ratio >= 1.0 and name != ANATOMICAL
        print(f"{name} | {ratio:.2f}")
    print(f"site | RMS slope | over Beckmann | variance between {PERIODS_UM} um, %")
    for site in SITE_NAMES:
        found = [judge_slopes(site, seed) for seed in range(asked.seeds)]
        rms = float(np.mean([slope for slope, _ in found]))
        parts = np.mean([parts for _, parts in found], axis=0)
        nearest = float(np.clip(rms, *BECKMANN_RANGE))
        missed |= abs(rms / nearest - 1.0) > SLOPE_TOLERANCE
        shown = ", ".join(f"{100.0 * part:.0f}" for part in parts)
        print(f"{site} | {rms:.3f} | {rms / nearest:.2f} | {shown}")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
