"""Separate diffuse from specular reflection by a parallel and a crossed image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from model.fresnel import ETA_SKIN
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray

MIN_CONTRAST = 0.05  # least crossed diffuse weight less the leak at which separation is possible


@dataclass(frozen=True, slots=True)
class PolarizerAxes:
    """Passing axes of the polarizers, unit vectors in the rig frame.

    Attributes
    ----------
    light : tuple of float
        Of the polarizers in front of the lights.
    parallel, crossed : tuple of float
        Of the camera's analyzer in its two states; both are in the plane of the polarizer.
    """

    light: tuple[float, float, float] = (0.0, 1.0, 0.0)
    parallel: tuple[float, float, float] = (0.0, 1.0, 0.0)
    crossed: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check lengths, and that the two states differ."""
        for name in ("light", "parallel", "crossed"):
            axis = np.asarray(getattr(self, name), dtype=np.float64)
            if axis.shape != (3,) or abs(float(axis @ axis) - 1.0) > 1e-5:
                raise ValueError(
                    f"PolarizerAxes.{name}: got {axis.tolist()}, expected a unit vector; "
                    "divide by its length"
                )
        if np.linalg.norm(np.cross(self.parallel, self.crossed)) < 0.5:
            raise ValueError(
                f"PolarizerAxes: got parallel {self.parallel} and crossed {self.crossed}, expected "
                "axes that differ; correct the rig's analyzer states"
            )


@dataclass(frozen=True, slots=True)
class Separation:
    """Diffuse and specular parts of a surface's reflection.

    Attributes
    ----------
    diffuse : ndarray, shape (..., C)
        Total unpolarized diffuse radiance, as the camera would record it without its analyzer.
        NaN where not `valid`.
    specular : ndarray, shape (..., C)
        Specular radiance transmitted by the parallel analyzer. May be negative by noise; NaN where
        not `valid`.
    stderr : ndarray, shape (..., C), or None
        Standard error of `diffuse`; None without a variance.
    stderr_specular : ndarray, shape (..., C), or None
        Standard error of `specular`.
    valid : ndarray of bool, shape (...)
        False where an image is saturated, masked or not finite, or where the surface is turned
        away from camera or light.
    """

    diffuse: FloatArray
    specular: FloatArray
    stderr: FloatArray | None
    stderr_specular: FloatArray | None
    valid: BoolArray


