"""Make model/data/photon_table.npz: reflectance around a beam on semi-infinite turbid media.

Run from the repository root, ``python tools/make_photon_table.py WORK`` with a folder for
intermediate results; each asymmetry g and collection is one checkpoint there, and existing
checkpoints make up the table. See `main` for options.

White Monte Carlo with sigma_s' = 1 and no absorption: photons are histogrammed over radius and path
length L, and absorption is applied afterwards as exp(-sigma_a L). Variance reduction:

- One walk serves all refractive indices. The largest one drives it, as it reflects most;
  the photon carries relative weights for the others, multiplied by the ratio of the Fresnel
  reflectances at every hit of the surface.
- Photons that are far out for their path length are split; long ones and those near the middle of
  the cloud are thinned by roulette. The importance is diffusion's exp(-3 r^2/(4 L)) to the power
  0.6, so that large radii and strong absorption get as many photons as weak absorption.
- At the surface the expected transmittance is scored instead of a random choice.
- "fiber": each shallow collision scores what it sends directly into the fiber's cone (next-event
  estimation), in one direction drawn inside the cone.
- Paths longer than 3000 transport lengths are continued by the diffusion's L^(-5/2) law, whose
  constant is taken from the last factor of two of the histogram.

- Near the source few photons go into a fiber's cone where the phase function is narrow. For g = 0.9
  and 0.95 paths up to 4 transport lengths are traced separately by 8 and 16 times the photons.
- Splines over the rings, as smooth as predicts half of the batches from the others best. Fibers are
  fitted as the quotient over light of all directions, which changes slowly far from the source.

Tracing takes 20 minutes of one busy core, the table another half minute. It is the same for any
machine of IEEE arithmetic up to the last digits of its exp, log and sqrt: one thread, fixed seeds.
A walk's photons, for each collection: 8 million for g = 0.8; 4 for 0.7 and 0.9; 1.6 for 0.95; 2.6
for 0, 0.3 and 0.5. Standard errors (median over 0.3 to 10 transport lengths, sigma_a up to 0.3
sigma_s', from leaving batches out; about twice that at 0.05 to 0.3):

    g       0      0.3    0.5    0.7    0.8    0.9    0.95
    all     0.25   0.28   0.30   0.22   0.14   0.22   0.29 %
    fiber   0.18   0.18   0.20   0.24   0.20   0.33   0.73 %

`tools/photon_walk.py` has the sampler.
"""

from __future__ import annotations

import argparse
import time
from itertools import product
from math import exp, log, pi, sqrt
from pathlib import Path

import numpy as np
from photon_walk import (
    ETAS,
    LATE_BIN,
    LOG_PATH_START,
    LOG_PATH_STEP,
    LOG_RADIUS_START,
    LOG_RADIUS_STEP,
    PATH_BINS,
    PATH_END,
    RADIUS_BINS,
    SHORT_BIN,
    absorb,
    radius_edges,
    walk,
)
from scipy.interpolate import BSpline

from model.photon_table import kernels
from model.photon_table.medium import asymptotic_decay, root_spline_matrix

COLLECTIONS = ("all", "fiber")
# Photons per batch: about equal times except for g = 0 and 0.5, which need fewer.
PHOTONS = {
    0.8: 250_000,
    0.9: 125_000,
    0.95: 50_000,
    0.7: 125_000,
    0.5: 80_000,
    0.0: 80_000,
    0.3: 80_000,
}
# Near the source few photons go into a fiber's cone where the phase function is narrow: paths up to
# 4 transport lengths are traced again, by so many photons, instead.
SHORT_PHOTONS = {0.9: 1_000_000, 0.95: 800_000}
BATCHES = 32
ROOT_ABSORPTIONS = 0.1 * np.expm1(np.linspace(0.0, log(41.0), 25))  # 0 to 4: sigma_a <= 16
RELIABLE = 0.15  # largest relative error of a ring that is used
FOLDS = 8  # of the jackknife
MODEL_ERROR = 5e-4  # of the splines themselves, relative


