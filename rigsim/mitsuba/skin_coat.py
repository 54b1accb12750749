"""BSDF `skincoat`: skin below a rough boundary with an oil film, vellus hair and a coating.

.. code-block:: python

    "type": "skincoat",
    "r_d": {"type": "bitmap", ...},    # factor of the diffuse term, linear RGB: f = T T r_d / pi
    "alpha": 0.3,                      # roughness of the skin
    "distribution": "beckmann",        # of the skin's facets, or "ggx"
    "oil": 0.2,                        # fraction of the surface below oil
    "vellus": 0.0,                     # optical depth of vellus hair
    "bare": 1.0,                       # fraction not behind hair; it scales the surface terms
    "normals": {"type": "bitmap", ...} # unit normals of the relief, frame of the mesh; optional

Each is a number or a texture. A coating adds `film`, `film_alpha`, `film_ior` and `powder`. The
numbers `int_ior`, `oil_ior`, `oil_smoothing`, `vellus_albedo`, `powder_albedo` and
`powder_asymmetry` describe the materials.

In polarized variants facets reflect by Fresnel's Mueller matrix. Light that enters is depolarized
inside, and leaves slightly polarized. Vellus hair and powder depolarize.

References
----------
Walter et al. 2007 (facets), Chandrasekhar 1960 (vellus hair), Hapke 1981 (powder).
"""

import math
from typing import Any, Final

from rigsim.mitsuba.plugin_class import define_plugin
from rigsim.mitsuba.polarized_light import (
    Facets,
    FilmedLight,
    Stokes,
    entering_light,
    fresnel_amplitudes,
    leaving_light,
    reflect_light,
    surface_mueller,
)

SKIN_PARAMETERS: Final = ("alpha", "oil", "vellus", "bare")
COATING_PARAMETERS: Final = ("film", "film_alpha", "film_ior", "powder")
"""Textures or numbers of the BSDF besides `r_d` and `normals`, in the order of their values."""

MATERIAL_CONSTANTS: Final = {
    "int_ior": 1.4,
    "oil_ior": 1.47,
    "oil_smoothing": 0.5,
    "vellus_albedo": 0.5,
    "powder_albedo": 0.4,
    "powder_asymmetry": -0.35,
}
"""Numbers of the BSDF with their defaults."""

MAX_R_D: Final = 1.25
MAX_VELLUS: Final = 0.01
"""Largest stored factor of the diffuse term and optical depth of vellus hair."""

NORMAL_SCALE: Final = 32767.0
UNIT_SCALE: Final = 65535.0
"""Full scales of stored normals and of numbers from 0 to 1."""

VELLUS_COLUMN: Final = 5
IOR_COLUMN: Final = 9
"""Positions of the vellus hair and of the film's index among stored numbers, after r_d."""

FACET_DISTRIBUTIONS: Final = ("beckmann", "ggx")
"""Distributions of the skin's facets; the oil's and a coating's are GGX."""

NUMBER_RANGES: Final = {
    "r_d": (0.0, MAX_R_D),
    "alpha": (1e-3, 1.0),
    "vellus": (0.0, MAX_VELLUS),
    **dict.fromkeys(("oil", "bare", "film", "powder", "oil_smoothing"), (0.0, 1.0)),
    **dict.fromkeys(("vellus_albedo", "powder_albedo"), (0.0, 1.0)),
    "film_alpha": (1e-3, 1.0),
    "powder_asymmetry": (-0.999, 0.999),
    **dict.fromkeys(("int_ior", "oil_ior"), (1.0, 4.0)),
    "film_ior": (1.0, 2.0),
}
"""Least and largest values of properties that are numbers."""

MIN_COSINE: Final = 1e-6
"""Cosines of masked lanes are clamped to it, so that their square roots stay real."""


