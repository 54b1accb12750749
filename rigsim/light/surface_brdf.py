"""Model the reflection of skin: subsurface light through the boundary, facets, oil and vellus hair.

f_r = T(n.l) T(n.v) R_d / pi
      + (1 - oil) F(h.l; 1.4) D G / (4 n.l n.v)     facets of skin, Beckmann, roughness m
      + oil F(h.l; 1.47) D G / (4 n.l n.v)          film of oil, GGX, alpha = m / 2
      + single scattering in a thin layer of vellus hair, strongest at grazing angles

T is the transmittance of a smooth boundary of index 1.4. The surface part has two distributions,
two indices and a layer, so that neither a single analytic lobe nor a mixture of lobes of one index
represents it. Every term is reciprocal; the sum conserves energy (tests integrate it).

A layer on the skin (`Coating`: water, lotion, foundation, powder) replaces a fraction of the facets
by a film and covers a fraction of everything with grains::

    facets -> (1 - film) facets + film F(h.l; eta) D G / (4 n.l n.v)      GGX, alpha of its own
    surface -> (1 - powder) surface + powder w p(-l.v) / (4 pi (n.l + n.v))

the latter a thick layer of grains that scatter once, backwards (p: Henyey and Greenstein's).

Notes
-----
R_d is the factor in the first term, for which eq. (6) of Weyrich et al. takes the minimum of
pi f_r / (T T): the fraction of the entered light that would leave through an open boundary. It
differs from the reflectance R for light at normal incidence, which includes losses at the
boundary: R_d = R / (T(0) T_average) = 1.114 R for an index of 1.4, see
`rigsim.shading.interior_scale`. The surface terms are exactly zero nowhere, so even without noise
the minimum exceeds R_d by the smallest surface term in the measured directions, see
`min_surface_reflection`.

References
----------
Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206 (both distributions and their shadowing).
Weyrich et al. 2005, "Measuring and modeling human skin reflectance", eq. (6); Weyrich et al. 2006,
doi:10.1145/1141911.1141987 (Beckmann roughness of 0.3 to 0.35 fits faces).
Koenderink and Pont 2003, doi:10.1007/s00138-002-0089-7 (glow of vellus hair at grazing angles);
its radiance is Chandrasekhar's single scattering of a layer, isotropic.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import ArrayLike

from rigsim import shading
from rigsim.arrays import Float32Array
from rigsim.geometry.surface_noise import smooth_noise
from rigsim.light.observed_skin import observe_skin
from rigsim.subject import SimulatedSubject
from rigsim.tissue.skin_layers import ETA
from rigsim.tissue.tissue_mc import run_in_threads

_BLOCK_POINTS: Final = 4096
"""Points that a thread evaluates at least."""
HAIR_REFLECTANCE: Final = (0.016, 0.011, 0.008)
"""White-balanced reflectance of dark brown hair, modeled as a matt cover."""
ETA_OIL: Final = 1.47
"""Refractive index of sebum, that of its triglycerides and wax esters."""

OIL_SMOOTHING: Final = 0.5
"""Roughness of the oil film over that of the skin below."""

FUZZ_ALBEDO: Final = 0.5
"""Fraction of the light that vellus hair scatters rather than absorbs."""

FUZZ_DEPTH: Final = 0.0015
"""Optical depth of vellus hair where it is densest, along the normal."""

OIL_RANGE: Final = (0.02, 0.6)
"""Range of the surface fraction covered by oil."""

STUBBLE_ABSORPTION: Final = (0.62, 0.56, 0.47)
"""Fraction of the subsurface light (R, G, B) that stubble below the surface absorbs where it is
densest: dark, and less so in blue, which comes from above it; chosen."""

POWDER_ALBEDO: Final = 0.4
"""Fraction of the light that grains of powder reflect after single scattering; chosen. Multiple
scattering is matt, and part of R_d."""

POWDER_ASYMMETRY: Final = -0.35
"""Mean cosine of single scattering by grains of powder: backwards, as large rough grains do
(Hapke 1981, doi:10.1029/JB086iB04p03039); the value is chosen."""

LOBE_CHANNELS: Final = (7, 11)
"""Number of lobe parameters: of bare skin, and with a coating."""

MAX_R_D: Final = 1.25
"""Upper limit of R_d; skin stays below 0.9."""


class SurfaceError(ValueError):
    """A surface or a direction with an invalid description."""


@dataclass(frozen=True, slots=True, eq=False)
class Coating:
    """Layer on the skin; textures of shape (N, N)."""

    film: Float32Array
    """Fraction of the surface under a film, 0 to 1; there it replaces facets of skin and oil."""
    film_alpha: Float32Array
    """GGX alpha of the film, 0.05 to 0.6."""
    film_eta: Float32Array
    """Refractive index of the film, 1.2 to 1.7."""
    powder: Float32Array
    """Fraction of the surface under grains of powder, 0 to 1; they cover film and skin."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, low, high in (
            ("film", 0.0, 1.0),
            ("film_alpha", 0.05, 0.6),
            ("film_eta", 1.2, 1.7),
            ("powder", 0.0, 1.0),
        ):
            values = getattr(self, name)
            if values.shape != self.film.shape or not (
                np.all(values >= low - 1e-6) and np.all(values <= high + 1e-6)
            ):
                raise SurfaceError(
                    f"{name}: got shape {values.shape}, values of {values.min()} to "
                    f"{values.max()}, expected {self.film.shape} and {low} to {high}"
                )