def simulate(folder, g, collection, photons, batches):
    """Trace the missing ones of `batches` batches of `photons`, keeping each in `folder`."""
    name = folder / f"g{g:g}-{collection}-{photons}.npz"
    rings, late = [], []
    seconds = 0.0
    if name.exists():
        with np.load(name) as stored:
            rings, late = list(stored["rings"]), list(stored["late"])
            seconds = float(stored["seconds"])
    for batch in range(len(rings), batches):
        entropy = (19, round(100 * g), COLLECTIONS.index(collection), batch)
        seed = np.random.SeedSequence(entropy).generate_state(3, np.uint64)
        hist = np.zeros((ETAS.size, RADIUS_BINS, PATH_BINS, 2))
        start = time.process_time()
        walk(photons, seed, g, collection == "fiber", ETAS, PATH_END, hist)
        more = SHORT_PHOTONS.get(g, 0) if collection == "fiber" else 0
        if more:
            short = np.zeros_like(hist)
            seed = np.random.SeedSequence((*entropy, 1)).generate_state(3, np.uint64)
            end = exp(LOG_PATH_START + LOG_PATH_STEP * SHORT_BIN)
            walk(more, seed, g, True, ETAS, end, short)
            hist[:, :, :SHORT_BIN] = short[:, :, :SHORT_BIN] * (photons / more)
        seconds += time.process_time() - start
        rings.append(absorb(hist, ROOT_ABSORPTIONS**2) / photons)
        late.append(hist[:, :, LATE_BIN:, 0].sum(axis=(1, 2)) / photons)
        part = name.with_suffix(".part.npz")
        np.savez(part, rings=rings, late=late, seconds=seconds)
        part.replace(name)
    print(f"{name.name}: {len(rings)} x {photons} photons, {seconds:.0f} s", flush=True)


def continued(stored, batches):
    """Return mean and standard error of R on (etas, rings, absorptions) over some batches.

    The L^(-5/2) law of paths beyond PATH_END is in the mean; its constant is that of all batches.
    """
    edges = radius_edges()
    area = pi * np.diff(edges**2)
    centre2 = 0.5 * (edges[1:] ** 2 + edges[:-1] ** 2)
    start = exp(LOG_PATH_START + LOG_PATH_STEP * LATE_BIN)
    node, weight = np.polynomial.legendre.leggauss(64)
    node, weight = 0.5 * (node + 1.0), 0.5 * weight
    path = start + (PATH_END - start) * node
    inside = path**-1.5 * 4.0 / 3.0 * pi * -np.expm1(-0.75 * edges[-1] ** 2 / path)
    law = stored["late"].mean(axis=0) / ((PATH_END - start) * weight @ inside)
    root = node / sqrt(PATH_END)  # L = root^-2, L^-5/2 dL = 2 root^2 droot
    shape = np.exp(
        -0.75 * centre2[:, None, None] * root**2 - ROOT_ABSORPTIONS[:, None] ** 2 / root**2
    )
    late = shape @ (2.0 * root**2 * weight / sqrt(PATH_END))
    rings = stored["rings"][batches] / area[:, None]
    mean = rings.mean(axis=0) + law[:, None, None] * late
    error = rings.std(axis=0, ddof=1) / sqrt(len(rings))
    return mean, error


def basis(x):
    """Return the B-splines over ln(r) at x, shape (..., RADIUS_COUNT)."""
    p = (np.asarray(x) - kernels.RADIUS_START) / kernels.RADIUS_STEP
    knots = np.arange(-3, kernels.RADIUS_COUNT + 1)
    return BSpline.design_matrix(p.ravel(), knots.astype(float), 3, extrapolate=True).toarray()


def reference(x, kappa):
    """Return ln of the diffusion profile to which the table is relative."""
    d = np.sqrt(np.exp(2.0 * x) + 1.0)
    return np.log1p(kappa * d) - 3.0 * np.log(d) - kappa * d


def reliable(error):
    """Return a smoothed copy of the rings' relative errors, and a mask of reliable rings."""
    smooth = error.copy()
    for shift in (1, 2):
        smooth[shift:-shift] = np.exp(
            (
                np.log(smooth[: -2 * shift])
                + np.log(smooth[shift:-shift])
                + np.log(smooth[2 * shift :])
            )
            / 3.0
        )
    return smooth, (smooth < RELIABLE) & (error < 2.0 * RELIABLE)


