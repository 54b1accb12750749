"""Make ``rigsim/data/white_fiber_mc.npz``: light collected by fibers on half spaces.

    python tools/make_white_fiber.py WORK [--photons-scale 1] [--threads 1] [--seed 20600]

A few media of increasing absorption are traced with sigma_s' = 1 per mm; their photons' path
lengths give every larger absorption. The estimates of all media that are informative at an
absorption are combined by inverse variance. Along the distance, the logarithm of each estimate is
fitted by a cubic spline of few knots, which pools neighboring distances; a jackknife over batches
of photons gives the standard errors. Runs are kept in WORK; an interrupted one resumes.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from math import inf
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from rigsim.fiber.profile import FiberGeometry, trace_fiber_paths
from rigsim.fiber.white_fiber import (
    ETA,
    HENYEY_GREENSTEIN_G,
    NUMERICAL_APERTURE,
    TABLE_FILE,
    decay_rate,
    disc_quadrature,
    distance_axis,
)
from rigsim.tissue.tissue_mc import Layer, LayerStack

FloatArray = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
BATCHES = 20
NEAREST, FARTHEST = 0.03, 45.0
LEAST = 1e-7  # absorption of the medium without any
PHOTONS = {
    0.0: (300_000, 800_000, 400_000),
    0.003: (1_000_000, 2_000_000, 2_500_000),
    0.012: (1_000_000, 4_000_000, 2_500_000),
    0.04: (4_000_000, 8_000_000, 2_500_000),
    0.12: (4_000_000, 8_000_000, 2_500_000),
    0.35: (4_000_000, 8_000_000, 4_000_000),
    1.0: (4_000_000, 8_000_000, 8_000_000),
    3.0: (4_000_000, 8_000_000, 8_000_000),
}
"""Photons of the near, middle and far runs, by absorption: the darker, the cheaper."""
BASES = tuple(PHOTONS)
ABSORPTION = np.concatenate(
    [
        [0.0, 0.0003, 0.001],
        np.geomspace(0.003, 0.012, 5)[:-1],
        np.geomspace(0.012, 0.04, 5)[:-1],
        np.geomspace(0.04, 0.12, 5)[:-1],
        np.geomspace(0.12, 0.35, 5)[:-1],
        np.geomspace(0.35, 1.0, 5)[:-1],
        np.geomspace(1.0, 3.0, 5)[:-1],
        np.geomspace(3.0, 12.0, 6),
    ]
)
DISTANCE = np.geomspace(NEAREST, FARTHEST, 81)
NOISIEST = 0.2  # largest relative error of a fiber that is fitted
LAST_LOG = 26.0  # no photons are traced where less than exp(-this) of the light is left
SPAN = 12.0  # a base serves absorptions up to this multiple of its own


def groups(base: float) -> list[tuple[FloatArray, float, int]]:
    """Return distances, the width that they are averaged over, and photons, of each run."""
    far = min(FARTHEST, LAST_LOG / max(float(decay_rate(base)), 1e-9))
    width = float(np.clip(0.4 / max(float(decay_rate(base)), 1e-9), 0.05, 1.2))
    edge = min(2.5, 0.5 * far)
    near, middle, beyond = PHOTONS[base]
    return [
        (np.geomspace(NEAREST, 0.3, 30), 0.02, near),
        (np.geomspace(0.3, edge, 30), min(0.1, width), middle),
        (np.linspace(edge, far, 64), width, beyond),
    ]


def trace(work: Path, scale: float, threads: int, seed: int) -> list[dict[str, FloatArray]]:
    """Return per base distances, widths, and F by batch, distance and absorption."""
    out = []
    for number, base in enumerate(BASES):
        path = work / f"base{number}.npz"
        if not path.exists():
            started = time.process_time()
            served = ABSORPTION[(base <= ABSORPTION) & (max(base, 0.003) * SPAN >= ABSORPTION)]
            radii, widths, values = [], [], []
            for group, (radius, width, photons) in enumerate(groups(base)):
                stack = LayerStack(
                    (
                        Layer(
                            inf,
                            max(base, LEAST),
                            1.0 / (1.0 - HENYEY_GREENSTEIN_G),
                            HENYEY_GREENSTEIN_G,
                            ETA,
                        ),
                    )
                )
                paths = trace_fiber_paths(
                    stack,
                    FiberGeometry(
                        tuple(radius.tolist()), width, 0.0, NUMERICAL_APERTURE, NUMERICAL_APERTURE
                    ),
                    photons=round(scale * photons),
                    rng=np.random.default_rng([seed, number, group]),
                    batches=BATCHES,
                    threads=threads,
                )
                more = np.maximum(served - max(base, LEAST), 0.0)
                values.append(
                    np.stack([paths.profile(m).batch_reflectance_per_mm2 for m in more], axis=-1)
                )
                radii.append(radius)
                widths.append(np.full(len(radius), width))
            np.savez(
                path,
                served=served,
                radius=np.concatenate(radii),
                width=np.concatenate(widths),
                value=np.concatenate(values, axis=1),
            )
            print(f"base {base}: {time.process_time() - started:.0f} s of CPU", flush=True)
        with np.load(path) as stored:
            out.append({name: stored[name] for name in stored.files})
    return out


class Curve:
    """log(F d) + decay d as a spline of few knots, fitted to averages over discs."""

    def __init__(self, radius: FloatArray, width: FloatArray, absorption: float) -> None:
        points, self.share = disc_quadrature(4, 9)
        self.apart = np.hypot(
            radius[:, None] + 0.5 * width[:, None] * points[:, 0],
            0.5 * width[:, None] * points[:, 1],
        )
        self.radius, self.decay = radius, float(decay_rate(absorption))
        axis = distance_axis(radius)
        count = max(3, round(4.0 * float(axis[-1] - axis[0])))
        inner = np.linspace(axis[0], axis[-1], count + 1)[1:-1]
        self.knots = np.concatenate([[axis[0]] * 4, inner, [axis[-1]] * 4])
        self.at_radius, self.at_points = self.basis(radius), self.basis(self.apart)

    def basis(self, distance: FloatArray) -> FloatArray:
        """Return the values of the basis, constant beyond the ends."""
        axis = np.clip(distance_axis(distance), self.knots[0], self.knots[-1])
        flat = BSpline.design_matrix(axis.reshape(-1), self.knots, 3).toarray()
        return np.asarray(flat.reshape(*distance.shape, -1))

    def average(self, beta: FloatArray) -> FloatArray:
        """Return F averaged over the discs."""
        shape = self.at_points @ beta - np.log(self.apart) - self.decay * self.apart
        return np.asarray(np.exp(shape) @ self.share)

    def fit(self, value: FloatArray, error: FloatArray, beta: FloatArray | None) -> FloatArray:
        """Return the coefficients by Gauss-Newton on relative residuals."""
        if beta is None:
            start = np.log(value * self.radius) + self.decay * self.radius
            found = np.asarray(np.linalg.lstsq(self.at_radius, start, rcond=None)[0])
        else:
            found = beta
        for _ in range(8):
            model = self.average(found)
            weight = model / error
            step = np.linalg.lstsq(
                self.at_radius * weight[:, None], (value - model) / error, rcond=None
            )[0]
            found = found + step
        return found


def smoothed(
    radius: FloatArray, width: FloatArray, value: FloatArray, absorption: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the shape at DISTANCE, its standard error, and chi^2 per degree of freedom."""
    order = np.argsort(radius, kind="stable")
    radius, width, value = radius[order], width[order], value[:, order]
    mean = value.mean(axis=0)
    error = value.std(axis=0, ddof=1) / np.sqrt(BATCHES)
    good = (mean > 0.0) & (error < NOISIEST * mean)
    last = int(np.flatnonzero(good)[-1])
    use = np.arange(len(radius)) <= last
    use &= good
    curve = Curve(radius[use], width[use], absorption)
    # smooth errors: a single one is itself uncertain by a sixth
    smooth = (
        np.exp(
            np.convolve(
                np.pad(np.log(error[use] / mean[use]), 3, "edge"), np.ones(7) / 7.0, "valid"
            )
        )
        * mean[use]
    )
    beta = curve.fit(mean[use], smooth, None)
    chi2 = float((((mean[use] - curve.average(beta)) / smooth) ** 2).sum())
    at = curve.basis(DISTANCE)
    each = np.array(
        [
            at @ curve.fit(np.delete(value[:, use], b, axis=0).mean(axis=0), smooth, beta)
            for b in range(BATCHES)
        ]
    )
    spread = np.sqrt((BATCHES - 1.0) / BATCHES * ((each - each.mean(axis=0)) ** 2).sum(axis=0))
    spread = np.where(radius[use][-1] < DISTANCE, inf, spread)
    return at @ beta, spread, chi2 / (use.sum() - len(beta))


