"""Compare heights, and variances of normals, of the gradient rig with ground truth.

    python tools/judge_height_bands.py APPEARANCE TRUTH

Each row is a strain step; each column a band of periods, um: root mean square of the error over
that of the true height within the band, and the band's part of the height's variance; then the
coverage of the height's 68 and 95 % intervals. A second table has the variances along and across
the jaws over those of the patch's own true topography, less 1: of the height map, and of
`histograms.json`, which adds what the
estimator's filter has removed.
"""

import sys
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from model import store
from model.skin import SkinAppearance, SkinMap
from reconstruction.normal_histogram.statistics import measure_normals
from reconstruction.normal_integration.height_filters import high_pass
from reconstruction.pipeline.gradient.stages import HISTOGRAM_FILE
from reconstruction.pipeline.gradient.strain_kernels import UNRESOLVED_VARIANCE
from skinrig.appearances.contents import intersect_valid
from skinrig.evaluating.subsurface import read_document

PERIODS_UM = (1000, 500, 250, 160, 110, 80, 60, 45, 35, 25)
PIXEL_UM = 6.0
CUTOFF_UM = 1000.0
"""Waves of this length keep half their height in estimates; the truth is filtered alike."""


def main(appearance: Path, truth: Path) -> None:
    """Print the table of one session."""
    estimated = store.read(appearance)
    maps, true_maps = estimated.maps, store.read(truth).maps
    bands = list(pairwise(PERIODS_UM))
    header = [*(f"{long} to {short}" for long, short in bands), "coverage of 68 %", "of 95 %"]
    print(" | ".join(["step", *header]))
    for name in sorted(name for name in maps if name.startswith("height_")):
        valid = intersect_valid(maps[name]) & intersect_valid(true_maps[name])
        given, true = (np.where(valid, one[name].values, 0.0) for one in (maps, true_maps))
        true = high_pass(true.astype(float), pixel=PIXEL_UM, cutoff=CUTOFF_UM, valid=valid)
        rows, columns = true.shape
        window = np.outer(np.hanning(rows), np.hanning(columns)) * valid
        off, signal = (np.abs(np.fft.fft2(x * window)) ** 2 for x in (given - true, true))
        per_um = np.hypot(
            np.fft.fftfreq(columns, PIXEL_UM)[None], np.fft.fftfreq(rows, PIXEL_UM)[:, None]
        )
        period = 1.0 / np.maximum(per_um, 1e-9)
        cells = []
        for longest, shortest in bands:
            band = (period <= longest) & (period > shortest)
            error = np.sqrt(off[band].sum() / signal[band].sum())
            cells.append(f"{100 * error:.1f} % ({100 * signal[band].sum() / signal.sum():.1f} %)")
        error = (given - true)[valid]
        stderr = np.asarray(maps[name].stderr)[valid]
        away = np.abs(error - error.mean()) / stderr  # normals do not determine the mean
        cells += [f"{100 * np.mean(away <= sigmas):.0f} %" for sigmas in (1.0, 1.96)]
        print(" | ".join([name.removeprefix("height_"), *cells]))
    _print_variances(estimated, true_maps)


def _print_variances(estimated: SkinAppearance, true_maps: Mapping[str, SkinMap]) -> None:
    """Print the variances of normals over those of the true topography, less 1."""
    document = read_document(estimated, HISTOGRAM_FILE)
    if document is None:
        return
    print("step | height map, along, across | corrected, along, across")
    for state in document["states"]:
        given, true = (maps[f"height_{state['name']}"] for maps in (estimated.maps, true_maps))
        valid = intersect_valid(given) & intersect_valid(true)
        relief = np.where(valid, true.values, 0.0).astype(float)
        relief = high_pass(relief, pixel=PIXEL_UM, cutoff=CUTOFF_UM, valid=valid)
        angle_rad = np.radians(state["angle_deg"])
        of_truth = measure_normals(relief, pixel=PIXEL_UM, valid=valid, angle_rad=angle_rad)
        corrected = state["variance_s"], state["variance_t"]
        lost = state["lost_variance_s"], state["lost_variance_t"]
        measured = [v / UNRESOLVED_VARIANCE - gone for v, gone in zip(corrected, lost, strict=True)]
        cells = []
        for along, across in (measured, corrected):
            parts = along / of_truth.variance_x - 1.0, across / of_truth.variance_y - 1.0
            cells.append(", ".join(f"{100 * part:+.1f} %" for part in parts))
        print(" | ".join([state["name"], *cells]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