def separate(
    parallel: FloatArray,
    crossed: FloatArray,
    *,
    extinction: ArrayLike | None = None,
    normals: FloatArray | None = None,
    light_dir: ArrayLike | None = None,
    view_dir: ArrayLike | None = None,
    variance: FloatArray | tuple[FloatArray, FloatArray] | None = None,
    valid: BoolArray | None = None,
    saturation: float | None = None,
    leak_stderr: ArrayLike = 0.0,
    axes: PolarizerAxes | None = None,
    eta: float = ETA_SKIN,
) -> Separation:
    """Separate diffuse and specular radiance of a parallel and a crossed image.

    With ``s`` the specular radiance through the parallel analyzer, ``d`` the total diffuse
    radiance, ``k`` the part of ``s`` that also passes crossed and weights ``w`` near 1::

        parallel =   s + w_p d / 2
        crossed  = k s + w_c d / 2

    Parameters
    ----------
    parallel, crossed : ndarray of float, shape (..., C)
        Linear images of the same scene, exposure and light, black-subtracted, any unit.
    extinction : float or array_like, shape (C,) or broadcastable, optional
        Contrast of the polarizers, parallel over crossed, > 1 (1000 means k = 1e-3). None: ideal.
    normals : ndarray of float, shape (..., 3), optional
        Unit normals in the rig frame, with `view_dir`: corrects for the partial polarization of
        diffuse light at the exit (weights up to 14 % off 1 at 60 to 73 degrees).
    light_dir : array_like, shape (3,), (..., 3) or (L, 1, ..., 1, 3), optional
        Unit vectors to the light or the L lights of equal strength, away from the surface.
        Corrects `diffuse` to light that enters unpolarized (with `normals`), and `k` for
        reflection out of the plane of the axes (with `view_dir`).
    view_dir : array_like, shape (3,) or (..., 3), optional
        Unit vectors to the camera, away from the surface.
    variance : ndarray or pair of ndarray, shape (..., C), optional
        Variance of both images, or of parallel and crossed.
    valid : ndarray of bool, shape (...), optional
        Pixels to use.
    saturation : float, optional
        Value above which a pixel of either image counts as saturated.
    leak_stderr : float or array_like, shape (C,)
        Standard error of ``1 / extinction``; enters both standard errors.
    axes : PolarizerAxes, optional
        Default: lights and parallel analyzer vertical (+y), crossed analyzer horizontal.
    eta : float
        Refractive index of the surface.

    Returns
    -------
    Separation
        Of the images' floating type.

    Raises
    ------
    ValueError
        If shapes or ranges do not fit, or the polarizers do not separate at all.

    Notes
    -----
    Without `normals` the classic ``diffuse = 2 crossed``, ``specular = parallel - crossed`` results
    for ideal polarizers. The analyzer is assumed to transmit half of unpolarized light in both
    states; its leak adds the relative amount ``k``, which a white reference measured the same way
    cancels. Diffuse light is assumed to be unpolarized in the interior and refracted at a
    smooth surface (Atkinson and Hancock 2006, doi 10.1109/TIP.2006.871114).

    Examples
    --------
    >>> d, s = np.full((2, 2, 3), 0.4), np.full((2, 2, 3), 0.1)
    >>> out = separate(s + d / 2, 0.01 * s + d / 2, extinction=100.0)
    >>> out.diffuse[0, 0].round(6).tolist(), out.specular[0, 0].round(6).tolist()
    ([0.4, 0.4, 0.4], [0.1, 0.1, 0.1])
    """
    p, c = _images(parallel, crossed)
    kind = p.dtype
    leak = _leak(extinction, p.shape).astype(kind)
    polarizers = axes or PolarizerAxes()
    facing = np.ones(p.shape[:-1], dtype=bool)
    w_p = w_c = np.ones(1, dtype=kind)
    if normals is not None and view_dir is None:
        raise ValueError("normals: got them without view_dir, expected both or neither; add it")
    Checks().within("eta", eta, "(1, 4)")
    if view_dir is not None:
        v = _unit("view_dir", view_dir, kind)
        if light_dir is not None:
            leak = _tilted_leak(leak, _unit("light_dir", light_dir, kind), v, polarizers, eta)
        if normals is not None:
            n = _unit("normals", normals, kind)
            w_p, w_c, towards = _exit_weights(n, v, polarizers, eta)
            facing = facing & towards
    if normals is not None and light_dir is not None:
        n = _unit("normals", normals, kind)
        entry, lit = _entry_weight(n, _unit("light_dir", light_dir, kind), polarizers, eta)
        w_p, w_c = w_p * entry, w_c * entry
        facing = facing & lit
    contrast = w_c - leak * w_p
    if float(np.max(contrast)) < MIN_CONTRAST:
        raise ValueError(
            f"extinction: got a leak of {float(np.min(leak)):.3g}, expected one at which the two"
            " images differ enough to be separated; check the polarizers"
        )
    good = facing & np.isfinite(p).all(axis=-1) & np.isfinite(c).all(axis=-1)
    good &= np.broadcast_to((contrast >= MIN_CONTRAST).all(axis=-1), good.shape)
    if valid is not None:
        good &= valid
    if saturation is not None:
        with np.errstate(invalid="ignore"):
            good &= (p < saturation).all(axis=-1) & (c < saturation).all(axis=-1)
    blank = kind.type(np.nan)
    mask = good[..., None]
    safe = np.where(contrast >= MIN_CONTRAST, contrast, kind.type(1.0))
    p, c = np.where(mask, p, 0).astype(kind), np.where(mask, c, 0).astype(kind)
    diffuse = 2 * (c - leak * p) / safe
    specular = (w_c * p - w_p * c) / safe
    stderr = stderr_specular = None
    if variance is not None:
        var_p, var_c = _variances(variance, p.shape, kind)
        var_k = np.broadcast_to(np.asarray(leak_stderr, dtype=kind) ** 2, p.shape)
        # derivatives by k: d' = -2 s / (w_c - k w_p), s' = w_p s / (w_c - k w_p)
        with np.errstate(invalid="ignore"):  # 0 times a variance without bounds: not valid below
            var_d = 4 * (var_c + leak**2 * var_p + specular**2 * var_k) / safe**2
            var_s = (w_c**2 * var_p + w_p**2 * var_c + (w_p * specular) ** 2 * var_k) / safe**2
        known = mask & np.isfinite(var_d) & np.isfinite(var_s)
        good = good & known.all(axis=-1)
        mask = good[..., None]
        stderr = np.where(mask, np.sqrt(np.where(mask, var_d, 0)), blank).astype(kind)
        stderr_specular = np.where(mask, np.sqrt(np.where(mask, var_s, 0)), blank).astype(kind)
    return Separation(
        np.where(mask, diffuse, blank).astype(kind),
        np.where(mask, specular, blank).astype(kind),
        stderr,
        stderr_specular,
        good,
    )


