"""Skin reflectance model: basis BRDFs of the surface, diffuse albedo and translucency.

Reflected light is the sum of the surface reflection, a mixture of tabulated basis BRDFs, and of
subsurface scattering. The tables include the Fresnel reflectance F_r, which is applied nowhere
else. Entering light is multiplied once by the transmittance F_t of its direction, exiting light
once by that of the view.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, sections 3 and 9 (the dome of 2005).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model import fresnel, translucency_population
from model.arrays import BoolArray, Float32Array, Float64Array
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.checks import Checks
from model.checks.files import read_arrays
from model.dipole.maps import DipoleMaps
from model.skin import SkinAppearance, SkinMap

BASIS_FILE = "brdf_basis.npz"
WEIGHT_PREFIX = "basis_weight_"
"""Prefix of the maps of lobe weights; their number from 0 on follows."""
TRANSLUCENCY_MAP = "translucency"
NORMAL_MAPS = ("normals_refined", "normals")
"""Maps of normals, the better one first."""
_CHUNK_DIRECTIONS = 1 << 16  # directions per block of look-ups


class SkinReflectanceError(ValueError):
    """Error for maps that do not make a reflectance model."""


@dataclass(frozen=True, slots=True, eq=False)
class SkinReflectance:
    """Reflectance of skin over a texture.

    Values of texels that are not `valid` are filled from their surroundings, or 0: for rendering,
    not for statistics.

    Attributes
    ----------
    r_d : ndarray of float32, shape (H, W, 3)
        Factor of the diffuse part, f = R_d F_t(light) F_t(view) / pi, camera RGB over a perfect
        white. Not clamped: see `dipole`.
    weights : ndarray of float32, shape (H, W, K)
        Weights of the lobes, at least 0.
    lobes : BrdfBasis
        K lobes, 1/sr, including F_r.
    translucency_mm : ndarray of float32, shape (H, W, 3)
        1/sigma_tr, mm, above 0.
    normals : ndarray of float32, shape (H, W, 3)
        Unit vectors, rig frame, outward.
    position_mm : ndarray of float32, shape (H, W, 3)
        Rig frame.
    valid : ndarray of bool, shape (H, W)
        Texels where all maps are known.
    eta : float
        Refractive index of the skin over that of air, at least 1.
    assumed : tuple of str
        Assumptions in place of missing measurements.
    r_d_stderr, translucency_stderr_mm : ndarray of float32, shape (H, W, 3), or None
        Standard errors; None: unknown.
    """

    r_d: Float32Array
    weights: Float32Array
    lobes: BrdfBasis
    translucency_mm: Float32Array
    normals: Float32Array
    position_mm: Float32Array
    valid: BoolArray
    eta: float = fresnel.ETA_SKIN
    assumed: tuple[str, ...] = ()
    r_d_stderr: Float32Array | None = None
    translucency_stderr_mm: Float32Array | None = None

    def __post_init__(self) -> None:
        """Raise for shapes that do not fit, and for impossible values at valid texels."""
        shape = np.shape(self.valid)
        Checks(SkinReflectanceError).mask("valid", self.valid, ("H", "W"))
        known = ("r_d", "weights", "translucency_mm", "normals", "position_mm")
        for name in (*known, "r_d_stderr", "translucency_stderr_mm"):
            channels = self.lobes.size if name == "weights" else 3
            if (given := getattr(self, name)) is None:
                continue
            values = np.asarray(given, np.float32)
            Checks(SkinReflectanceError).shape(name, values, (*shape, channels))
            if name in known:
                _require(name, np.isfinite(values).all(-1) | ~self.valid, "finite values")
            object.__setattr__(self, name, values)
        _require("weights", (self.weights >= 0).all(-1) | ~self.valid, "values of at least 0")
        _require(
            "translucency_mm", (self.translucency_mm > 0).all(-1) | ~self.valid, "values above 0"
        )
        length = np.linalg.norm(self.normals, axis=-1)
        _require("normals", (np.abs(length - 1.0) < 1e-3) | ~self.valid, "unit vectors")
        Checks(SkinReflectanceError).within("eta", self.eta, "[1, inf)")

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of the texture."""
        height, width = self.valid.shape
        return int(height), int(width)

    def dipole(self) -> DipoleMaps:
        """Return the coefficients of the diffusion dipole, section 9; R_d > 1 is masked there."""
        return DipoleMaps.of(self.r_d, self.translucency_mm, eta=self.eta, valid=self.valid)


