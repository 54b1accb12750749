"""Make ``rigsim/data/skin_reflectance_mc.npz``: reflectance of layered skin by Monte Carlo.

    python tools/make_skin_reflectance.py [--photons-scale 1] [--threads 2] [--seed 20100]

Lengths are in reduced mean free paths of the epidermis, so one table serves all wavelengths and
all people. Its axes are the epidermis's scattering depth, its absorption depth, the fraction of
that absorption in its basal third, and the dermis's absorption over its reduced scattering.

Per scattering depth a few stacks of increasing absorption are traced, and every returned photon's
path lengths in the three layers are stored. A photon of weight w has weight w exp(-sum of path
length times added absorption) in a stack that absorbs more. So one run serves all larger
absorptions with common random numbers, and the table is smooth and monotone in them. Runs of more
absorption, where photons are short-lived and cheap, take over smoothly. The same photons, sorted
by their distance from the beam, give the lateral profiles. Standard errors are those of
independent batches.

Finished depths are kept in the work folder; an interrupted run resumes from them.
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
from math import inf
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from rigsim.tissue import skin_layers, skin_transport
from rigsim.tissue.photon_walk import ROULETTE_MAX_WEIGHT, ROULETTE_SURVIVAL
from rigsim.tissue.skin_transport import Axes
from rigsim.tissue.tissue_mc import EscapePaths, Layer, LayerStack, trace_escape_paths

FloatArray = NDArray[np.float64]

RECIPE = 2  # raise it when the numbers change
BATCHES = 40
# Absorption depth of the traced epidermis and photons of each run.
TRACED_RUNS = ((0.0, 800_000), (0.7, 1_600_000), (3.0, 4_000_000))
TAKE_OVER = 2.5  # a run takes over fully at this multiple of its own absorption
BASAL_FRACTION = skin_layers.BASAL_THICKNESS_FRACTION
DERMIS_RATIO = skin_layers.DERMIS_SCATTERING_RATIO

ROOT = Path(__file__).resolve().parents[1]


def shares(axes: Axes) -> FloatArray:
    """Return each run's weight in the estimate, (runs, basal, absorption); sums over runs are 1."""
    # The weaker absorption of both parts of the epidermis, over that of an even one.
    weaker = np.minimum((1.0 - axes.basal) / (1.0 - BASAL_FRACTION), axes.basal / BASAL_FRACTION)
    depth = weaker[:, None] * axes.absorption
    result = np.zeros((len(TRACED_RUNS), *depth.shape))
    result[0] = 1.0
    for index, (traced, _) in enumerate(TRACED_RUNS[1:], start=1):
        t = np.clip((depth / traced - 1.0) / (TAKE_OVER - 1.0), 0.0, 1.0)
        ramp = t * t * (3.0 - 2.0 * t)
        result[:index] *= 1.0 - ramp
        result[index] = ramp
    return result


def stack_of(scattering: float, absorption: float, least_dermis: float) -> LayerStack:
    """Return the traced stack; lengths are in reduced mean free paths of the epidermis."""
    per_mm = 1.0 / (1.0 - skin_layers.SKIN_ANISOTROPY)

    def layer(thickness: float, sigma_a: float, scale: float) -> Layer:
        return Layer(
            thickness, sigma_a, scale * per_mm, skin_layers.SKIN_ANISOTROPY, skin_layers.ETA
        )

    even = absorption / scattering
    return LayerStack(
        (
            layer((1.0 - BASAL_FRACTION) * scattering, even, 1.0),
            layer(BASAL_FRACTION * scattering, even, 1.0),
            layer(inf, DERMIS_RATIO * least_dermis, DERMIS_RATIO),
        )
    )


