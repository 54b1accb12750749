"""Fit microstructure to caliper sessions: neutral relief and a table of stretch kernels."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from model.microstructure import FOREHEAD, KernelTable, KernelTableError
from model.skin import SkinAppearance, SkinMap
from reconstruction.kernel_fit.table import KernelTableFitError, fit_table
from reconstruction.pipeline.gradient.stages import KERNEL_FILE
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.appearances.contents import derive_appearance, hash_document
from skinrig.appearances.dynamic import MICROSTRUCTURE

SITE_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,31}")


class MicrostructureFitError(ValueError):
    """Maps of caliper sessions without a neutral relief or enough kernels for a table."""


@dataclass(frozen=True, slots=True)
class SiteFit:
    """Fitted microstructure of one site.

    Attributes
    ----------
    site
        Name of the site, part of file and map names.
    height
        Neutral relief, um.
    pixel_um
        Pixel size of the relief on the skin, um.
    table
        Kernel parameters over the stretch ratio.
    kernels
        Number of fitted kernels of the table; 0: the paper's forehead table.
    alpha_rms, sigma_rms_um
        RMS residuals of the table's lines; None for the paper's table.
    """

    site: str
    height: SkinMap
    pixel_um: float
    table: KernelTable
    kernels: int
    alpha_rms: float | None
    sigma_rms_um: tuple[float, float] | None

    def document(self) -> dict[str, Any]:
        """Return the figures as JSON values."""
        return {
            "pixel_um": self.pixel_um,
            "map": f"microrelief_{self.site}",
            "table": f"kernel_table_{self.site}.json",
            "kernels": self.kernels,
            "stretch_range": list(self.table.stretch_range),
            "alpha_rms": self.alpha_rms,
            "sigma_rms_um": None
            if self.sigma_rms_um is None
            else [v if np.isfinite(v) else None for v in self.sigma_rms_um],
        }


def fit_microstructure(
    appearances: Sequence[Path], *, out: Path, paper_table: bool = False
) -> dict[str, SiteFit]:
    """Fit the microstructure part of a dynamic appearance and write it to `out`.

    Parameters
    ----------
    appearances
        APPEARANCE/ folders of caliper sessions with heights and kernels. ``SITE=FOLDER`` names the
        site, by default the folder's name. Folders of the same site share one table.
    out
        Folder of the dynamic appearance; its other parts are kept.
    paper_table
        Use the paper's forehead table where too few kernels were fitted; False: raise.

    Raises
    ------
    MicrostructureFitError
        If a folder lacks a map or enough kernels; the message names both.
    """
    dynamic_appearance.check_target(out)
    fits, part = fit_part(appearances, paper_table=paper_table)
    dynamic_appearance.add(out, MICROSTRUCTURE, part)
    return fits


def fit_part(
    appearances: Sequence[Path], *, paper_table: bool
) -> tuple[dict[str, SiteFit], SkinAppearance]:
    """Fit the microstructure of sites, without writing it.

    Parameters
    ----------
    appearances, paper_table
        See `fit_microstructure`.

    Returns
    -------
    fits
        By site.
    part
        Their reliefs and kernel tables.
    """
    if not appearances:
        raise MicrostructureFitError("appearances: got none, expected folders of caliper sessions")
    by_site: dict[str, list[tuple[Path, SkinAppearance]]] = {}
    for given in appearances:
        site, path = _parse_site(given)
        by_site.setdefault(site, []).append((path, store.read(path)))
    fits = {site: _fit_site(site, group, paper_table) for site, group in by_site.items()}
    why = "too few kernels were fitted; its kernel table is the paper's, of a forehead"
    part = derive_appearance(
        *(one for group in by_site.values() for _, one in group),
        maps={f"microrelief_{site}": fit.height for site, fit in fits.items()},
        files={f"kernel_table_{site}.json": f.table.to_json().encode() for site, f in fits.items()},
        parameters={"sites": {site: fit.document() for site, fit in fits.items()}},
        inputs={
            f"{site} {number}": hash_document(path)
            for site, group in by_site.items()
            for number, (path, _) in enumerate(group)
        },
        left_out=tuple((site, why) for site, fit in fits.items() if fit.kernels == 0),
    )
    return fits, part


def _parse_site(appearance: Path) -> tuple[str, Path]:
    site, equals, path = str(appearance).partition("=")
    if equals and SITE_PATTERN.fullmatch(site):
        folder = Path(path)
    else:
        folder = appearance
        site = re.sub(r"^appearance-?(gradient-?)?", "", appearance.name) or "skin"
    site = site.replace("-", "_").lower()
    if not SITE_PATTERN.fullmatch(site):
        raise MicrostructureFitError(
            f"{appearance}: got site {site!r}, expected a-z, 0-9 and _; name it as SITE={folder}"
        )
    return site, folder


def _fit_site(
    site: str, group: Sequence[tuple[Path, SkinAppearance]], paper_table: bool
) -> SiteFit:
    points: list[Mapping[str, Any]] = []
    for path, appearance in group:
        if KERNEL_FILE not in appearance.files:
            raise MicrostructureFitError(
                f"{path}: {KERNEL_FILE} is missing, expected a caliper session reconstructed with "
                "`skinrig reconstruct SESSION --maps height,kernels`"
            )
        document = json.loads(appearance.files[KERNEL_FILE])
        points += [fit for fit in document["fits"] if fit["valid"]]
    path, first = group[0]
    height, pixel_um = _neutral(path, first)
    try:
        found = fit_table(
            [fit["stretch_s"] for fit in points],
            [fit["alpha"] for fit in points],
            [fit["sigma_um"] for fit in points],
            source=f"{site}: {', '.join(p.name for p, _ in group)}",
        )
    except (KernelTableFitError, KernelTableError) as error:
        if not paper_table:
            raise MicrostructureFitError(
                f"{site}: {len(points)} fitted kernels are too few for a table ({error}); capture "
                "more strain steps (`--steps`), or use the paper's forehead with --paper-table"
            ) from error
        return SiteFit(site, height, pixel_um, FOREHEAD, 0, None, None)
    return SiteFit(
        site, height, pixel_um, found.table, len(points), found.alpha_rms, found.sigma_rms_um
    )


def _neutral(path: Path, appearance: SkinAppearance) -> tuple[SkinMap, float]:
    states = appearance.parameters.get("states")
    names = [str(s) for s in states] if isinstance(states, list) else []
    neutral = [name for name in names if name.endswith("_n0")]
    name = f"height_{neutral[0]}" if neutral else ""
    pixel_um = appearance.parameters.get("pixel_um")
    if name not in appearance.maps or not isinstance(pixel_um, int | float):
        raise MicrostructureFitError(
            f"{path}: neutral height is missing, expected a caliper session reconstructed "
            "with `--maps height,kernels`"
        )
    return appearance.maps[name], float(pixel_um)
