"""Make model/data/optics_uncertainty.npz: derivatives of skin's spectra and measured residuals.

    python tools/make_optics_uncertainty.py [SPECTRA]

Derivatives of log reflectance by the parameters of `model.tissue_optics.uncertainty` are central
differences of adding-doubling, over one standard deviation to both sides, at constant
melanin optical depth at 550 nm.

SPECTRA is the workbook of the International Skin Spectra Archive (Lu et al. 2025,
doi:10.1038/s41597-025-04857-5, CC BY 4.0), or the environment variable SKIN_SPECTRA names it. Half
of its subjects set the residuals: those with an even SHA-256 hash of "2025:origin-subject". The
specular reflection at the sphere, F(0) at 1.4, is subtracted. Per band of the individual typology
angle, up to 600 spectra are fitted with melanin, blood and the nuisance parameters under their
priors; the residuals' covariance is estimated by expectation maximization and stored as factors.
Without SPECTRA, the stored residuals stay.
"""

from __future__ import annotations

import itertools
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree

from model import spectra
from model.color_table import spectral_axes
from model.fresnel import ETA_SKIN, normal_reflectance
from model.tissue_optics import SKIN_CONSTANTS, two_layer_reflectance
from model.tissue_optics import uncertainty as optics_uncertainty
from model.tissue_optics.layers import ANISOTROPY_SKIN
from model.tissue_optics.uncertainty import NUISANCE_PARAMETERS
from skinrig.benchmarks.flash_rig.independent_skin import sets_residuals

NODES = 17
BANDS_DEG = (np.inf, 55.0, 41.0, 28.0, 10.0, -30.0, -np.inf)
PER_BAND = 600
FACTORS = 6
DARKEST = 0.005
"""Reflectance without the specular part below which a spectrum is not used.

The subtraction's relative error dominates there (5 % of type VI, 0.6 % of V).
"""
TARGET = Path(__file__).resolve().parents[1] / "model/data" / optics_uncertainty.DATA_FILE


def log_gradient() -> tuple[np.ndarray, np.ndarray]:
    """Return log reflectance (n, n, 31) and its derivatives (n, n, nuisances, 31)."""
    u, v = spectral_axes(NODES)
    c_m, c_hd = u[:, None] ** 3, v[None, :] ** 3

    def log_reflectance(constants):
        ratio = SKIN_CONSTANTS.melanin_depth_factor / constants.melanin_depth_factor
        found = two_layer_reflectance(
            spectra.WAVELENGTH_NM,
            np.minimum(c_m * ratio, 1.0),
            c_hd,
            constants=constants,
            anisotropy=ANISOTROPY_SKIN,
            directions=16,
        )
        return np.log(found)

    found = []
    for nuisance in NUISANCE_PARAMETERS:
        usual = getattr(SKIN_CONSTANTS, nuisance.name)
        ends = [usual * np.exp(s * nuisance.sd) for s in (-1, 1)]
        if not nuisance.is_log:
            ends = [usual - nuisance.sd, usual + nuisance.sd]
        if nuisance.name in ("oxygenation", "eumelanin_fraction"):
            ends = np.clip(ends, 0.0, 1.0)
        low, high = (
            log_reflectance(replace(SKIN_CONSTANTS, **{nuisance.name: float(end)})) for end in ends
        )
        step = np.log(ends[1] / ends[0]) if nuisance.is_log else ends[1] - ends[0]
        found.append((high - low) / step)
        print(f"{nuisance.name}: standard deviation {nuisance.sd:.3f}", file=sys.stderr)
    return log_reflectance(SKIN_CONSTANTS), np.stack(found, axis=2)


