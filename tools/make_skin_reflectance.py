"""Make ``rigsim/data/skin_reflectance_mc.npz``: reflectance of two-layer skin by Monte Carlo.

    python tools/make_skin_reflectance.py [--photons-scale 1] [--threads 2] [--seed 20100]

Per wavelength a few stacks of increasing melanin are traced, and every returned photon's path
lengths in epidermis and dermis are stored. A photon of weight w in a stack with (c_ref, 0) has
weight w exp(-(c_m - c_ref) a - c_hd b) in one with (c_m, c_hd), where a and b are its path lengths
times the absorption per unit of fraction: all absorptions are linear in the two fractions, and
scattering does not depend on them. So one run serves all c_m >= c_ref with common random numbers,
and the table is smooth and monotone in both fractions. Runs of more melanin, where photons are
short-lived and cheap, take over smoothly between c_ref and 2.5 c_ref. The same photons, sorted by
their distance from the beam, give the lateral profiles. Standard errors are those of independent
batches.

Finished wavelengths are kept in the work folder; an interrupted run resumes from them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from rigsim.tissue import skin_layers
from rigsim.tissue.photon_walk import ROULETTE_MAX_WEIGHT, ROULETTE_SURVIVAL
from rigsim.tissue.skin_table import c_hd_axis, c_m_axis
from rigsim.tissue.tissue_mc import EscapePaths, trace_escape_paths

FloatArray = NDArray[np.float64]

RECIPE = 1  # raise it when the numbers change
WAVELENGTH_NM = np.arange(400.0, 701.0, 10.0)
NODES, LATERAL_NODES = 41, 9
RING_EDGES_MM = np.concatenate([[0.0], np.geomspace(0.01, 15.0, 40)])
BATCHES = 40
# Melanin of the traced stacks and photons of each; the darker, the shorter and cheaper the paths.
RUNS = ((0.0, 600_000), (0.02, 1_200_000), (0.1, 4_000_000))
TAKE_OVER = 2.5  # a run takes over fully at this multiple of its own melanin

ROOT = Path(__file__).resolve().parents[1]


def shares(c_m: FloatArray) -> FloatArray:
    """Return each run's weight in the estimate at each c_m, (runs, nodes); columns sum to 1."""
    result = np.zeros((len(RUNS), c_m.size))
    result[0] = 1.0
    for index, (c_ref, _) in enumerate(RUNS[1:], start=1):
        t = np.clip((c_m / c_ref - 1.0) / (TAKE_OVER - 1.0), 0.0, 1.0)
        ramp = t * t * (3.0 - 2.0 * t)
        result[:index] *= 1.0 - ramp
        result[index] = ramp
    return result