def assemble(
    dome: SkinAppearance, *, translucency: ArrayLike | SkinMap | None = None
) -> SkinReflectance:
    """Assemble the model from the maps of a dome session.

    Parameters
    ----------
    dome
        With maps `position`, `r_d`, `normals_refined` or `normals`, `basis_weight_0` and on, and
        the file `brdf_basis.npz`.
    translucency
        1/sigma_tr, mm: a map over the same texture coordinates, of any size, or values that
        broadcast to (H, W, 3). None: the map `translucency` of the appearance; without one the mean
        of table 2 over people and sites, which `assumed` then lists.

    Returns
    -------
    SkinReflectance

    Raises
    ------
    SkinReflectanceError
        For a map or file that is missing or does not fit; names it.
    """
    needed = ("position", "r_d", f"{WEIGHT_PREFIX}0")
    for name in needed:
        _map(dome, name)
    lobes = load_basis(dome)
    names = [f"{WEIGHT_PREFIX}{k}" for k in range(lobes.size)]
    found = next((name for name in NORMAL_MAPS if name in dome.maps), None)
    if found is None:
        raise SkinReflectanceError(
            f"maps: got none of {' and '.join(NORMAL_MAPS)}; `skinrig reconstruct --maps normals` "
            "makes them"
        )
    used = ["position", "r_d", found, *names]
    maps = [_normals(dome) if name == found else _map(dome, name) for name in used]
    shape = maps[0].values.shape[:2]
    valid = np.ones(shape, bool)
    for name, one in zip(used, maps, strict=True):
        if one.values.shape[:2] != shape:
            raise SkinReflectanceError(
                f"{name}: got shape {one.values.shape[:2]}, expected {shape} as of position"
            )
        valid &= one.mask
    position, r_d, normals, *shares = maps
    # weights are at least 0 at the points; extrapolated to texels beyond the rim they can
    # undershoot
    weights = np.maximum(np.stack([one.values for one in shares], axis=-1), 0.0)
    length = np.linalg.norm(normals.values, axis=-1, keepdims=True)
    valid &= (length[..., 0] > 0.5) & np.isfinite(r_d.values).all(-1)
    assumed: tuple[str, ...] = ()
    if translucency is None and TRANSLUCENCY_MAP in dome.maps:
        translucency = dome.maps[TRANSLUCENCY_MAP]
        listed = dome.parameters.get("assumed", [])
        assumed = tuple(str(one) for one in listed) if isinstance(listed, list | tuple) else ()
    if translucency is None:
        translucency, what = population_mean_mm()
        assumed = (what,)
    depth, depth_stderr, known = _resample_translucency(translucency, shape)
    valid &= known
    return SkinReflectance(
        r_d=r_d.values,
        weights=weights,
        lobes=lobes,
        translucency_mm=depth,
        normals=np.where(length > 0, normals.values / np.maximum(length, 1e-9), (0, 0, 1)),
        position_mm=position.values,
        valid=valid,
        assumed=assumed,
        r_d_stderr=r_d.stderr,
        translucency_stderr_mm=depth_stderr,
    )


def population_mean_mm() -> tuple[Float64Array, str]:
    """Return 1 over the mean sigma_tr of table 2 over its sites, mm, (3,), and its description."""
    people = translucency_population.weyrich_2005()
    mean = people.mean_per_mm.mean(axis=0)
    mean_text = ", ".join(f"{value:.3f}" for value in mean)
    return 1.0 / mean, (
        f"translucency is the population's: sigma_tr {mean_text} per mm, the mean over people and "
        f"{', '.join(people.sites)} (Weyrich et al. 2005, table 2)"
    )


def load_basis(appearance: SkinAppearance) -> BrdfBasis:
    """Return the lobes whose weights are the maps `basis_weight_0` and on.

    Raises
    ------
    SkinReflectanceError
        When the file is missing or damaged, or lacks a map for one of its lobes.
    """
    if BASIS_FILE not in appearance.files:
        raise SkinReflectanceError(
            f"files: got no {BASIS_FILE}; `skinrig reconstruct --maps {WEIGHT_PREFIX}0` makes it"
        )
    try:
        stored = read_arrays(appearance.files[BASIS_FILE])
        table, radius = stored["table"], float(stored["light_radius_rad"])
    except KeyError as error:
        raise SkinReflectanceError(
            f"{BASIS_FILE}: {error.args[0]}; an older version made it: reconstruct the maps again"
        ) from error
    except (ValueError, TypeError) as error:
        raise SkinReflectanceError(f"{BASIS_FILE}: cannot be read: {error}") from error
    if table.ndim != 4 or not table.shape[-1]:
        raise SkinReflectanceError(
            f"{BASIS_FILE}: got a table of shape {table.shape}, expected lobes on its last axis"
        )
    names = [f"{WEIGHT_PREFIX}{k}" for k in range(table.shape[-1])]
    for name in names:
        _map(appearance, name)
    return brdf_tables.basis_from_columns(table, names, light_radius_rad=radius)