def read_spectra(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return reflectances (n, 31) at 400 to 700 nm, specular included, and subject names (n,)."""
    if path.suffix == ".npz":
        with np.load(path) as stored:
            return stored["reflectance"][:, 4:35], stored["subject"]
    import openpyxl

    sheet = openpyxl.load_workbook(path, read_only=True)["ISSA"]
    reflectance, subjects = [], []
    for row in sheet.iter_rows(min_row=13, values_only=True):
        if isinstance(row[0], int | float):
            cells = [x / 100.0 if isinstance(x, int | float) else np.nan for x in row[17:48]]
            reflectance.append(cells)
            subjects.append(f"{row[1]}-{row[2]}")
    return np.array(reflectance, np.float64), np.array(subjects)


class LinearModel:
    """Log spectra and their derivatives, interpolated in the cube roots of the fractions."""

    def __init__(self, log_r, gradient):
        self.u, self.v = spectral_axes(len(log_r))
        flat = np.concatenate([log_r[:, :, None], gradient], axis=2)
        self.shape = flat.shape[2:]
        flat = flat.reshape(*flat.shape[:2], -1)
        self.splines = [
            RectBivariateSpline(self.u, self.v, flat[..., k]) for k in range(flat.shape[2])
        ]

    def evaluate(self, x):
        """Return the spectrum (n, 31), and its derivatives by both axes and the nuisances."""
        values = np.stack([s.ev(*x.T) for s in self.splines], -1).reshape(-1, *self.shape)
        head = self.splines[: self.shape[1]]
        by = [np.stack([s.ev(*x.T, dx=1 - k, dy=k) for s in head], -1) for k in (0, 1)]
        return values[:, 0], np.stack(by, -1), np.moveaxis(values[:, 1:], 1, 2)

    def fit(self, seen, prior, noise, steps):
        """Return posterior means and the joint covariance of axes and nuisances, residuals."""
        a, b = np.meshgrid(np.linspace(0.1, self.u[-1], 30), np.linspace(0.05, self.v[-1], 30))
        starts = np.stack([a.ravel(), b.ravel()], axis=-1)
        x = starts[cKDTree(self.evaluate(starts)[0]).query(seen)[1]].copy()
        for _ in range(steps):
            value, by_x, by_nuisance = self.evaluate(x)
            total = by_nuisance @ prior @ np.swapaxes(by_nuisance, 1, 2) + noise
            weighted = np.swapaxes(by_x, 1, 2) @ np.linalg.inv(total)
            force = weighted @ (seen - value)[..., None]
            step = np.linalg.solve(weighted @ by_x + 1e-9 * np.eye(2), force)[..., 0]
            x = np.clip(x + np.clip(step, -0.08, 0.08), [0.05, 0.03], [self.u[-1], self.v[-1]])
        value, by_x, by_nuisance = self.evaluate(x)
        total = by_nuisance @ prior @ np.swapaxes(by_nuisance, 1, 2) + noise
        gain = prior @ np.swapaxes(by_nuisance, 1, 2) @ np.linalg.inv(total)
        off = (seen - value)[..., None]
        residual = (off - by_nuisance @ (gain @ off))[..., 0]
        both = np.concatenate([by_x, by_nuisance], axis=2)
        information = np.swapaxes(both, 1, 2) @ np.linalg.inv(noise) @ both
        information[:, 2:, 2:] += np.linalg.inv(prior)
        spread = np.linalg.inv(information + 1e-9 * np.eye(both.shape[2]))
        return residual, both @ spread @ np.swapaxes(both, 1, 2)


def residual_factors(path: Path, log_r, gradient) -> tuple[np.ndarray, np.ndarray]:
    """Return factors (bands, FACTORS, 31) of the residuals' covariances, and the bands' angles."""
    reflectance, subjects = read_spectra(path)
    specular = normal_reflectance(ETA_SKIN)
    usable = np.isfinite(reflectance).all(axis=1)
    usable &= np.nan_to_num(reflectance).min(axis=1) > specular + DARKEST
    usable &= np.array([sets_residuals(str(s)) for s in subjects])
    reflectance = reflectance[usable]
    angle = optics_uncertainty.typology_angle(reflectance)
    model = LinearModel(log_r, gradient)
    prior = np.diag([n.sd**2 for n in NUISANCE_PARAMETERS])
    rng = np.random.default_rng(0)
    factors, angles = [], []
    for high, low in itertools.pairwise(BANDS_DEG):
        of_band = np.flatnonzero((angle <= high) & (angle > low))
        chosen = rng.choice(of_band, min(PER_BAND, of_band.size), replace=False)
        seen = np.log(reflectance[chosen] - specular)
        noise = 1e-4 * np.eye(31)
        for turn in range(8):
            off, unknown = model.fit(seen, prior, noise, steps=10 if turn == 0 else 6)
            noise = (off[:, :, None] * off[:, None, :] + unknown).mean(axis=0)
            noise = 0.5 * (noise + noise.T) + 1e-7 * np.eye(31)
        variances, axes = np.linalg.eigh(noise)
        factors.append((axes * np.sqrt(variances)).T[::-1][:FACTORS])
        angles.append(float(np.median(angle[of_band])))
        kept = variances[::-1][:FACTORS].sum() / variances.sum()
        rms = np.sqrt(np.trace(noise) / 31)
        print(
            f"angle {angles[-1]:.0f}: {chosen.size} spectra, residual {rms:.4f}, kept {kept:.3f}",
            file=sys.stderr,
        )
    return np.array(factors), np.array(angles)


def main() -> None:
    log_r, gradient = log_gradient()
    given = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("SKIN_SPECTRA")
    if given:
        factors, angles = residual_factors(Path(given), log_r, gradient)
    else:
        with np.load(TARGET) as stored:
            factors, angles = stored["residual_factors"], stored["typology_angle_deg"]
    np.savez_compressed(
        TARGET,
        log_gradient=gradient.astype(np.float16),
        residual_factors=factors.astype(np.float32),
        typology_angle_deg=angles,
    )
    print(f"{TARGET}: {TARGET.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