class _SkinCoat:
    """Skin; see the module."""

    mi: Any
    dr: Any

    def __init__(self, properties: Any) -> None:
        mi = self.mi
        self.mi.BSDF.__init__(self, properties)
        self.material = {
            name: float(properties.get(name, default))
            for name, default in MATERIAL_CONSTANTS.items()
        }
        kind = str(properties.get("distribution", "beckmann"))
        if kind not in FACET_DISTRIBUTIONS:
            raise ValueError(
                f"skincoat, distribution: got {kind!r}, expected {' or '.join(FACET_DISTRIBUTIONS)}"
            )
        self.is_ggx = kind == "ggx"
        self.is_coated = any(name in properties for name in COATING_PARAMETERS)
        defaults = {"alpha": 0.3, "bare": 1.0, "film_alpha": 0.2, "film_ior": 1.4}
        names = SKIN_PARAMETERS + (COATING_PARAMETERS if self.is_coated else ())
        _check_numbers(properties)
        self.textures = {
            name: properties.get_unbounded_texture(name, defaults.get(name, 0.0)) for name in names
        }
        self.r_d = properties.get_unbounded_texture("r_d", 0.5)
        relief = "normals" in properties
        self.normals = properties.get_unbounded_texture("normals") if relief else None
        diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
        glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_components = [diffuse, glossy]
        self.m_flags = diffuse | glossy

    def traverse(self, callback: Any) -> None:
        mi = self.mi
        for name, texture in {"r_d": self.r_d, **self.textures}.items():
            callback.put(name, texture, mi.ParamFlags.Differentiable)
        if self.normals is not None:
            callback.put("normals", self.normals, mi.ParamFlags.Differentiable)

    def to_string(self) -> str:
        return f"SkinCoat[{', '.join(('r_d', *self.textures))}]"

    def look_up(self, si: Any, active: Any = True) -> tuple[Any, Any, list[Any]]:
        """Return normals (frame of the mesh), r_d and parameters at surface points."""
        mi, dr = self.mi, self.dr
        normal = si.sh_frame.n
        if self.normals is not None:
            normal = mi.Normal3f(dr.normalize(self.normals.eval_3(si, active)))
        values = [texture.eval_1(si, active) for texture in self.textures.values()]
        return normal, self.r_d.eval(si, active), values

    def lobes(self, values: list[Any], nl: Any, nv: Any, nh: Any, lh: Any) -> tuple[Any, Any]:
        """Return T T / pi and the surface terms of f_r in 1/sr, for cosines above zero."""
        dr, index = self.dr, self.material["int_ior"]
        facets, surface = self.surface_lobes(values, nl, nv, nh, lh)
        for strength, eta in facets:
            surface += strength * fresnel(dr, lh, eta)
        return (1.0 - fresnel(dr, nl, index)) * (1.0 - fresnel(dr, nv, index)) / math.pi, surface

    def surface_lobes(self, values: list[Any], nl: Any, nv: Any, nh: Any, lh: Any) -> Any:
        """Return `surface_lobes` of this material for cosines above zero."""
        return surface_lobes(self.dr, self.material, values, (nl, nv, nh, lh), self.is_ggx)

    def stored(self, si: Any, active: Any = True) -> list[Any]:
        """Return the values at surface points in words of two 16-bit numbers each."""
        mi, dr = self.mi, self.dr
        normal, r_d, values = self.look_up(si, active)
        unit = [dr.sqrt(dr.maximum(c, 0.0) / MAX_R_D) for c in r_d] + list(values)
        unit[VELLUS_COLUMN] = unit[VELLUS_COLUMN] / MAX_VELLUS
        if self.is_coated:
            unit[IOR_COLUMN] = unit[IOR_COLUMN] - 1.0
        if dr.any(mi.Bool(active) & (dr.max(unit) > 1.0 + 1e-5)):
            raise ValueError(
                f"skincoat: got r_d above {MAX_R_D}, vellus above {MAX_VELLUS} or another number "
                "above its range, expected less; check the textures' scale"
            )
        halves = [mi.UInt32(mi.Int32(dr.round(c * NORMAL_SCALE))) & 0xFFFF for c in normal]
        halves += [mi.UInt32(dr.round(dr.clip(c, 0.0, 1.0) * UNIT_SCALE)) for c in unit]
        return [a | (b << 16) for a, b in zip(halves[::2], halves[1::2], strict=True)]

    def restored(self, words: list[Any]) -> tuple[Any, list[Any], list[Any]]:
        """Return unit normals, r_d and parameters of `stored` words."""
        mi, dr = self.mi, self.dr
        halves = [half for word in words for half in (word & 0xFFFF, word >> 16)]
        # signed halves: the top bit is the sign
        signed = [mi.Int32(half << 16) >> 16 for half in halves[:3]]
        normal = dr.normalize(mi.Vector3f(*(mi.Float(half) for half in signed)))
        unit = [mi.Float(half) * (1.0 / UNIT_SCALE) for half in halves[3:]]
        unit[VELLUS_COLUMN] = MAX_VELLUS * unit[VELLUS_COLUMN]
        if self.is_coated:
            unit[IOR_COLUMN] = 1.0 + unit[IOR_COLUMN]
        return normal, [MAX_R_D * root * root for root in unit[:3]], unit[3:]

    def reflected(
        self, words: list[Any], to_light: Any, way_to_camera: Any, diffuse: bool = True
    ) -> tuple[list[Any], Any]:
        """Return f_r cos(light) in three channels at `stored` points, and where it is lit."""
        dr = self.dr
        normal, r_d, values = self.restored(words)
        to_camera = dr.normalize(way_to_camera)
        nl = dr.minimum(dr.dot(normal, to_light), 1.0)
        nv = dr.minimum(dr.dot(normal, to_camera), 1.0)
        total = to_light + to_camera
        length = dr.norm(total)
        nh, lh = dr.minimum((nl + nv) / length, 1.0), 0.5 * length
        cl, cv = dr.maximum(nl, MIN_COSINE), dr.maximum(nv, MIN_COSINE)
        inside, surface = self.lobes(values, cl, cv, nh, lh)
        gloss, matt = surface * cl, inside * cl
        light = [gloss + matt * c for c in r_d] if diffuse else [gloss] * 3
        return light, (nl > 0.0) & (nv > 0.0)

    def reflected_stokes(
        self, words: list[Any], light: FilmedLight, way_to_camera: Any, right: Any
    ) -> tuple[Stokes, Any, list[Any], Any]:
        """Return what `stored` points make of a light behind a polarizer.

        These are the Stokes vector of the surface terms times cos(light), the light that enters,
        cosine included, r_d, and where the surface is lit.
        """
        dr = self.dr
        normal, r_d, values = self.restored(words)
        to_camera = dr.normalize(way_to_camera)
        nl, nv = dr.dot(normal, light.to_light), dr.dot(normal, to_camera)
        length = dr.norm(light.to_light + to_camera)
        nh, lh = dr.minimum((nl + nv) / length, 1.0), 0.5 * length
        cl, cv = dr.clip(nl, MIN_COSINE, 1.0), dr.clip(nv, MIN_COSINE, 1.0)
        facets, volume = self.surface_lobes(values, cl, cv, nh, lh)
        s0, s1, s2 = reflect_light(dr, facets, light, to_camera, right)
        entered = cl * entering_light(dr, normal, light, self.material["int_ior"])
        seen = dr.select(nv > 0.0, cl, 0.0)
        return (seen * (s0 + volume), seen * s1, seen * s2), entered, r_d, nl > 0.0

    def leaving_stokes(self, words: list[Any], way_to_camera: Any, right: Any) -> Stokes:
        """Return the Stokes vector toward the camera of radiance 1 behind the boundary."""
        dr = self.dr
        normal, _, _ = self.restored(words)
        to_camera = dr.normalize(way_to_camera)
        stokes = leaving_light(dr, normal, to_camera, self.material["int_ior"], right)
        facing = dr.dot(normal, to_camera) > 0.0
        s0, s1, s2 = (dr.select(facing, s, 0.0) for s in stokes)
        return s0, s1, s2

    def leaving(self, words: list[Any], way_to_camera: Any) -> Any:
        """Return the boundary's transmittance toward the camera at `stored` points."""
        dr = self.dr
        normal, _, _ = self.restored(words)
        nv = dr.minimum(dr.dot(normal, dr.normalize(way_to_camera)), 1.0)
        passed = 1.0 - fresnel(dr, dr.maximum(nv, MIN_COSINE), self.material["int_ior"])
        return dr.select(nv > 0.0, passed, 0.0)

    def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(context, si, wo, active)[0]

    def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(context, si, wo, active)[1]

    def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        mi, dr = self.mi, self.dr
        normal, r_d, values = self.look_up(si, active)
        light, camera = si.to_world(wo), si.to_world(si.wi)
        nl, nv = dr.dot(normal, light), dr.dot(normal, camera)
        valid = mi.Bool(active) & (nl > 0.0) & (nv > 0.0)
        total = light + camera
        length = dr.norm(total)
        nh, lh = dr.minimum((nl + nv) / length, 1.0), dr.minimum(0.5 * length, 1.0)
        cl, cv = dr.clip(nl, MIN_COSINE, 1.0), dr.clip(nv, MIN_COSINE, 1.0)
        if mi.is_polarized:
            facets, volume = self.surface_lobes(values, cl, cv, nh, lh)
            way = (light, camera)
            if context.mode != mi.TransportMode.Radiance:
                way = (camera, light)
            matrix = surface_mueller(
                mi, facets, volume, r_d * dr.inv_pi, normal, *way, self.material["int_ior"]
            )
            value = si.to_local_mueller(cl * matrix, -way[0], way[1])
        else:
            inside, surface = self.lobes(values, cl, cv, nh, lh)
            value = (inside * r_d + surface) * cl
        frame = mi.Frame3f(normal)
        half = frame.to_local(total / length)
        local = frame.to_local(camera)
        weights, facets = self._choices(r_d, values)
        density = weights[0] * cl * dr.inv_pi
        for weight, (kind, alpha) in zip(weights[1:], facets, strict=True):
            facet = mi.MicrofacetDistribution(kind, alpha, True)
            lobe = facet.pdf(local, half) / (4.0 * dr.maximum(lh, MIN_COSINE))
            density += dr.select(weight > 0.0, weight * lobe, 0.0)
        return dr.select(valid, value, 0.0), dr.select(valid, density, 0.0)

    def sample(
        self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        mi, dr = self.mi, self.dr
        normal, r_d, values = self.look_up(si, active)
        frame = mi.Frame3f(normal)
        camera = frame.to_local(si.to_world(si.wi))
        weights, facets = self._choices(r_d, values)
        direction = mi.warp.square_to_cosine_hemisphere(sample2)
        passed = mi.Float(weights[0])
        for weight, (kind, alpha) in zip(weights[1:], facets, strict=True):
            facet, _ = mi.MicrofacetDistribution(kind, alpha, True).sample(camera, sample2)
            direction = dr.select(sample1 >= passed, mi.reflect(camera, facet), direction)
            passed += weight
        out = dr.zeros(mi.BSDFSample3f)
        out.wo = si.to_local(frame.to_world(direction))
        out.eta = 1.0
        out.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        out.sampled_component = mi.UInt32(0)
        value, out.pdf = self.eval_pdf(context, si, out.wo, active)
        used = mi.Bool(active) & (out.pdf > 0.0)
        inverse = dr.rcp(out.pdf)
        return out, dr.select(used, inverse * value, 0.0)

    def _choices(self, r_d: Any, values: list[Any]) -> tuple[list[Any], list[Any]]:
        """Return the probabilities of sampling (matt term first) and the facets' kinds."""
        mi, dr = self.mi, self.dr
        alpha, oil, *_ = values
        beckmann, ggx = mi.MicrofacetType.Beckmann, mi.MicrofacetType.GGX
        facets = [
            (ggx if self.is_ggx else beckmann, alpha),
            (ggx, self.material["oil_smoothing"] * alpha),
        ]
        shares = [1.0 - oil, oil]
        if self.is_coated:
            film, film_alpha = values[4], values[5]
            shares = [(1.0 - film) * share for share in shares] + [film]
            facets.append((ggx, dr.maximum(film_alpha, 0.01)))
        glossy = 0.25
        return [1.0 - glossy, *(glossy * share for share in shares)], facets


def _check_numbers(properties: Any) -> None:
    """Refuse properties that are numbers outside `NUMBER_RANGES`; textures are checked at hits."""
    for name, (low, high) in NUMBER_RANGES.items():
        value = properties[name] if name in properties else None
        if isinstance(value, int | float) and not low <= value <= high:
            raise ValueError(f"skincoat, {name}: got {value:g}, expected {low:g} to {high:g}")


def define_skin_coat(mi: Any) -> Any:
    """Return the class of the BSDF for Mitsuba's active variant.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    """
    return define_plugin(mi, mi.BSDF, _SkinCoat)


def surface_lobes(
    dr: Any,
    material: dict[str, float],
    values: list[Any],
    cosines: tuple[Any, Any, Any, Any],
    is_ggx: bool,
) -> tuple[Facets, Any]:
    """Return the lobes of facets, and what vellus hair and powder reflect, in 1/sr.

    Parameters
    ----------
    dr
        The module ``drjit``.
    material
        `MATERIAL_CONSTANTS`.
    values
        Alpha, oil, vellus, bare, and with a coating film, its alpha, its index, powder.
    cosines
        Those above zero of light, camera and half vector to the normal, and of light to half
        vector.
    is_ggx
        Whether the skin's facets are GGX, otherwise Beckmann.
    """
    alpha, oil, vellus, bare, *coating = values
    nl, nv, nh, lh = cosines
    of_skin = ggx_facets if is_ggx else beckmann_facets
    facets = [
        ((1.0 - oil) * of_skin(dr, nl, nv, nh, alpha), material["int_ior"]),
        (oil * ggx_facets(dr, nl, nv, nh, material["oil_smoothing"] * alpha), material["oil_ior"]),
    ]
    if coating:
        film, film_alpha, film_ior, powder = coating
        facets = [((1.0 - film) * strength, index) for strength, index in facets]
        on_film = ggx_facets(dr, nl, nv, nh, dr.maximum(film_alpha, 0.01))
        facets.append((film * on_film, film_ior))
        bare = bare * (1.0 - powder)
    scattered = 1.0 - dr.exp(-vellus * (1.0 / nl + 1.0 / nv))
    volume = bare * (material["vellus_albedo"] / (4.0 * math.pi) * scattered / (nl + nv))
    if coating:
        volume += values[3] * powder * _grains(material, nl, nv, lh)
    return [(bare * strength, index) for strength, index in facets], volume


def fresnel(dr: Any, cosine: Any, eta: Any) -> Any:
    """Return the unpolarized reflectance of a smooth dielectric from outside."""
    rs, rp = fresnel_amplitudes(dr, cosine, eta)
    return 0.5 * (rs * rs + rp * rp)


def beckmann_facets(dr: Any, nl: Any, nv: Any, nh: Any, alpha: Any) -> Any:
    """Return D G / (4 n.l n.v) of Beckmann facets, separable G."""
    a2, c2 = alpha * alpha, nh * nh
    lobe = dr.minimum((1.0 - c2) / (dr.maximum(c2, 1e-12) * a2), 60.0)
    density = dr.exp(-lobe) / (math.pi * a2 * c2 * c2)
    return density * _beckmann_g1(dr, nl, alpha) * _beckmann_g1(dr, nv, alpha) / (4.0 * nl * nv)


def _beckmann_g1(dr: Any, cosine: Any, alpha: Any) -> Any:
    slope = alpha * dr.sqrt(dr.maximum(1.0 - cosine * cosine, 0.0)) / cosine
    a = 1.0 / dr.maximum(slope, 1e-6)
    partly = (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)
    return dr.select(slope < 0.625, 1.0, partly)


def ggx_facets(dr: Any, nl: Any, nv: Any, nh: Any, alpha: Any) -> Any:
    """Return D G / (4 n.l n.v) of GGX facets, separable G."""
    a2 = alpha * alpha
    t = nh * nh * (a2 - 1.0) + 1.0
    gl = nl + dr.sqrt(a2 + (1.0 - a2) * nl * nl)
    gv = nv + dr.sqrt(a2 + (1.0 - a2) * nv * nv)
    return a2 / (math.pi * t * t) / (gl * gv)


def _grains(material: dict[str, float], nl: Any, nv: Any, lh: Any) -> Any:
    g = material["powder_asymmetry"]
    spread = 1.0 + g * g - 2.0 * g * (1.0 - 2.0 * lh * lh)
    phase = (1.0 - g * g) / (spread * spread**0.5)
    return material["powder_albedo"] / (4.0 * math.pi) * phase / (nl + nv)