def _images(parallel: FloatArray, crossed: FloatArray) -> tuple[FloatArray, FloatArray]:
    p, c = np.asarray(parallel), np.asarray(crossed)
    Checks().within("axes of parallel (..., C)", p.ndim, "[1, inf)")
    Checks().shape("crossed", c, p.shape)
    kind = np.result_type(p.dtype, c.dtype)
    if not np.issubdtype(kind, np.floating):
        raise ValueError(
            f"parallel, crossed: got {kind}, expected linear images of floating type; convert them"
        )
    return p.astype(kind, copy=False), c.astype(kind, copy=False)


def _leak(extinction: ArrayLike | None, shape: tuple[int, ...]) -> Float64Array:
    if extinction is None:
        return np.zeros(1)
    ratio = np.asarray(extinction, dtype=np.float64)
    Checks().within("extinction (parallel over crossed; inf if ideal)", ratio, "(1, inf]")
    leak = np.atleast_1d(1.0 / ratio)
    if np.broadcast_shapes(leak.shape, shape) != shape:
        raise ValueError(
            f"extinction: got shape {ratio.shape}, expected one that broadcasts to images of shape "
            f"{shape}; give one value per channel"
        )
    return leak


def _variances(
    variance: FloatArray | tuple[FloatArray, FloatArray], shape: tuple[int, ...], kind: np.dtype
) -> tuple[FloatArray, FloatArray]:
    pair = variance if isinstance(variance, tuple) else (variance, variance)
    out = []
    for one in pair:
        array = np.broadcast_to(np.asarray(one, dtype=kind), shape)
        Checks().require(not (array < 0).any(), "variance", "negative values", ">= 0")
        out.append(array)
    return out[0], out[1]


def _unit(name: str, vectors: ArrayLike, kind: np.dtype) -> FloatArray:
    array = np.asarray(vectors, dtype=kind)
    Checks().shape(name, array, ("...", 3))
    length = np.linalg.norm(array, axis=-1)
    known = np.isfinite(length)
    if not known.any() or np.abs(length[known] - 1.0).max() > 0.01:
        raise ValueError(f"{name}: got lengths other than 1, expected unit vectors; divide by them")
    return array


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray((a * b).sum(axis=-1))


def _normalized(a: FloatArray) -> FloatArray:
    return unit_vectors(a, min_length=np.finfo(a.dtype).tiny)


def _passed_field(absorbing: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the field that a polarizer transmits along a ray, across ray and absorbing axis."""
    return _normalized(np.cross(np.broadcast_to(absorbing, direction.shape), direction))


def _analyzer_absorbs(axes: PolarizerAxes, kind: np.dtype) -> tuple[FloatArray, FloatArray]:
    """Return the absorbing axes of the parallel and the crossed analyzer, in its plane."""
    parallel, crossed = np.asarray(axes.parallel), np.asarray(axes.crossed)
    film = _normalized(np.cross(parallel, crossed))
    return np.cross(film, parallel).astype(kind), np.cross(film, crossed).astype(kind)


def _light_absorbs(axes: PolarizerAxes, light: FloatArray) -> FloatArray:
    """Return the absorbing axis of a light's polarizer, which faces the middle of the subject."""
    middle = _normalized(np.nanmean(light.reshape(-1, 3), axis=0))
    return _normalized(np.cross(middle, np.asarray(axes.light, dtype=light.dtype)))


def fresnel_amplitudes(cosine: FloatArray, eta: float) -> tuple[FloatArray, FloatArray]:
    """Return the amplitude reflectances r_s and r_p of a surface of index `eta`, cosines > 0."""
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / eta**2)
    r_s = (cosine - eta * inside) / (cosine + eta * inside)
    return r_s, (eta * cosine - inside) / (eta * cosine + inside)


def _transmittances(cosine: FloatArray, eta: float) -> tuple[FloatArray, FloatArray]:
    """Return Fresnel's power transmittances across (s) and in (p) the plane of incidence."""
    r_s, r_p = fresnel_amplitudes(cosine, eta)
    return 1.0 - r_s**2, 1.0 - r_p**2


