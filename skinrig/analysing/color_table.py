"""Write the table of skin colors over melanin and blood (figure 9 of Jimenez 2010), or check one.

The table of eq. (7) is built for an observer, a light and a skin, or read from a file. Table 1's
four parameters are the two axes and two properties of the skin: the fraction of eumelanin, beta_m,
and the blood of the epidermis as a ratio to that of the dermis, C_he / C_hd.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import color_table, spectra
from model.color_table import ColorTable
from model.color_table_file import read_color_table, write_color_table
from model.tissue_optics.constants import PAPER_CONSTANTS, SKIN_CONSTANTS, TissueConstants
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.arrays import Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.errors import UnusableError, require_choice

SCHEMA: Final = "skinrig.color-table-report/1"
TISSUE_OPTICS: Final[dict[str, tuple[TissueConstants, float]]] = {
    "skin": (SKIN_CONSTANTS, ANISOTROPY_SKIN),
    "papers": (PAPER_CONSTANTS, 0.0),
}
"""Constants and mean cosine of scattering by name."""
MAX_EPIDERMAL_BLOOD: Final = 0.1
"""End of C_he, volume fraction (Jimenez 2010, Table 1)."""
MAX_NODES: Final = 512
OUTPUT_FILES: Final = ("color-table.exr", "color-table.csv", "figure-9.png", "color-table.json")


def build_table(
    *,
    camera: str = spectra.LINEAR_SRGB,
    illuminant: str = "D65",
    tissue: str = "skin",
    size: int = 64,
    eumelanin_fraction: float | None = None,
    epidermal_blood_ratio: float | None = None,
) -> ColorTable:
    """Build the table of a skin.

    Parameters
    ----------
    camera, illuminant
        Names known to `model.spectra`.
    tissue
        Name in `TISSUE_OPTICS`.
    size
        Nodes of each axis, 8 to `MAX_NODES`.
    eumelanin_fraction, epidermal_blood_ratio
        beta_m, 0 to 1, and C_he / C_hd, such that C_he is at most `MAX_EPIDERMAL_BLOOD`; None: the
        tissue's.

    Raises
    ------
    UnusableError, ColorTableError, SpectrumNameError
        For a value outside its range.
    """
    constants, anisotropy = TISSUE_OPTICS[require_choice("--tissue", tissue, tuple(TISSUE_OPTICS))]
    if not 8 <= size <= MAX_NODES:
        raise UnusableError(f"--size: got {size}, expected 8 to {MAX_NODES} nodes; change it")
    if eumelanin_fraction is not None and not 0.0 <= eumelanin_fraction <= 1.0:
        raise UnusableError(
            f"--eumelanin-fraction: got {eumelanin_fraction:g}, expected 0 to 1; change it"
        )
    most = MAX_EPIDERMAL_BLOOD / C_HD_MAX
    if epidermal_blood_ratio is not None:
        if not 0.0 <= epidermal_blood_ratio <= most:
            raise UnusableError(
                f"--epidermal-blood-ratio: got {epidermal_blood_ratio:g}, expected 0 to {most:g} "
                f"(C_he at most {MAX_EPIDERMAL_BLOOD:g}); change it"
            )
        constants = replace(constants, epidermal_blood_ratio=epidermal_blood_ratio)
    return color_table.build(
        camera,
        illuminant,
        size=size,
        anisotropy=anisotropy,
        constants=constants,
        beta_m=eumelanin_fraction,
    )


def analyze_table(out: Path, table: ColorTable | Path) -> dict[str, Any]:
    """Write a table as image and CSV with figure 9, and read both back.

    Parameters
    ----------
    out
        Folder for `OUTPUT_FILES`.
    table
        A table, or its file.

    Returns
    -------
    dict
        JSON values: description, range of colors, largest differences of the files read back.

    Raises
    ------
    ColorTableError, StoreError
        For a file that is not a table.
    """
    origin = str(table) if isinstance(table, Path) else "built"
    made = read_color_table(table) if isinstance(table, Path) else table
    out.mkdir(parents=True, exist_ok=True)
    lost = {}
    for name in OUTPUT_FILES[:2]:
        part = out / f".part-{name}"
        try:
            write_color_table(part, made)
            lost[name] = float(np.abs(read_color_table(part).rgb / made.rgb - 1.0).max())
            part.replace(out / name)
        finally:
            part.unlink(missing_ok=True)
    document = {
        "schema": SCHEMA,
        "origin": origin,
        "camera": made.camera,
        "illuminant": made.illuminant,
        "nodes": made.size,
        "c_m_max": made.c_m_max,
        "c_hd_max": made.c_hd_max,
        "eumelanin_fraction": made.constants.eumelanin_fraction,
        "epidermal_blood_ratio": made.constants.epidermal_blood_ratio,
        "lightest_rgb": made.rgb[0, 0].tolist(),
        "darkest_rgb": made.rgb[-1, -1].tolist(),
        "relative_loss": lost,
    }
    write_atomically(out / OUTPUT_FILES[2], _draw(made.rgb))
    write_atomically(out / OUTPUT_FILES[3], json.dumps(document, indent=1))
    return document


def _draw(rgb: Float64Array) -> bytes:
    """Draw the table with melanin to the right and blood upwards, display gamma 2.2."""
    figure, axes = new_figure(4.4, 4.0, 1, 1)
    shown = np.clip(rgb.transpose(1, 0, 2) / rgb.max(), 0.0, 1.0) ** (1.0 / 2.2)
    axes[0, 0].imshow(shown, origin="lower", extent=(0.0, 1.0, 0.0, 1.0))
    axes[0, 0].set_xlabel("u: cube root of melanin over its maximum", fontsize=8)
    axes[0, 0].set_ylabel("v: cube root of blood over its maximum", fontsize=8)
    axes[0, 0].tick_params(labelsize=7)
    return encode_figure(figure)