def survivals(
    paths: EscapePaths, wavelength_nm: float, c_ref: float, c_m: FloatArray, c_hd: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return photon weights at each melanin (n, c_m) and their factors by blood (n, c_hd)."""
    baseline = skin_layers.baseline_per_mm(wavelength_nm)
    melanin = skin_layers.melanin_per_mm(wavelength_nm) - baseline
    blood = skin_layers.blood_per_mm(wavelength_nm) - baseline
    epidermis, dermis = paths.path_mm.T
    in_blood = skin_layers.EPIDERMAL_BLOOD_RATIO * epidermis + dermis
    by_melanin = np.exp(-np.outer(epidermis, (c_m - c_ref) * melanin))
    by_melanin *= (paths.weight / paths.photons)[:, None]
    return by_melanin, np.exp(-np.outer(in_blood, c_hd * blood))


def ring_sums(
    paths: EscapePaths, wavelength_nm: float, c_ref: float, c_m: FloatArray, c_hd: FloatArray
) -> FloatArray:
    """Return the reflectance within each ring, shape (c_m, c_hd, rings)."""
    by_melanin, by_blood = survivals(paths, wavelength_nm, c_ref, c_m, c_hd)
    order = np.argsort(paths.radius_mm)
    ends = np.searchsorted(paths.radius_mm[order], RING_EDGES_MM)
    by_melanin, by_blood = by_melanin[order], by_blood[order]
    return np.stack([by_melanin[a:b].T @ by_blood[a:b] for a, b in pairwise(ends)], axis=-1)


def simulate(
    wavelength_nm: float, *, seed: int, scale: float, threads: int
) -> dict[str, FloatArray]:
    """Trace one wavelength; return reflectance and ring reflectance with their standard errors."""
    c_m, c_hd = c_m_axis(NODES), c_hd_axis(NODES)
    lateral_c_m, lateral_c_hd = c_m_axis(LATERAL_NODES), c_hd_axis(LATERAL_NODES)
    fine, coarse = shares(c_m), shares(lateral_c_m)
    sums: dict[str, FloatArray] = {}
    for index, (c_ref, photons) in enumerate(RUNS):
        rng = np.random.default_rng([seed, round(wavelength_nm), index])
        batches = trace_escape_paths(
            skin_layers.skin_layer_stack(wavelength_nm, c_ref, 0.0),
            photons=round(scale * photons),
            rng=rng,
            batches=BATCHES,
            threads=threads,
        )
        used, used_coarse = fine[index] > 0.0, coarse[index] > 0.0
        table, rings = [], []
        for batch in batches:
            by_melanin, by_blood = survivals(batch, wavelength_nm, c_ref, c_m[used], c_hd)
            table.append(by_melanin.T @ by_blood)
            rings.append(
                ring_sums(batch, wavelength_nm, c_ref, lateral_c_m[used_coarse], lateral_c_hd)
            )
        _add(sums, "reflectance", np.array(table), fine[index], used)
        _add(sums, "lateral", np.array(rings), coarse[index], used_coarse)
    for name in ("reflectance", "lateral"):
        sums[f"{name}_standard_error"] = np.sqrt(sums.pop(f"{name}_variance"))
    return sums


def _add(
    sums: dict[str, FloatArray], name: str, batches: FloatArray, share: FloatArray, used: FloatArray
) -> None:
    """Add one run's weighted mean and variance of the mean; batches are on the first axis."""
    shape = (share.size, *batches.shape[2:])
    mean = sums.setdefault(name, np.zeros(shape))
    variance = sums.setdefault(f"{name}_variance", np.zeros(shape))
    weight = share[used].reshape(-1, *[1] * (batches.ndim - 2))
    mean[used] += weight * batches.mean(axis=0)
    variance[used] += weight**2 * batches.var(axis=0, ddof=1) / len(batches)


def parameters(seed: int, scale: float) -> dict[str, object]:
    """Return all parameters that determine the table's values."""
    wavelengths = [float(nm) for nm in WAVELENGTH_NM]
    return {
        "recipe": RECIPE,
        "seed": seed,
        "photons_scale": scale,
        "runs_c_m_and_photons": [list(run) for run in RUNS],
        "batches": BATCHES,
        "take_over": TAKE_OVER,
        "nodes": [NODES, LATERAL_NODES],
        "ring_edges_mm": [float(edge) for edge in RING_EDGES_MM],
        "roulette": [ROULETTE_MAX_WEIGHT, ROULETTE_SURVIVAL],
        "epidermis_mm": skin_layers.EPIDERMIS_MM,
        "eta": skin_layers.ETA,
        "g": skin_layers.SKIN_ANISOTROPY,
        "epidermal_blood_share": skin_layers.EPIDERMAL_BLOOD_RATIO,
        "wavelength_nm": wavelengths,
        "melanin_per_mm": [skin_layers.melanin_per_mm(nm) for nm in wavelengths],
        "blood_per_mm": [skin_layers.blood_per_mm(nm) for nm in wavelengths],
        "baseline_per_mm": [skin_layers.baseline_per_mm(nm) for nm in wavelengths],
        "epidermis_scattering_per_mm": [
            skin_layers.epidermis_scattering_per_mm(nm) for nm in wavelengths
        ],
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Trace the missing wavelengths, then write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument(
        "--out", type=Path, default=ROOT / "rigsim" / "data" / "skin_reflectance_mc.npz"
    )
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "skin_reflectance")
    parser.add_argument("--photons-scale", type=float, default=1.0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=20100)
    args = parser.parse_args(argv)

    recorded = parameters(args.seed, args.photons_scale)
    key = hashlib.sha256(json.dumps(recorded, sort_keys=True).encode()).hexdigest()[:16]
    folder = args.work / key
    folder.mkdir(parents=True, exist_ok=True)
    seconds = 0.0
    parts = []
    for number, nm in enumerate(WAVELENGTH_NM, start=1):
        part = folder / f"{nm:.0f}nm.npz"
        if not part.exists():
            start = time.perf_counter()
            # BLAS threads that spin between small products would take cores from the tracing
            # threads.
            with threadpool_limits(1):
                sums = simulate(nm, seed=args.seed, scale=args.photons_scale, threads=args.threads)
            unfinished = part.with_suffix(".partial")
            with unfinished.open("wb") as stream:
                np.savez(stream, **sums, allow_pickle=False, seconds=time.perf_counter() - start)
            unfinished.replace(part)
        with np.load(part) as loaded:
            parts.append(dict(loaded))
        seconds += float(parts[-1]["seconds"])
        print(
            f"{nm:.0f} nm ({number}/{WAVELENGTH_NM.size}), {seconds:.0f} s of tracing so far",
            file=sys.stderr,
        )

    provenance = {
        **recorded,
        "seconds": round(seconds, 1),
        "threads": args.threads,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }
    columns = {
        name: np.stack([part[name] for part in parts], axis=-1).astype(np.float32)
        for name in (
            "reflectance",
            "reflectance_standard_error",
            "lateral",
            "lateral_standard_error",
        )
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        args.out,
        wavelength_nm=WAVELENGTH_NM,
        c_m=c_m_axis(NODES),
        c_hd=c_hd_axis(NODES),
        lateral_c_m=c_m_axis(LATERAL_NODES),
        lateral_c_hd=c_hd_axis(LATERAL_NODES),
        ring_edges_mm=RING_EDGES_MM,
        provenance=np.array(json.dumps(provenance, sort_keys=True)),
        allow_pickle=False,
        **columns,
    )
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
