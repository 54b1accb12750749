"""Compress and stretch a profile of skin with and without kernels: figure 4 of Nagano et al. 2015.

A profile that is stretched with unchanged heights becomes longer along its surface. The kernels of
eq. (6) smooth it under stretch and sharpen it under compression, so that its length stays nearer to
the neutral one; `model.microstructure.profile_length` finds the kernel that preserves the length.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.microstructure import FOREHEAD, kernel_parameters
from model.microstructure.profile_length import (
    convolve_profile,
    find_length_preserving_kernel,
    length_change,
)
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.arrays import Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.errors import UnusableError

PROFILE_COLUMNS: Final = ("position_um", "height_um")
PAPER_STRETCHES: Final = (0.8, 1.35)
"""Stretch ratios of the figure: 20 % shorter, 35 % longer."""
PAPER_LENGTH_MM: Final = 3.0
STRETCH_LIMITS: Final = (0.3, 3.0)
LENGTH_LIMITS_MM: Final = (0.2, 20.0)
SIMULATED_SPACING_UM: Final = 5.0
MIN_POINTS: Final = 16
SPACING_TOL: Final = 1e-3
"""Relative difference of spacings that count as equal."""
OUTPUT_FILES: Final = ("figure-4.png", "profile.json")


def read_profile(path: Path) -> tuple[Float64Array, float]:
    """Read heights, um, (N,), and their spacing, um, from a table position_um,height_um.

    Raises
    ------
    UnusableError
        For other columns, values that are not numbers, or positions that are not even.
    """
    try:
        lines = path.read_text(encoding="utf-8").split()
        rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    except (OSError, ValueError) as error:
        raise UnusableError(
            f"{path}: got {error}, expected a table {','.join(PROFILE_COLUMNS)} of numbers"
        ) from error
    if tuple(lines[0].split(",")) != PROFILE_COLUMNS or rows.shape[1:] != (2,):
        raise UnusableError(f"{path}: got columns {lines[0]}, expected {','.join(PROFILE_COLUMNS)}")
    if len(rows) < MIN_POINTS or not np.isfinite(rows).all():
        raise UnusableError(f"{path}: got {len(rows)} rows, expected {MIN_POINTS} finite ones")
    steps = np.diff(rows[:, 0])
    if steps[0] <= 0 or np.ptp(steps) > SPACING_TOL * abs(steps.mean()):
        raise UnusableError(f"{path}: got uneven positions, expected equal steps; resample them")
    return rows[:, 1], float(steps.mean())


def simulate_profile(length_mm: float, seed: int) -> tuple[Float64Array, float]:
    """Return heights, um, and spacing, um, of a cross section of a simulated forehead.

    Raises
    ------
    UnusableError
        For a length outside `LENGTH_LIMITS_MM`.
    """
    low, high = LENGTH_LIMITS_MM
    if not low <= length_mm <= high:
        raise UnusableError(
            f"--length: got {length_mm:g}, expected {low:g} to {high:g} mm; change it"
        )
    skin = make_micro_skin("forehead", seed=seed, size_mm=length_mm, texel_um=SIMULATED_SPACING_UM)
    middle = skin.height_um[skin.height_um.shape[0] // 2]
    return middle.astype(np.float64), skin.texel_um


def analyze_profile(
    out: Path,
    height_um: Float64Array,
    spacing_um: float,
    *,
    source: str,
    stretches: Sequence[float] = PAPER_STRETCHES,
) -> dict[str, Any]:
    """Compute lengths of a profile under stretches and write `OUTPUT_FILES`.

    Parameters
    ----------
    out
        Folder to write.
    height_um, spacing_um
        Neutral heights, (N,), and their distance.
    source
        Origin of the profile.
    stretches
        Stretch ratios.

    Returns
    -------
    dict
        JSON values: per stretch the lengths with unchanged heights, with the paper's kernel of that
        stretch, and with the length-preserving kernel of the same width.

    Raises
    ------
    UnusableError
        For a stretch outside `STRETCH_LIMITS`.
    """
    low, high = STRETCH_LIMITS
    rows = []
    drawn = []
    for stretch in stretches:
        if not low <= stretch <= high:
            raise UnusableError(
                f"--stretch: got {stretch:g}, expected {low:g} to {high:g}; change it"
            )
        alpha, sigma_um = (float(value) for value in kernel_parameters(stretch, FOREHEAD))
        how = {"spacing_um": spacing_um, "stretch": stretch, "sigma_um": sigma_um}
        table = length_change(height_um, alpha=alpha, **how)
        kept = find_length_preserving_kernel(height_um, **how)
        rows.append(
            {
                "stretch": stretch,
                "unchanged_ratio": table.unchanged_ratio,
                "table_alpha": alpha,
                "table_sigma_um": sigma_um,
                "table_ratio": table.convolved_ratio,
                "preserving_alpha": kept.change.alpha,
                "preserving_ratio": kept.change.convolved_ratio,
                "within_limits": kept.within_limits,
                "neutral_um": asdict(table)["neutral_um"],
            }
        )
        shown = [
            convolve_profile(height_um, strength, sigma_um, spacing_um=spacing_um)
            for strength in (0.0, alpha, kept.change.alpha)
        ]
        drawn.append((stretch, shown))
    document = {
        "schema": "skinrig.profile/1",
        "source": source,
        "points": height_um.size,
        "spacing_um": spacing_um,
        "stretches": rows,
    }
    write_atomically(out / OUTPUT_FILES[0], _draw(height_um, spacing_um, drawn))
    write_atomically(out / OUTPUT_FILES[1], json.dumps(document, indent=1))
    return document


def _draw(
    height_um: Float64Array, spacing_um: float, drawn: list[tuple[float, list[Float64Array]]]
) -> bytes:
    """Draw the neutral profile, and per stretch unchanged heights and both kernels."""
    figure, axes = new_figure(8.0, 1.6 * (1 + len(drawn)), 1 + len(drawn), 1)
    position = 1e-3 * spacing_um * np.arange(height_um.size)
    axes[0, 0].plot(position, height_um, "k", lw=0.8)
    axes[0, 0].set_title("neutral", fontsize=8)
    labels = ("unchanged heights", "the paper's kernel", "length preserved")
    for axis, (stretch, shown) in zip(axes[1:, 0], drawn, strict=True):
        for heights, label in zip(shown, labels, strict=True):
            axis.plot(stretch * position, heights, lw=0.8, label=label)
        axis.set_title(f"stretch {stretch:g}", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("height, um", fontsize=7)
        axis.tick_params(labelsize=7)
        axis.set_xlim(0.0, max(1.0, *(stretch for stretch, _ in drawn)) * position[-1])
    axes[-1, 0].set_xlabel("position, mm", fontsize=7)
    if drawn:
        axes[1, 0].legend(fontsize=6, frameon=False)
    return encode_figure(figure)