@dataclass(frozen=True, slots=True, eq=False)
class SkinSurface:
    """Reflection of a face for one kind of camera; textures of shape (N, N[, C])."""

    r_d: Float32Array
    """Factor of the diffuse term, white-balanced camera RGB, shape (N, N, 3); brows included."""
    reflectance: Float32Array
    """Diffuse reflectance of bare skin at normal incidence, shape (N, N, 3)."""
    roughness: Float32Array
    """Beckmann roughness of the skin."""
    oil: Float32Array
    """Fraction covered by oil, 0 to 1."""
    fuzz: Float32Array
    """Optical depth of vellus hair, 0 to `FUZZ_DEPTH`."""
    bare: Float32Array
    """Fraction not behind hair of brows and lashes; it scales the surface terms."""
    normal: Float32Array
    """Unit normals of mesh and relief, shape (N, N, 3)."""
    coating: Coating | None = None
    """Layer on the skin; ``None``: none."""

    def packed(self) -> Float32Array:
        """Return the lobe parameters.

        Returns
        -------
        ndarray of float32
            r_d (3), roughness, oil, fuzz, bare, shape (N, N, 7); with a coating also film,
            film_alpha, film_eta, powder, shape (N, N, 11).
        """
        scalars = [self.roughness, self.oil, self.fuzz, self.bare]
        if self.coating is not None:
            on = self.coating
            scalars += [on.film, on.film_alpha, on.film_eta, on.powder]
        return np.concatenate([self.r_d, np.stack(scalars, axis=-1)], axis=-1)


def skin_surface(
    subject: SimulatedSubject, camera: str, light: str, *, state: str = "neutral"
) -> SkinSurface:
    """Return the reflection of a face.

    Parameters
    ----------
    subject
        The face.
    camera, light
        Names in `model.spectra`.
    state
        State of the face's blood.

    Returns
    -------
    SkinSurface
        Textures; oil is most on forehead, nose and chin, vellus hair on cheeks, temples and jaw.
    """
    points, regions = subject.perfusion.points_mm, subject.perfusion.regions
    reflectance = observe_skin(subject, state, camera, light).reflectance()
    hair = subject.hair[..., None]
    scale = np.float32(shading.interior_scale(ETA))
    over = np.asarray(HAIR_REFLECTANCE, np.float32)
    if subject.beard is not None:
        taken = np.asarray(STUBBLE_ABSORPTION, np.float32)
        reflectance = reflectance * (1.0 - subject.beard[..., None] * taken)
    greasy = np.maximum(
        np.maximum(0.75 * regions["forehead"], regions["nose"]), 0.6 * regions["chin"]
    )
    oil = 0.06 + 0.42 * greasy + 0.2 * regions["lips"]
    oil *= 1.0 + 0.25 * smooth_noise(points, (14.0, 5.0), seed=subject.seed + 301)
    oil *= subject.oiliness
    downy = np.maximum(regions["cheeks"], np.maximum(regions["temples"], regions["jaw"]))
    fuzz = (0.25 + 0.75 * downy) * (1.0 - regions["lips"]) * (1.0 - 0.8 * regions["nose"])
    fuzz *= 1.0 + 0.2 * smooth_noise(points, (18.0,), seed=subject.seed + 302)
    return SkinSurface(
        r_d=np.asarray(scale * ((1.0 - hair) * reflectance + hair * over), np.float32),
        reflectance=reflectance,
        roughness=subject.roughness,
        oil=np.asarray(np.clip(oil, *OIL_RANGE), np.float32),
        fuzz=np.asarray(FUZZ_DEPTH * np.clip(fuzz, 0.0, 1.0), np.float32),
        bare=np.asarray(1.0 - subject.hair, np.float32),
        normal=subject.normal,
    )