def _polarized_over_unpolarized(
    normal: FloatArray, direction: FloatArray, field: FloatArray, eta: float
) -> tuple[FloatArray, BoolArray]:
    """Return T(direction, field) over its mean over fields, shape (...), and where it is valid."""
    cosine = _dot(normal, direction)
    towards = cosine > 1e-3  # turned away, or so grazing that T vanishes
    t_s, t_p = _transmittances(np.clip(np.where(towards, cosine, 1.0), 0.0, 1.0), eta)
    across = np.cross(normal, np.broadcast_to(direction, normal.shape))
    length2 = _dot(across, across)
    # along the normal s and p are equal, and any direction serves
    share_s = np.where(length2 > 1e-12, _dot(field, across) ** 2 / np.maximum(length2, 1e-12), 0.5)
    return (t_s * share_s + t_p * (1.0 - share_s)) / (0.5 * (t_s + t_p)), towards


def _exit_weights(
    normal: FloatArray, view: FloatArray, axes: PolarizerAxes, eta: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    weights = []
    towards: BoolArray = np.ones(1, dtype=bool)
    for absorbs in _analyzer_absorbs(axes, normal.dtype):
        weight, towards = _polarized_over_unpolarized(
            normal, view, _passed_field(absorbs, view), eta
        )
        weights.append(weight[..., None].astype(normal.dtype))
    return weights[0], weights[1], towards


def _by_light(light: FloatArray) -> list[FloatArray]:
    """Split (L, 1, ..., 3) into its lights; keep one direction or one field of directions."""
    if light.ndim >= 3 and all(side == 1 for side in light.shape[1:-1]):
        return list(light)
    return [light]


def _entry_weight(
    normal: FloatArray, light: FloatArray, axes: PolarizerAxes, eta: float
) -> tuple[FloatArray, BoolArray]:
    """Return the transmittance of the polarized over that of unpolarized light, (..., 1)."""
    polarized = np.zeros(normal.shape[:-1], dtype=normal.dtype)
    unpolarized = np.zeros_like(polarized)
    for one in _by_light(light):
        field = _passed_field(_light_absorbs(axes, one), one)
        ratio, lit = _polarized_over_unpolarized(normal, one, field, eta)
        cosine = np.where(lit, _dot(normal, one), 0.0)
        t_s, t_p = _transmittances(np.clip(cosine, 0.0, 1.0), eta)
        amount = cosine * (t_s + t_p)
        polarized = polarized + amount * ratio
        unpolarized = unpolarized + amount
    any_lit = unpolarized > 0
    weight = polarized / np.where(any_lit, unpolarized, 1.0)
    return np.where(any_lit, weight, 1.0)[..., None].astype(normal.dtype), any_lit


def _tilted_leak(
    leak: FloatArray, light: FloatArray, view: FloatArray, axes: PolarizerAxes, eta: float
) -> FloatArray:
    """Return the crossed over parallel specular light, with the rotation of its polarization.

    Fresnel's amplitudes at the facet that mirrors light into the camera weight the s and p parts of
    the field differently, so that the polarization of light out of the planes of symmetry rotates.
    """
    kind = view.dtype
    absorbs_p, absorbs_c = _analyzer_absorbs(axes, kind)
    through = [np.zeros(1, dtype=kind), np.zeros(1, dtype=kind)]
    for one in _by_light(light):
        to_light, to_view = np.broadcast_arrays(one, view)
        half = _normalized(to_light + to_view)
        s = np.cross(half, to_light)
        length = np.linalg.norm(s, axis=-1, keepdims=True)
        # light along the view: no plane of incidence, no rotation; any s across the ray serves
        s = np.where(length > 1e-6, s, np.cross(np.asarray([0.3, 0.8, 0.52], kind), to_light))
        s = _normalized(s)
        cosine = np.clip(_dot(half, to_light), 0.0, 1.0)
        r_s, r_p = fresnel_amplitudes(cosine, eta)
        field = _passed_field(_light_absorbs(axes, one), to_light)
        out = (r_s * _dot(field, s))[..., None] * s + (r_p * _dot(field, np.cross(-to_light, s)))[
            ..., None
        ] * np.cross(to_view, s)
        for k, absorbs in enumerate((absorbs_p, absorbs_c)):
            through[k] = through[k] + _dot(out, _passed_field(absorbs, to_view)) ** 2
    passed_p, passed_c = through[0][..., None], through[1][..., None]
    turned = (passed_c + leak * passed_p) / (passed_p + leak * passed_c)
    return np.asarray(turned, dtype=kind)