def fit(mean, error, kappa, roughness, near=None):
    """Fit one profile: spline coefficients of ln(R/reference), and the rings used.

    Differences of the slope between knots are taken as drawn from N(0, roughness); beyond six
    transport lengths those of the value from N(0, 0.04), which continues the profile by the
    diffusion's law where photons end. Or, with the coefficients `near` of a profile of light of
    all directions, those of the two profiles' quotient, and N(0, 0.015) beyond three transport
    lengths: the directions of the light change little from there on.
    """
    edges = LOG_RADIUS_START + LOG_RADIUS_STEP * np.arange(RADIUS_BINS + 1)
    centre = 0.5 * (edges[1:] + edges[:-1])
    node, weight = np.polynomial.legendre.leggauss(4)
    inner = centre[:, None] + 0.5 * LOG_RADIUS_STEP * node
    ring_weight = weight * np.exp(2.0 * (inner - centre[:, None]))
    ring_weight /= ring_weight.sum(axis=1, keepdims=True)
    safe = np.maximum(mean, 1e-300)
    relative, used = reliable(np.where(error > 0.0, np.maximum(error / safe, 1e-4), 10.0))
    bend = np.diff(np.eye(kernels.RADIUS_COUNT), 2, axis=0) / roughness
    knots = kernels.RADIUS_START + kernels.RADIUS_STEP * np.arange(kernels.RADIUS_COUNT - 1)
    start, drift = (6.0, 0.04) if near is None else (3.0, 0.015)
    far = np.diff(np.eye(kernels.RADIUS_COUNT), axis=0)[knots > log(start)] / drift
    penalty = bend.T @ bend + far.T @ far
    drawn = 0.0 if near is None else penalty @ near
    design, inner_design = basis(centre), basis(inner).reshape(*inner.shape, -1)
    correction = np.zeros(centre.size)  # ln of a ring's mean over the value at its center
    log_reference = reference(centre, kappa)
    for _ in range(3):
        target = np.log(safe) - log_reference - correction
        weighted = (design / relative[:, None] ** 2)[used]
        coefficients = np.linalg.solve(
            weighted.T @ design[used] + penalty, weighted.T @ target[used] + drawn
        )
        shape = reference(inner, kappa) - log_reference[:, None]
        shape += inner_design @ coefficients - (design @ coefficients)[:, None]
        correction = np.log(np.sum(ring_weight * np.exp(shape), axis=1))
    return coefficients, used


def profiles(stored, batches, kappas, roughness, near=None):
    """Fit all profiles of some batches: coefficients (etas, radii, roots), and rings used."""
    mean, error = continued(stored, batches)
    out = np.empty((ETAS.size, kernels.RADIUS_COUNT, ROOT_ABSORPTIONS.size))
    used = np.empty(mean.shape, bool)
    for e, k in np.ndindex(ETAS.size, ROOT_ABSORPTIONS.size):
        out[e, :, k], used[e, :, k] = fit(
            mean[e, :, k],
            error[e, :, k],
            kappas[k],
            roughness,
            None if near is None else near[e, :, k],
        )
    return out, used


def choose_roughness(stored, kappas, near=None):
    """Return the roughness whose fits to one half of the batches predict the other half best."""
    count = len(stored["rings"])
    halves = np.arange(0, count, 2), np.arange(1, count, 2)
    centre = LOG_RADIUS_START + LOG_RADIUS_STEP * (np.arange(RADIUS_BINS) + 0.5)
    best = (np.inf, 0.0)
    for roughness in (0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2):
        loss = 0.0
        for first, second in (halves, halves[::-1]):
            mean, error = continued(stored, second)
            mean_first, error_first = continued(stored, first)
            for e, k in product((0, 4), range(0, ROOT_ABSORPTIONS.size, 3)):
                fitted, used = fit(
                    mean_first[e, :, k],
                    error_first[e, :, k],
                    kappas[k],
                    roughness,
                    None if near is None else near[e, :, k],
                )
                # ring mean over center value is nearly the same for all smooth profiles
                other, used_too = fit(mean[e, :, k], error[e, :, k], kappas[k], 1.0)
                both = used & used_too
                relative = (error / np.maximum(mean, 1e-300))[e, both, k]
                gap = (basis(centre) @ (fitted - other))[both]
                loss += np.sum((gap / np.maximum(relative, 1e-4)) ** 2)
        print(f"  roughness {roughness}: {loss:.0f}", flush=True)
        best = min(best, (loss, roughness))
    return best[1]