def evaluate_brdf(
    packed: ArrayLike, normal: ArrayLike, to_light: ArrayLike, to_camera: ArrayLike
) -> tuple[Float32Array, Float32Array]:
    """Evaluate the reflection at points.

    Parameters
    ----------
    packed
        r_d (3 channels), roughness, oil, fuzz, bare, shape (n, 7) or (7,); with a coating 11
        channels, see `SkinSurface.packed`.
    normal, to_light, to_camera
        Unit vectors away from the surface, shape (n, 3) or (3,).

    Returns
    -------
    total : ndarray of float32
        f_r in 1/sr, shape (n, 3).
    specular : ndarray of float32
        Its surface terms, the same in all channels, shape (n,). Both are zero where light or
        camera is below the surface.

    Examples
    --------
    >>> up = np.array([0.0, 0.0, 1.0])
    >>> total, specular = evaluate_brdf([0.5, 0.4, 0.3, 0.3, 0.2, 0.0, 1.0], up, up, up)
    >>> bool(total[0, 0] > total[0, 2] > specular[0] > 0.0)
    True
    """
    arrays = [np.asarray(a, np.float32) for a in (packed, normal, to_light, to_camera)]
    if arrays[0].shape[-1] not in LOBE_CHANNELS or any(a.shape[-1] != 3 for a in arrays[1:]):
        raise SurfaceError(
            f"packed, directions: got shapes {[a.shape for a in arrays]}, "
            "expected (n, 7) or (n, 11), (n, 3)"
        )
    count = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
    if len(count) > 1:
        raise SurfaceError(f"points: got leading axes {count}, expected one")
    rows = count[0] if count else 1
    # copies: broadcast views are read-only, which is a different type for the compiler
    full = [np.array(np.broadcast_to(a, (rows, a.shape[-1])), order="C") for a in arrays]
    total, specular = np.zeros((rows, 3), np.float32), np.zeros(rows, np.float32)
    edges = np.linspace(0, rows, max(rows // _BLOCK_POINTS, 1) + 1).astype(int)

    def run(block: int) -> None:
        _evaluate(*full, total, specular, edges[block], edges[block + 1])

    run_in_threads(run, len(edges) - 1, get_num_threads())
    return total, specular


def min_surface_reflection(packed: ArrayLike, *, max_slope_deg: float = 70.0) -> Float32Array:
    """Return the minimum of pi f_surface / (T T): the excess of eq. (6)'s minimum over R_d.

    Parameters
    ----------
    packed
        As for `evaluate_brdf`, shape (n, 7) or (n, 11).
    max_slope_deg
        Largest angle of light and camera to the normal, degrees.

    Returns
    -------
    ndarray of float32
        Shape (n,), in the unit of R_d.
    """
    values = np.ascontiguousarray(np.atleast_2d(packed), np.float32)
    if values.shape[-1] not in LOBE_CHANNELS:
        raise SurfaceError(f"packed: got shape {values.shape}, expected (n, 7) or (n, 11)")
    angles = np.radians(np.linspace(0.0, max_slope_deg, 8))
    turns = (0.0, 0.5 * math.pi, math.pi)
    pairs = [(a, b, t) for a in angles for b in angles[angles <= a + 1e-9] for t in turns]
    light, camera, turn = np.array(pairs).T
    half = np.array([np.sin(light), np.zeros_like(light), np.cos(light)])
    half += [np.sin(camera) * np.cos(turn), np.sin(camera) * np.sin(turn), np.cos(camera)]
    length = np.linalg.norm(half, axis=0)
    cosines = np.cos(light), np.cos(camera), np.minimum(half[2] / length, 1.0), 0.5 * length
    passed = [boundary_transmittance(math.cos(a), math.cos(b)) for a, b, _ in pairs]
    out = np.empty(len(values), np.float32)
    _find_least(values, np.stack(cosines, axis=-1), math.pi / np.array(passed), out)
    return out


@njit(cache=True, inline="always")
def _fresnel(cosine, eta):  # type: ignore[no-untyped-def]
    """Return the unpolarized reflectance of a smooth dielectric."""
    c = min(max(cosine, 0.0), 1.0)
    inside = math.sqrt(1.0 - (1.0 - c * c) / (eta * eta))
    rs = (c - eta * inside) / (c + eta * inside)
    rp = (eta * c - inside) / (eta * c + inside)
    return 0.5 * (rs * rs + rp * rp)


@njit(cache=True, inline="always")
def beckmann_brdf(nl, nv, nh, alpha):  # type: ignore[no-untyped-def]
    """Return D G / (4 n.l n.v) of Beckmann facets."""
    a2 = alpha * alpha
    c2 = nh * nh
    tan2 = (1.0 - c2) / c2 if c2 > 1e-12 else 1e12
    lobe = tan2 / a2
    if lobe > 60.0:
        return 0.0
    d = math.exp(-lobe) / (math.pi * a2 * c2 * c2)
    return d * _beckmann_g1(nl, alpha) * _beckmann_g1(nv, alpha) / (4.0 * nl * nv)


@njit(cache=True, inline="always")
def _beckmann_g1(c, alpha):  # type: ignore[no-untyped-def]
    tan = math.sqrt(max(1.0 - c * c, 0.0)) / c
    if alpha * tan < 0.625:  # a > 1.6, beyond the range of Walter et al.'s rational fit of G1
        return 1.0
    a = 1.0 / (alpha * tan)
    return (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)


@njit(cache=True, inline="always")
def ggx_brdf(nl, nv, nh, alpha):  # type: ignore[no-untyped-def]
    """Return D G / (4 n.l n.v) of GGX facets."""
    a2 = alpha * alpha
    t = nh * nh * (a2 - 1.0) + 1.0
    d = a2 / (math.pi * t * t)
    # G1 = 2 c / (c + sqrt(a2 + (1 - a2) c^2)); the cosines cancel against the denominator.
    gl = nl + math.sqrt(a2 + (1.0 - a2) * nl * nl)
    gv = nv + math.sqrt(a2 + (1.0 - a2) * nv * nv)
    return d / (gl * gv)


@njit(cache=True, inline="always")
def surface_terms(nl, nv, nh, lh, roughness, oil, fuzz):  # type: ignore[no-untyped-def]
    """Return the surface terms of f_r for cosines above zero."""
    total = _facets(nl, nv, nh, lh, roughness, oil)
    if fuzz > 0.0:
        total += _vellus_scattering(nl, nv, fuzz)
    return total


@njit(cache=True, inline="always")
def coated_terms(  # type: ignore[no-untyped-def]
    nl, nv, nh, lh, roughness, oil, fuzz, film, film_alpha, film_eta, powder
):
    """Return the surface terms of f_r of skin under a coating, for cosines above zero."""
    total = 0.0
    if film < 1.0:
        total = (1.0 - film) * _facets(nl, nv, nh, lh, roughness, oil)
    if film > 0.0:
        total += film * _fresnel(lh, film_eta) * ggx_brdf(nl, nv, nh, film_alpha)
    if fuzz > 0.0:
        total += _vellus_scattering(nl, nv, fuzz)
    if powder > 0.0:
        total = (1.0 - powder) * total + powder * powder_scattering(nl, nv, lh)
    return total


@njit(cache=True, inline="always")
def powder_scattering(nl, nv, lh):  # type: ignore[no-untyped-def]
    """Return the single scattering of a thick layer of grains."""
    g = POWDER_ASYMMETRY
    turned = 1.0 - 2.0 * lh * lh  # cosine between -l and v: -cos(2 x) with cos x = l.h
    phase = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * turned) ** 1.5
    return POWDER_ALBEDO / (4.0 * math.pi) * phase / (nl + nv)


@njit(cache=True, inline="always")
def _facets(nl, nv, nh, lh, roughness, oil):  # type: ignore[no-untyped-def]
    total = (1.0 - oil) * _fresnel(lh, ETA) * beckmann_brdf(nl, nv, nh, roughness)
    if oil > 0.0:
        total += oil * _fresnel(lh, ETA_OIL) * ggx_brdf(nl, nv, nh, OIL_SMOOTHING * roughness)
    return total


@njit(cache=True, inline="always")
def _vellus_scattering(nl, nv, fuzz):  # type: ignore[no-untyped-def]
    # Chandrasekhar's isotropic single scattering of a layer of optical depth tau: w / (4 pi) (1 -
    # exp(-tau (1 / nl + 1 / nv))) / (nl + nv).
    through = 1.0 - math.exp(-fuzz * (1.0 / nl + 1.0 / nv))
    return FUZZ_ALBEDO / (4.0 * math.pi) * through / (nl + nv)


@njit(cache=True, inline="always")
def transmittance(cosine):  # type: ignore[no-untyped-def]
    """Return the transmittance of the boundary."""
    return 1.0 - _fresnel(cosine, ETA)


@njit(cache=True, inline="always")
def two_way_transmittance(nl, nv):  # type: ignore[no-untyped-def]
    """Return the transmittance of the boundary on the way in times that on the way out."""
    return (1.0 - _fresnel(nl, ETA)) * (1.0 - _fresnel(nv, ETA))


def boundary_transmittance(cos_light: float, cos_camera: float) -> float:
    """Return T(n.l) T(n.v) of a smooth boundary of index 1.4.

    Examples
    --------
    >>> round(boundary_transmittance(1.0, 1.0), 6)
    0.945216
    """
    return float(two_way_transmittance(float(cos_light), float(cos_camera)))


@njit(cache=True, inline="always")
def _lobes(p, nl, nv, nh, lh):  # type: ignore[no-untyped-def]
    """Return the surface terms of f_r of one packed point, for cosines above zero."""
    if p.shape[0] > 7:
        return coated_terms(nl, nv, nh, lh, p[3], p[4], p[5], p[7], p[8], p[9], p[10])
    return surface_terms(nl, nv, nh, lh, p[3], p[4], p[5])


@njit(parallel=True, cache=True)
def _find_least(packed, cosines, scale, out):  # type: ignore[no-untyped-def]
    """Find the least scaled surface term over pairs of directions, given by n.l, n.v, n.h, l.h."""
    for i in prange(packed.shape[0]):
        least = np.inf
        for k in range(cosines.shape[0]):
            nl, nv, nh, lh = cosines[k]
            least = min(least, scale[k] * packed[i, 6] * _lobes(packed[i], nl, nv, nh, lh))
        out[i] = least


@njit(cache=True, nogil=True)
def _evaluate(packed, normal, light, camera, total, specular, first, last):  # type: ignore[no-untyped-def]
    """Fill the total and the specular BRDF of points; both are 0 before."""
    for i in range(first, last):
        nl = nv = squared = 0.0
        for k in range(3):
            nl += float(normal[i, k]) * light[i, k]
            nv += float(normal[i, k]) * camera[i, k]
            squared += (float(light[i, k]) + camera[i, k]) ** 2
        if nl <= 0.0 or nv <= 0.0:
            continue
        nl, nv = min(nl, 1.0), min(nv, 1.0)
        length = math.sqrt(squared)
        nh = min((nl + nv) / length, 1.0)
        p = packed[i]
        surface = p[6] * _lobes(p, nl, nv, nh, 0.5 * length)
        inside = two_way_transmittance(nl, nv) / math.pi
        specular[i] = surface
        for k in range(3):
            total[i, k] = inside * packed[i, k] + surface
