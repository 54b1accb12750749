"""Compare estimated heights of the gradient rig with ground truth by band of periods.

    python tools/judge_height_bands.py APPEARANCE TRUTH

Each row is a strain step; each column a band of periods, um: root mean square of the error over
that of the true height within the band, and the band's part of the height's variance.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from model import store
from reconstruction.normal_integration.height_filters import high_pass
from skinrig.appearances.contents import intersect_valid

PERIODS_UM = (1000, 500, 250, 160, 110, 80, 60, 45, 35, 25)
PIXEL_UM = 6.0
CUTOFF_UM = 1000.0
"""Waves of this length keep half their height in estimates; the truth is filtered alike."""


def main(appearance: Path, truth: Path) -> None:
    """Print the table of one session."""
    maps, true_maps = store.read(appearance).maps, store.read(truth).maps
    bands = list(pairwise(PERIODS_UM))
    print(" | ".join(["step", *(f"{long} to {short}" for long, short in bands)]))
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
        print(" | ".join([name.removeprefix("height_"), *cells]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