def lobe_brdf(
    lobes: BrdfBasis,
    weights: ArrayLike,
    light_dir: ArrayLike,
    view_dir: ArrayLike,
    normals: ArrayLike,
) -> Float64Array:
    """Return a mixture of lobes, (n,), 1/sr; weights (n, K), for interpolated or edited ones."""
    share = np.asarray(weights, np.float64)
    to = [np.broadcast_to(v, (len(share), 3)) for v in (light_dir, view_dir, normals)]
    found = np.empty(len(share))
    for start in range(0, len(share), _CHUNK_DIRECTIONS):
        part = slice(start, start + _CHUNK_DIRECTIONS)
        found[part] = np.einsum("nk,nk->n", lobes.evaluate(*(v[part] for v in to)), share[part])
    return found


def transmittance(cosine: ArrayLike, eta: float = fresnel.ETA_SKIN) -> Float64Array:
    """Return the transmittance F_t of the surface at a cosine; 0 below the horizon.

    Examples
    --------
    >>> transmittance([1.0, -0.2]).round(4).tolist()
    [0.9722, 0.0]
    """
    mu = np.asarray(cosine, np.float64)
    passed = 1.0 - fresnel.reflectance(np.clip(mu, 0.0, 1.0), eta)
    return np.asarray(np.where(mu > 0.0, passed, 0.0))


def _require(name: str, good: BoolArray, expected: str) -> None:
    if not good.all():
        row, column = np.argwhere(~good)[0]
        raise SkinReflectanceError(
            f"{name}: expected {expected}, got others at {np.count_nonzero(~good)} valid texels, "
            f"the first in row {row}, column {column}"
        )


def _map(appearance: SkinAppearance, name: str) -> SkinMap:
    if name not in appearance.maps:
        raise SkinReflectanceError(
            f"maps: got no {name!r}; `skinrig reconstruct --maps {name}` makes it"
        )
    return appearance.maps[name]


def _normals(appearance: SkinAppearance) -> SkinMap:
    """Return the better normals, and the others where those are missing."""
    there = [appearance.maps[name] for name in NORMAL_MAPS if name in appearance.maps]
    if len(there) == 1 or there[0].values.shape != there[1].values.shape:
        return there[0]
    best, other = there
    good = best.mask
    return SkinMap(
        np.where(good[..., None], best.values, other.values),
        best.unit,
        valid=good | other.mask,
        description=best.description,
    )


def _resample_translucency(
    given: ArrayLike | SkinMap, shape: tuple[int, ...]
) -> tuple[Float32Array, Float32Array | None, BoolArray]:
    """Return a translucency resampled to a shape, its standard error, and the valid mask."""
    if isinstance(given, SkinMap):
        Checks(SkinReflectanceError).shape("translucency", given.values, ("H", "W", 3))
        known = _resample_image(given.mask.astype(np.float32)[..., None], shape)[..., 0] > 0.999
        stderr = None if given.stderr is None else _resample_image(given.stderr, shape)
        return _resample_image(given.values, shape), stderr, known
    values = np.asarray(given, np.float32)
    even = Checks(SkinReflectanceError).broadcast("translucency", values, (*shape, 3))
    Checks(SkinReflectanceError).within("translucency", values, "(0, inf)")
    return even.copy(), None, np.ones(shape, bool)


def _resample_image(image: Float32Array, shape: tuple[int, ...]) -> Float32Array:
    """Return (h, w, C) at the texels of another size: linear, clamped to the outermost texels."""
    for axis, size in enumerate(shape):
        old = image.shape[axis]
        if old == size:
            continue
        place = np.clip((np.arange(size) + 0.5) * old / size - 0.5, 0.0, old - 1.0)
        low = np.minimum(place.astype(np.intp), max(old - 2, 0))
        part = (place - low).astype(np.float32).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        high = np.minimum(low + 1, old - 1)
        image = image.take(low, axis) * (1.0 - part) + image.take(high, axis) * part
    return image