def combine(runs: list[dict[str, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Return shape and relative error at all nodes."""
    top = np.zeros((len(DISTANCE), len(ABSORPTION)))
    weight = np.zeros_like(top)
    for base, run in zip(BASES, runs, strict=True):
        for column, a in enumerate(run["served"]):
            shape, spread, chi2 = smoothed(
                run["radius"], run["width"], run["value"][:, :, column], float(a)
            )
            print(
                f"base {base} a {a:.4f}: chi2/dof {chi2:.2f}, error at "
                + ", ".join(
                    f"{d:.1f}: {100 * e:.2f} %"
                    for d, e in zip(DISTANCE[::16], spread[::16], strict=True)
                )
            )
            node = int(np.argmin(abs(ABSORPTION - a)))
            share = 1.0 / np.maximum(spread, 1e-4) ** 2
            top[:, node] += share * shape
            weight[:, node] += share
    known = weight > 0.0
    shape = np.where(known, top / np.where(known, weight, 1.0), 0.0)
    error = np.where(known, 1.0 / np.sqrt(np.where(known, weight, 1.0)), 1.0)
    for column in range(len(ABSORPTION)):
        last = int(np.flatnonzero(known[:, column])[-1])
        # extrapolate beyond the farthest photons with the last slope over distance
        slope = (shape[last, column] - shape[last - 4, column]) / (
            DISTANCE[last] - DISTANCE[last - 4]
        )
        shape[last + 1 :, column] = shape[last, column] + slope * (
            DISTANCE[last + 1 :] - DISTANCE[last]
        )
    return shape, error


def main() -> None:
    """Trace photons, fit the curves and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--photons-scale", type=float, default=1.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=20600)
    asked = parser.parse_args()
    asked.work.mkdir(parents=True, exist_ok=True)
    runs = trace(asked.work, asked.photons_scale, asked.threads, asked.seed)
    shape, error = combine(runs)
    recipe = {
        "g": HENYEY_GREENSTEIN_G,
        "eta": ETA,
        "numerical_aperture": NUMERICAL_APERTURE,
        "bases": BASES,
        "batches": BATCHES,
        "photons": [[round(asked.photons_scale * n) for _, _, n in groups(b)] for b in BASES],
        "seed": asked.seed,
        "numpy": np.__version__,
        "numba": numba.__version__,
        "python": platform.python_version(),
    }
    np.savez_compressed(
        ROOT / "rigsim" / "data" / TABLE_FILE,
        distance=DISTANCE,
        absorption=ABSORPTION,
        shape=shape.astype(np.float32),
        relative_error=error.astype(np.float32),
        recipe=json.dumps(recipe),
    )


if __name__ == "__main__":
    main()
