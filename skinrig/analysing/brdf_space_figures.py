"""Plot the space of surface BRDFs: error against rank, and mean BRDFs on spheres."""

import io
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from model.brdf.tables import BrdfBasis
from reconstruction import brdf_basis
from reconstruction.brdf_basis.space import SpaceCurve
from skinrig.arrays import Float64Array

SPHERE_LIGHTS: Final = (
    ((-0.5, 0.5, 0.70710678), "light from the left"),
    ((0.85, 0.35, -0.39), "light from behind right"),
)
"""Light directions of the spheres, each with its label."""
SPHERE_PX: Final = 160
DISPLAY_GAMMA: Final = 2.2
SPHERE_WHITE_PERCENTILE: Final = 99.0
"""Percentile of all spheres' lit pixels that is rendered white."""


def curves(found: Mapping[str, SpaceCurve]) -> bytes:
    """Plot errors against rank, each relative to the error of rank 1.

    Parameters
    ----------
    found
        Curves by name.

    Returns
    -------
    bytes
        PNG. In-sample errors have solid lines, held-out errors dashed lines; a ring marks the
        plateau.
    """
    figure, axes = new_figure(6.4, 4.0, 1, 1)
    plot = axes[0, 0]
    for name, curve in found.items():
        scale = curve.error[0] if curve.error[0] > 0.0 else 1.0
        (line,) = plot.plot(curve.ranks, curve.error / scale, "o-", ms=3, lw=1.2, label=name)
        color = line.get_color()
        plot.plot(curve.ranks, curve.held_out / scale, "--", lw=1.0, color=color)
        rank = curve.plateau_rank()
        at = curve.error[curve.ranks.index(rank)] / scale
        plot.plot([rank], [at], "o", ms=10, mfc="none", mec=color)
        above = {"xytext": (0, 8), "textcoords": "offset points", "ha": "center"}
        plot.annotate(str(rank), (rank, at), color=color, fontsize=8, **above)
    plot.set_xlabel("common mixtures")
    plot.set_ylabel("error relative to that of one basis BRDF")
    plot.set_ylim(bottom=0.0)
    plot.set_title("Error against number of basis BRDFs (dashed: held out)", fontsize=10)
    plot.legend(fontsize=8, frameon=False)
    return encode_figure(figure)


def draw_spheres(means: Mapping[str, Float64Array], basis: BrdfBasis) -> bytes:
    """Render mean BRDFs on spheres under two light directions.

    Parameters
    ----------
    means
        Weights of the materials by label, (K,).
    basis
        Basis BRDFs of the K materials.

    Returns
    -------
    bytes
        PNG; all spheres share one exposure and a gamma of 2.2.
    """
    pictures = render_spheres(means, basis)
    shown = np.concatenate([p[p > 0.0] for row in pictures.values() for p in row])
    white = float(np.percentile(shown, SPHERE_WHITE_PERCENTILE)) if len(shown) else 1.0
    count = max(len(means), 1)
    figure, axes = new_figure(1.25 * count + 0.3, 3.0, len(SPHERE_LIGHTS), count)
    for place in axes.flat:
        place.axis("off")
    for column, (name, row) in enumerate(pictures.items()):
        for k, picture in enumerate(row):
            level = np.clip(picture / white, 0.0, 1.0) ** (1.0 / DISPLAY_GAMMA)
            axes[k, column].imshow(level, cmap="gray", vmin=0.0, vmax=1.0)
        axes[0, column].set_title(name, fontsize=8)
    return encode_figure(figure)


def render_spheres(
    means: Mapping[str, Float64Array], basis: BrdfBasis
) -> dict[str, tuple[Float64Array, ...]]:
    """Render each label's sphere under each of `SPHERE_LIGHTS`, (SPHERE_PX, SPHERE_PX), 1/sr."""
    return {
        name: tuple(
            brdf_basis.render_lit_sphere(shares, basis, light_dir=way, size_px=SPHERE_PX)
            for way, _ in SPHERE_LIGHTS
        )
        for name, shares in means.items()
    }


def new_figure(width_in: float, height_in: float, rows: int, columns: int) -> tuple[Any, Any]:
    """Create a figure with (rows, columns) axes; sizes in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def encode_figure(figure: Any, dpi: int = 140) -> bytes:
    """Encode a figure as the bytes of a PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()
