"""Reconstruct the sessions of a demo as on other processors, and compare the maps.

Kernels are compiled for the other processor; NumPy and OpenBLAS leave out what it lacks, too.
Prints one row per map: the fraction of equal values, and the largest difference, over the standard
error of its texel and over the median of the map.

    skinrig demo --out DEMO
    python tools/judge_processors.py DEMO --work WORK [--rigs flash,probe] [--processors generic]
"""

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model import store

AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
PROCESSORS: Mapping[str, Mapping[str, str]] = {
    "native": {},
    "avx2": {
        "NUMBA_CPU_NAME": "haswell",
        "NUMBA_CPU_FEATURES": "",
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": AVX512,
    },
    "generic": {
        "NUMBA_CPU_NAME": "generic",
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": f"X86_V3 {AVX512}",
    },
}
"""Variables of each: that of this machine, one without AVX-512, and one of x86-64 without AVX."""
RECONSTRUCTIONS: Mapping[str, tuple[str, str]] = {
    "flash": ("session-flash-II", "melanin,hemoglobin"),
    "dome": ("session-dome-III", "half_vector_normals,normals"),
    "gradient": ("session-gradient-forehead", "normals,height"),
    "probe": ("session-probe-III", "subsurface,translucency"),
}
"""Session and maps of each rig in the folder of a demo."""


@dataclass(frozen=True, slots=True)
class MapDifference:
    """Difference of a map between two processors."""

    name: str
    count: int
    """Values that are valid on both."""
    changed_mask: int
    """Texels that are valid on one of the two alone."""
    equal: float
    """Fraction of equal values."""
    over_error: float
    """Largest difference over the standard error of its texel; NaN without one."""
    over_median: float
    """Largest difference over the median of the magnitudes of the map."""


def reconstruct(session: Path, maps: str, out: Path, processor: str, *options: str) -> None:
    """Run `skinrig reconstruct` as on a processor."""
    command = [sys.executable, "-m", "skinrig", "reconstruct", str(session), "--maps", maps]
    shutil.rmtree(out, ignore_errors=True)
    subprocess.run(
        [*command, *options, "--out", str(out)],
        env={**os.environ, **PROCESSORS[processor]},
        stdout=subprocess.DEVNULL,
        check=True,
    )


def compare_maps(first: Path, second: Path) -> Iterator[MapDifference]:
    """Yield the difference of each map of two folders."""
    one, other = store.read(first), store.read(second)
    for name, own in one.maps.items():
        theirs = other.maps[name]
        shape = own.values.shape[:2]
        masks = [np.ones(shape, bool) if m.valid is None else m.valid > 0 for m in (own, theirs)]
        valid = masks[0] & masks[1]
        a, b = own.values[valid].astype(float), theirs.values[valid].astype(float)
        apart = np.abs(a - b)
        scale = np.median(np.abs(a)) if a.size else np.nan
        over_error = np.nan
        if own.stderr is not None and a.size:
            error = np.broadcast_to(own.stderr, own.values.shape)[valid]
            known = error > 0
            over_error = np.max(apart[known] / error[known], initial=0.0)
        yield MapDifference(
            name,
            a.size,
            int((masks[0] != masks[1]).sum()),
            float((a == b).mean()) if a.size else 1.0,
            float(over_error),
            float(apart.max(initial=0.0) / scale) if scale > 0 else np.nan,
        )


def main() -> None:
    """Compare the maps of the rigs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("demo", type=Path, help="folder of `skinrig demo`")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--rigs", default="probe,flash,gradient,dome")
    parser.add_argument("--processors", default="avx2,generic")
    order = parser.parse_args()
    order.work.mkdir(parents=True, exist_ok=True)
    print("rig,processor,map,values,masks changed,equal,over error,over median")
    for rig in order.rigs.split(","):
        session, maps = RECONSTRUCTIONS[rig]
        options = ("--calibration", str(order.demo / f"calibration-{rig}"))
        for processor in ("native", *order.processors.split(",")):
            out = order.work / f"{rig}-{processor}"
            reconstruct(order.demo / session, maps, out, processor, *options)
            if processor != "native":
                for found in compare_maps(order.work / f"{rig}-native", out):
                    row = (found.count, found.changed_mask, f"{found.equal:.4f}")
                    worst = (f"{found.over_error:.2g}", f"{found.over_median:.2g}")
                    print(rig, processor, found.name, *row, *worst, sep=",", flush=True)


if __name__ == "__main__":
    main()
