"""Flat calibration targets at the position of the subject's face."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal

import numpy as np

from model import spectra
from rigsim.arrays import Float32Array, Float64Array, Int32Array
from rigsim.geometry.mesh import Mesh, build_mesh

WAVELENGTH_NM: Final[Float64Array] = spectra.WAVELENGTH_NM
"""Wavelengths at which targets are described, nm."""

WHITE_REFLECTANCE: Final = 0.99
"""Diffuse reflectance of pressed PTFE in the visible, Weidner and Hsia 1981,
doi:10.1364/JOSA.71.000856."""

PATCH_PITCH_MM: Final = 27.0
PATCH_MM: Final = 23.5
"""Distance and side of the chart's patches; their ratio is that of a ColorChecker Classic."""
CHART_FRAME_MM: Final = 6.0
CHART_ROWS, CHART_COLUMNS = 4, 6
FRAME_REFLECTANCE: Final = 0.035  # black print between the patches
BACKDROP_REFLECTANCE: Final = 0.35  # gray board behind the chart


class TargetError(KeyError, ValueError):
    """Error for an unknown target name."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A flat target across the camera's axis, or light straight into the camera.

    A ``diffuse`` target is Lambertian and depolarizes; a ``metal`` one reflects by rough metallic
    facets, which keep polarization; ``source`` is the port of an integrating sphere, which fills
    the image evenly with unpolarized light of the flash's color; ``cap`` is a lens cap.
    """

    name: str
    """Name, one of `TARGET_NAMES`."""
    kind: Literal["diffuse", "metal", "source", "cap"]
    """Kind of reflection, see above."""
    mesh: Mesh
    """A rectangle in mm, rig frame."""
    palette: Float64Array
    """Reflectance spectra, shape (P, n_wavelength), 0 to 1."""
    index: Int32Array
    """Entry of the palette under each texel, shape (N, N); row 0 is the top."""
    alpha: float
    """GGX roughness of metal; 0 for the other kinds."""

    def rgb(self, camera: str, light: str) -> Float32Array:
        """Return the white-balanced camera RGB under each texel, shape (N, N, 3).

        Parameters
        ----------
        camera, light
            Names of `model.spectra`.
        """
        colors = spectra.band_average(self.palette, camera, light, wavelength_nm=WAVELENGTH_NM)
        return np.asarray(colors[self.index], np.float32)


def make_target(name: str) -> Target:
    """Make a calibration target by name.

    Parameters
    ----------
    name
        "white" (tile of pressed PTFE that fills the field), "chart" (24 patches), "malus" (rough
        metal, keeps polarization), "flat" (integrating sphere), "dark" (lens cap).

    Returns
    -------
    Target
        The target.

    Raises
    ------
    TargetError
        When the name is unknown.

    Examples
    --------
    >>> make_target("white").rgb("Nikon 5100 (NPL)", "D55")[0, 0].round(2).tolist()
    [0.9900000095367432, 0.9900000095367432, 0.9900000095367432]
    """
    if name not in _TARGET_MAKERS:
        raise TargetError(f"target: got {name!r}, expected one of {', '.join(TARGET_NAMES)}")
    return _TARGET_MAKERS[name]()


def patch_centers_mm() -> Float64Array:
    """Return the centers of the chart's patches, (24, 2): x, y in mm, row-major from the top."""
    x = (np.arange(CHART_COLUMNS) - 0.5 * (CHART_COLUMNS - 1)) * PATCH_PITCH_MM
    y = (0.5 * (CHART_ROWS - 1) - np.arange(CHART_ROWS)) * PATCH_PITCH_MM
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1).reshape(-1, 2)


@cache
def chart_reflectances() -> Float64Array:
    """Return the reflectances of the chart's 24 patches, shape (24, n_wavelength), row-major.

    References
    ----------
    BabelColor average of 30 charts (D. Pascale, "RGB coordinates of the ColorChecker", 2006), as
    distributed with colour-science.
    """
    import colour

    patches = colour.SDS_COLOURCHECKERS["BabelColor Average"]
    rows = []
    for patch in patches.values():
        nodes = np.asarray(patch.wavelengths, np.float64)
        rows.append(np.interp(WAVELENGTH_NM, nodes, np.asarray(patch.values, np.float64)))
    if len(rows) != CHART_ROWS * CHART_COLUMNS:
        raise TargetError(f"chart: got {len(rows)} patches from colour-science, expected 24")
    return np.array(rows)


def _plate(half_width_mm: float, half_height_mm: float) -> Mesh:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    vertices = np.column_stack([corners * [half_width_mm, half_height_mm], np.zeros(4)])
    return build_mesh(vertices, [[0, 1, 2], [0, 2, 3]], 0.5 * (corners + 1.0))


def _even(
    name: str, kind: Literal["diffuse", "metal", "source", "cap"], reflectance: float, alpha: float
) -> Target:
    palette = np.full((1, WAVELENGTH_NM.size), reflectance)
    return Target(name, kind, _plate(220.0, 220.0), palette, np.zeros((8, 8), np.int32), alpha)


def _chart(*, texels: int = 2048) -> Target:
    half_mm = 220.0
    middle = ((np.arange(texels) + 0.5) / texels - 0.5) * 2.0 * half_mm
    x, y = middle[None, :], -middle[:, None]
    width = CHART_COLUMNS * PATCH_PITCH_MM + 2.0 * CHART_FRAME_MM
    height = CHART_ROWS * PATCH_PITCH_MM + 2.0 * CHART_FRAME_MM
    index = np.full((texels, texels), 25, np.int32)
    index[(np.abs(x) < 0.5 * width) & (np.abs(y) < 0.5 * height)] = 24
    for patch, (px, py) in enumerate(patch_centers_mm()):
        index[(np.abs(x - px) < 0.5 * PATCH_MM) & (np.abs(y - py) < 0.5 * PATCH_MM)] = patch
    even = np.ones(WAVELENGTH_NM.size)
    board = np.stack([FRAME_REFLECTANCE * even, BACKDROP_REFLECTANCE * even])
    palette = np.concatenate([chart_reflectances(), board])
    return Target("chart", "diffuse", _plate(half_mm, half_mm), palette, index, 0.0)


_TARGET_MAKERS: Final[Mapping[str, Callable[[], Target]]] = {
    "white": lambda: _even("white", "diffuse", WHITE_REFLECTANCE, 0.0),
    "chart": _chart,
    "malus": lambda: _even("malus", "metal", 0.42, 0.45),
    "flat": lambda: _even("flat", "source", 1.0, 0.0),
    "dark": lambda: _even("dark", "cap", 0.0, 0.0),
}

TARGET_NAMES: Final = tuple(_TARGET_MAKERS)
"""Names of the targets."""
