"""Make model/data/skin_percentiles.csv: color of measured skin per band of the typology angle.

    python tools/make_skin_percentiles.py WORKBOOK.xlsx [OUT.csv]

WORKBOOK is that of the International Skin Spectra Archive (ISSA), ISSA_17_Jan_2025_Yan_Lu.xlsx of
doi:10.6084/m9.figshare.28228571.v4. Reading it takes openpyxl, which skinrig does not require.
Every spectrum whose samples from 400 to 700 nm are complete counts; none is excluded by hand.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import numpy as np

from model import skin_tone, spectra
from model.arrays import Float64Array
from model.skin_tone.measured import ALL_BANDS, COLOR_QUANTITIES, TABLE_PERCENTILES

FIRST_ROW, FIRST_COLUMN, COUNT = 12, 13, 43  # of the spectra in sheet ISSA
WAVELENGTH_NM = np.arange(360.0, 781.0, 10.0)
TARGET = Path("model/data/skin_percentiles.csv")


def read_workbook(path: Path) -> tuple[Float64Array, list[str]]:
    """Return spectra at 400 to 700 nm, (n, 31), NaN where not measured, and their subjects."""
    try:
        import openpyxl
    except ModuleNotFoundError as error:
        raise SystemExit("openpyxl: not installed; `pip install openpyxl` to read ISSA") from error
    if not path.is_file():
        raise SystemExit(f"{path}: not found, expected ISSA's workbook (.xlsx)")
    book = openpyxl.load_workbook(path, read_only=True)
    if "ISSA" not in book.sheetnames:
        raise SystemExit(f"{path}: got sheets {book.sheetnames}, expected one named ISSA")
    rows, subjects = [], []
    for index, cells in enumerate(book["ISSA"].iter_rows(values_only=True)):
        samples = cells[FIRST_COLUMN : FIRST_COLUMN + COUNT]
        if index == FIRST_ROW - 1 and list(samples) != WAVELENGTH_NM.tolist():
            raise SystemExit(f"{path}: got columns {samples}, expected 360 to 780 nm by 10")
        if index >= FIRST_ROW and isinstance(cells[0], int | float):
            rows.append([x if isinstance(x, int | float) else np.nan for x in samples])
            subjects.append(f"{cells[1]}-{cells[2]}")
    visible = np.isin(WAVELENGTH_NM, spectra.WAVELENGTH_NM)
    return np.array(rows, np.float64)[:, visible] / 100.0, subjects


def measure(lab: Float64Array) -> Float64Array:
    """Return the columns of `COLOR_QUANTITIES` of L*a*b*, (n, 6)."""
    hue, chroma = skin_tone.hue_chroma(lab)
    return np.column_stack([lab, chroma, hue, skin_tone.ita(lab)])


def table(reflectance: Float64Array, subjects: list[str]) -> list[str]:
    """Return the lines of the table, the columns' names first."""
    columns = measure(skin_tone.lab_of_spectra(reflectance))
    band = skin_tone.ita_band(columns[:, COLOR_QUANTITIES.index("ita_deg")])
    lines = [
        ",".join(
            ["band", "quantity", "spectra", "subjects", *(f"p{p:g}" for p in TABLE_PERCENTILES)]
        )
    ]
    who = np.array(subjects)
    for number, name in enumerate((*skin_tone.ITA_BANDS, ALL_BANDS), 1):
        kept = np.ones(len(band), bool) if name == ALL_BANDS else band == number
        for column, quantity in enumerate(COLOR_QUANTITIES):
            values = np.percentile(columns[kept, column], TABLE_PERCENTILES)
            counts = [str(np.count_nonzero(kept)), str(len(set(who[kept])))]
            lines.append(",".join([name, quantity, *counts, *(f"{x:.2f}" for x in values)]))
    return lines


def main(arguments: list[str]) -> int:
    if not 1 <= len(arguments) <= 2:
        raise SystemExit("usage: python tools/make_skin_percentiles.py WORKBOOK.xlsx [OUT.csv]")
    source = Path(arguments[0])
    target = Path(arguments[1]) if len(arguments) == 2 else TARGET
    reflectance, subjects = read_workbook(source)
    complete = np.isfinite(reflectance).all(axis=1)
    kept = [subject for subject, there in zip(subjects, complete, strict=True) if there]
    digest = hashlib.md5(source.read_bytes(), usedforsecurity=False).hexdigest()
    header = [
        "Color of measured human skin: percentiles of CIE L*, a*, b*, chroma, hue and individual",
        "typology angle (ITA), degrees, per ITA band: I > 55, II 41-55, III 28-41, IV 10-28,",
        "V -30-10, VI < -30, and over all bands. D65, CIE 1931 observer, 400 to 700 nm by 10;",
        "sphere geometry d/8 with the specular reflection included.",
        "Statistics of: Lu, Xiao, Pointer et al. 2025, The International Skin Spectra Archive",
        "(ISSA): a multicultural human skin phenotype and colour spectra collection, Scientific",
        "Data 12, 487, doi:10.1038/s41597-025-04857-5; data doi:10.6084/m9.figshare.28228571.v4,",
        "license CC BY 4.0 (https://creativecommons.org/licenses/by/4.0/). Changed: colors are",
        "computed from the spectra, and percentiles replace records. This table: CC BY 4.0, too.",
        f"Workbook {source.name}, MD5 {digest}:",
        f"{len(subjects)} records, {len(kept)} complete from 400 to 700 nm. A subject can be in",
        "several bands. Made by tools/make_skin_percentiles.py.",
    ]
    lines = [*(f"# {line}" for line in header), *table(reflectance[complete], kept)]
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{target}: {len(kept)} spectra of {len(set(kept))} subjects")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