def survivals(
    paths: EscapePaths, scattering: float, traced: float, axes: Axes, used: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Return photon weights at the used (basal, absorption) nodes, and factors by the dermis."""
    upper, basal, dermis = paths.path_mm.T
    share, depth = np.broadcast_arrays(axes.basal[:, None], axes.absorption)
    share, depth = share[used], depth[used]
    added_upper = (
        depth * (1.0 - share) / ((1.0 - BASAL_FRACTION) * scattering) - traced / scattering
    )
    added_basal = depth * share / (BASAL_FRACTION * scattering) - traced / scattering
    by_epidermis = np.exp(-np.outer(upper, added_upper) - np.outer(basal, added_basal))
    by_epidermis *= (paths.weight / paths.photons)[:, None]
    return by_epidermis, np.exp(-np.outer(dermis, DERMIS_RATIO * (axes.dermis - axes.dermis[0])))


def ring_sums(
    paths: EscapePaths, weights: tuple[FloatArray, FloatArray], ring_edges: FloatArray
) -> FloatArray:
    """Return the reflectance within each ring, shape (used nodes, dermis, rings)."""
    order = np.argsort(paths.radius_mm)
    ends = np.searchsorted(paths.radius_mm[order], ring_edges)
    by_epidermis, by_dermis = (part[order] for part in weights)
    return np.stack([by_epidermis[a:b].T @ by_dermis[a:b] for a, b in pairwise(ends)], axis=-1)


def simulate(scattering: float, *, seed: int, scale: float, threads: int) -> dict[str, FloatArray]:
    """Trace one scattering depth; return reflectance and ring reflectance with their errors."""
    axes, lateral = skin_transport.TABLE_AXES, skin_transport.LATERAL_AXES
    fine, coarse = shares(axes), shares(lateral)
    edges = skin_transport.RING_EDGES / DERMIS_RATIO  # from reduced mean free paths of the dermis
    sums: dict[str, FloatArray] = {}
    for index, (traced, photons) in enumerate(TRACED_RUNS):
        rng = np.random.default_rng([seed, round(1e4 * scattering), index])
        batches = trace_escape_paths(
            stack_of(scattering, traced, float(axes.dermis[0])),
            photons=round(scale * photons),
            rng=rng,
            batches=BATCHES,
            threads=threads,
        )
        used, used_coarse = fine[index] > 0.0, coarse[index] > 0.0
        table, rings = [], []
        for batch in batches:
            by_epidermis, by_dermis = survivals(batch, scattering, traced, axes, used)
            table.append(by_epidermis.T @ by_dermis)
            weights = survivals(batch, scattering, traced, lateral, used_coarse)
            rings.append(ring_sums(batch, weights, edges))
        _add(sums, "reflectance", np.array(table), fine[index], used)
        _add(sums, "lateral", np.array(rings), coarse[index], used_coarse)
    for name in ("reflectance", "lateral"):
        sums[f"{name}_standard_error"] = np.sqrt(sums.pop(f"{name}_variance"))
    return sums


def _add(
    sums: dict[str, FloatArray],
    name: str,
    batches: FloatArray,
    share: FloatArray,
    used: NDArray[np.bool_],
) -> None:
    """Add one run's weighted mean and variance of the mean; batches are on the first axis."""
    shape = (*share.shape, *batches.shape[2:])
    mean = sums.setdefault(name, np.zeros(shape))
    variance = sums.setdefault(f"{name}_variance", np.zeros(shape))
    weight = share[used].reshape(-1, *[1] * (batches.ndim - 2))
    mean[used] += weight * batches.mean(axis=0)
    variance[used] += weight**2 * batches.var(axis=0, ddof=1) / len(batches)


def parameters(seed: int, scale: float) -> dict[str, object]:
    """Return all parameters that determine the table's values."""
    axes, lateral = skin_transport.TABLE_AXES, skin_transport.LATERAL_AXES
    return {
        "recipe": RECIPE,
        "seed": seed,
        "photons_scale": scale,
        "runs_absorption_and_photons": [list(run) for run in TRACED_RUNS],
        "batches": BATCHES,
        "take_over": TAKE_OVER,
        "axes": {name: getattr(axes, name).tolist() for name in Axes.__slots__},
        "lateral_axes": {name: getattr(lateral, name).tolist() for name in Axes.__slots__},
        "ring_edges": skin_transport.RING_EDGES.tolist(),
        "roulette": [ROULETTE_MAX_WEIGHT, ROULETTE_SURVIVAL],
        "eta": skin_layers.ETA,
        "g": skin_layers.SKIN_ANISOTROPY,
        "dermis_scattering_ratio": DERMIS_RATIO,
        "basal_thickness_fraction": BASAL_FRACTION,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Trace the missing depths, then write the table."""
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
    depths = skin_transport.TABLE_AXES.scattering
    for number, depth in enumerate(depths, start=1):
        part = folder / f"{depth:.4f}.npz"
        if not part.exists():
            start = time.perf_counter()
            # BLAS threads that spin between small products would take cores from the tracing
            # threads.
            with threadpool_limits(1):
                sums = simulate(
                    float(depth), seed=args.seed, scale=args.photons_scale, threads=args.threads
                )
            unfinished = part.with_suffix(".partial")
            with unfinished.open("wb") as stream:
                np.savez(stream, **sums, allow_pickle=False, seconds=time.perf_counter() - start)
            unfinished.replace(part)
        with np.load(part) as loaded:
            parts.append(dict(loaded))
        seconds += float(parts[-1]["seconds"])
        print(
            f"depth {depth:.3f} ({number}/{depths.size}), {seconds:.0f} s of tracing so far",
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
    every = skin_transport.LATERAL_SCATTERING_STEP
    columns = {
        name: np.stack([part[name] for part in chosen]).astype(np.float32)
        for stem, chosen in (("reflectance", parts), ("lateral", parts[::every]))
        for name in (stem, f"{stem}_standard_error")
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        args.out,
        provenance=np.array(json.dumps(provenance, sort_keys=True)),
        allow_pickle=False,
        **columns,
    )
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