def tabulate(pair, g):
    """Return for both collections spline coefficients (etas, radii, roots) and ln of errors.

    The errors are given at every other knot.
    """
    kappas = np.array([0.0, *(asymptotic_decay(u * u, g) for u in ROOT_ABSORPTIONS[1:])])
    folds = [slice(None)]
    folds += [np.arange(BATCHES) % FOLDS != fold for fold in range(FOLDS)]
    nears = [None] * len(folds)
    out = []
    for stored in pair:
        roughness = choose_roughness(stored, kappas, nears[0])
        everything = np.arange(len(stored["rings"]))
        fits = [
            profiles(stored, everything[fold], kappas, roughness, near)
            for fold, near in zip(folds, nears, strict=True)
        ]
        nears = [values for values, _ in fits]
        out.append(packed(nears[0], np.stack(nears[1:]), fits[0][1]))
    return out


def packed(values, left_out, used):
    """Return coefficients of the bicubic splines, and ln of errors by the jackknife."""
    knots = kernels.RADIUS_START + kernels.RADIUS_STEP * np.arange(0, kernels.RADIUS_COUNT - 2, 2)
    left_out = np.einsum("pr,ferk->fepk", basis(knots), left_out)
    variance = (FOLDS - 1) ** 2 / FOLDS * left_out.var(axis=0, ddof=1) + MODEL_ERROR**2
    centre = LOG_RADIUS_START + LOG_RADIUS_STEP * (np.arange(RADIUS_BINS) + 0.5)
    for e, k in np.ndindex(ETAS.size, ROOT_ABSORPTIONS.size):
        held = centre[used[e, :, k]]
        beyond = knots > held.max() + 0.5 * kernels.RADIUS_STEP if held.size else knots > -99.0
        variance[e, beyond, k] = 1.0
    full = np.zeros((ETAS.size, kernels.RADIUS_COUNT, kernels.ROOT_COUNT))
    full[:, :, : ROOT_ABSORPTIONS.size] = values
    coefficients = np.linalg.solve(
        root_spline_matrix(), np.swapaxes(full, 1, 2).reshape(ETAS.size, -1, kernels.RADIUS_COUNT)
    )
    return np.swapaxes(coefficients, 1, 2), 0.5 * np.log(variance[:, :, ::2])


def make_table(folder):
    """Write model/data/photon_table.npz of the asymmetries whose collections are both there."""
    held, coefficients, errors = [], [], []
    for g in sorted(PHOTONS):
        names = [folder / f"g{g:g}-{collection}-{PHOTONS[g]}.npz" for collection in COLLECTIONS]
        if not all(name.exists() for name in names):
            continue
        pair = []
        for name in names:
            with np.load(name) as arrays:
                pair.append({key: arrays[key] for key in ("rings", "late")})
            if len(pair[-1]["rings"]) != BATCHES:
                raise SystemExit(f"{name}: {len(pair[-1]['rings'])} batches, expected {BATCHES}")
        print(f"g = {g}", flush=True)
        tables = tabulate(pair, g)
        held.append(g)
        coefficients.append([value for value, _ in tables])
        errors.append([error for _, error in tables])
    target = Path("model/data/photon_table.npz")
    np.savez_compressed(
        target,
        g=np.array(held),
        eta=ETAS,
        coefficients=np.array(coefficients, np.float32),
        log_error=np.array(errors, np.float16),
    )
    print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")


def main():
    """Trace photons and make the table from all existing batches.

    ``--trace-only`` leaves the table alone, ``--table-only`` traces nothing.
    """
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--trace-only", action="store_true")
    parser.add_argument("--table-only", action="store_true")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    if not arguments.table_only:
        for g, photons in PHOTONS.items():
            for collection in reversed(COLLECTIONS):
                simulate(arguments.work, g, collection, photons, BATCHES)
    if not arguments.trace_only:
        make_table(arguments.work)


if __name__ == "__main__":
    main()
