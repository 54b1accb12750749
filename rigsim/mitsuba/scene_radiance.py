"""Render the radiance of described scenes by the renderer's own materials and sampling."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import Rig, View
from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.mesh import Mesh
from rigsim.mitsuba.memory import pad_memory
from rigsim.mitsuba.render_error import RenderError
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import Kind, choose_variant


def radiance(
    description: Mapping[str, Any], *, kind: Kind, samples: int, seed: int = 0
) -> Float32Array:
    """Render a described scene; with a box filter, its bytes do not depend on threads.

    Parameters
    ----------
    description
        Mitsuba's scene dictionary, with numbers, texts and arrays only; a ``to_world`` is a 4 x 4
        array, a ``bitmap`` an image, a ``grid`` an array of voxels (z, y, x, channels); a shape of
        type ``mesh`` has a `rigsim.geometry.mesh.Mesh` as ``mesh``.
    kind
        Variant kind, see `rigsim.mitsuba.variant.choose_variant`.
    samples
        Samples per pixel, at least 1.
    seed
        Seed of the sampler, >= 0; those that differ by a multiple of `N_SEEDS` are equal.

    Returns
    -------
    ndarray of float32
        The film, shape (H, W, channels).

    Raises
    ------
    RenderError
        A light's radiance is negative or not finite, which Mitsuba would accept, or the image
        has values that are not finite.
    """
    _refuse_negative_light(description)
    mi = load_mitsuba(choose_variant(kind))
    scene = load_description(mi, description)
    parts = []
    for k, part in enumerate(_powers_of_two(samples)):
        try:
            film = mi.render(scene, spp=part, seed=(seed + k * PART_SEED_STEP) % N_SEEDS)
        except RuntimeError as error:
            raise _find_cause(error) from None
        parts.append(part * np.asarray(mi.TensorXf(film).numpy(), np.float64))
    image = (np.sum(parts, axis=0) / samples).astype(np.float32)
    bad = int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))
    if bad:
        raise RenderError(f"Mitsuba gave {bad} pixels that are not finite, expected none")
    return image


N_SEEDS: Final = 1 << 31
"""Seeds that Dr.Jit takes: it reads them as signed 32 bits."""
PART_SEED_STEP: Final = 1 << 24
"""Distance between the seeds of an image's parts; callers count seeds by ones."""


def _powers_of_two(samples: int) -> list[int]:
    """Return powers of two with a given sum: Mitsuba adds others in the order of its threads."""
    return [1 << k for k in reversed(range(samples.bit_length())) if samples >> k & 1]


def _find_cause(error: BaseException) -> BaseException:
    """Return the plugin's own error; Mitsuba replaces its message by a general one."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, RenderError):
            return cause
        cause = cause.__cause__ or cause.__context__
    return error


_EMISSION_KEYS = ("radiance", "irradiance", "intensity")


def _refuse_negative_light(description: Mapping[str, Any], where: str = "") -> None:
    shines = ("bitmap",) if description.get("type") == "envmap" else _EMISSION_KEYS
    for name, entry in description.items():
        value = entry
        if isinstance(entry, Mapping):
            _refuse_negative_light(entry, f"{where}{name}.")
            value = entry.get("value")
        if name in shines and isinstance(value, (int, float, list, tuple, np.ndarray)):
            least, most = (
                float(end(np.asarray(value, np.float64), initial=0.0)) for end in (np.min, np.max)
            )
            if not (least >= 0.0 and most < np.inf):
                raise RenderError(
                    f"{where}{name}: got values of {least:g} to {most:g}, expected finite light, "
                    ">= 0"
                )


class MovableLightScene:
    """A described scene whose single point light is moved between renders.

    Moving the light neither compiles nor parses, so that the time of a call is the time of
    rendering.

    Parameters
    ----------
    description
        As for `radiance`; the entry ``light`` must be a point light.
    kind
        Variant kind.
    """

    def __init__(self, description: Mapping[str, Any], *, kind: Kind) -> None:
        self._choice = choose_variant(kind)
        mi = load_mitsuba(self._choice)
        self._scene = load_description(mi, description)
        self._parameters = mi.traverse(self._scene)

    def radiance(self, light_mm: ArrayLike, *, samples: int, seed: int = 0) -> Float32Array:
        """Render with the light at a position, shape (H, W, channels).

        Parameters
        ----------
        light_mm
            Position of the light, shape (3,).
        samples, seed
            As for `radiance`.
        """
        mi = load_mitsuba(self._choice)
        self._parameters["light.position"] = mi.Point3f(*(float(x) for x in np.ravel(light_mm)))
        self._parameters.update()
        image = np.array(mi.render(self._scene, spp=samples, seed=seed).numpy(), np.float32)
        if not np.isfinite(image).all():
            raise RenderError(
                f"light at {np.ravel(light_mm).tolist()} mm: got pixels that are not finite, "
                "expected none; move it off the surface"
            )
        return image


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> Float64Array:
    """Return the transform that places a sensor or a rectangle and orients it toward a target.

    Parameters
    ----------
    origin, target
        Its position and its target (in the direction of its local +z), shape (3,).
    up
        Direction of its local +y, as far as possible, shape (3,).

    Returns
    -------
    ndarray
        Shape (4, 4), for ``to_world``; Mitsuba's local +x points to the left in a view from behind.
    """
    place = np.asarray(origin, np.float64)
    forward = np.asarray(target, np.float64) - place
    forward /= np.linalg.norm(forward)
    left = np.cross(np.asarray(up, np.float64), forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([left, np.cross(forward, left), forward, place])
    return matrix


def perspective(
    view: View, pixel_format: str, *, up: ArrayLike | None = None, sampler: str = ""
) -> dict[str, Any]:
    """Return the description of a camera with square pixels.

    Parameters
    ----------
    view
        The camera.
    pixel_format
        "rgb" or "luminance".
    up
        Direction of its local +y, shape (3,); None takes the view's.
    sampler
        Mitsuba's sampler; empty takes its default.
    """
    description = {
        "type": "perspective",
        "fov": math.degrees(2.0 * math.atan(0.5 * view.width_px / view.focal_px)),
        "fov_axis": "x",
        "near_clip": 1.0,
        "far_clip": 1e4,
        "to_world": look_at(view.position_mm, view.target_mm, view.up if up is None else up),
        "film": {
            "type": "hdrfilm",
            "width": view.width_px,
            "height": view.height_px,
            "pixel_format": pixel_format,
            "rfilter": {"type": "box"},
        },
    }
    return description | ({"sampler": {"type": sampler, "sample_count": 4}} if sampler else {})


def point_light_rig(rig: Rig) -> Rig:
    """Return a rig with uniform point lights, as Mitsuba's point light is."""
    lights = tuple(
        dataclasses.replace(light, half_intensity_deg=None, radius_mm=1e-3) for light in rig.lights
    )
    return dataclasses.replace(rig, lights=lights)


def rough_metal(distribution: str, eta: float, alpha: Any) -> dict[str, Any]:
    """Return the description of facets: a metal without absorption reflects as a dielectric."""
    return {
        "type": "roughconductor",
        "distribution": distribution,
        "alpha": alpha,
        "eta": eta,
        "k": 0.0,
    }


def matte_plastic(eta: float, reflectance: Any) -> dict[str, Any]:
    """Return the description of an interior behind a smooth boundary without a highlight."""
    return {
        "type": "plastic",
        "int_ior": eta,
        "ext_ior": 1.0,
        "specular_reflectance": 0.0,
        "diffuse_reflectance": reflectance,
    }


def plastic_scale(eta: float) -> float:
    """Return eta^2 (1 - F_inner) with Mitsuba's polynomial for F_inner.

    References
    ----------
    Egan and Hilgeman 1973, doi:10.1364/AO.12.001816; 0.1 % off the exact value at 1.4.
    """
    inner = -1.4399 / eta**2 + 0.7099 / eta + 0.6681 + 0.0636 * eta
    return eta * eta * (1.0 - inner)


def load_description(mi: Any, description: Mapping[str, Any]) -> Any:
    """Return Mitsuba's object of a description; see `radiance` for what it may contain.

    Parts are loaded one after the other. In parallel, threads decide the order of the parts, and
    the code of a kernel follows it: another process would compile the same kernel again.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    description
        Dictionary of a scene or of one of its parts.
    """
    return mi.load_dict(_with_transforms(mi, description), parallel=False)


def _with_transforms(mi: Any, description: Mapping[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in description.items():
        if isinstance(value, Mapping) and value.get("type") == "mesh":
            out[name] = _shape(mi, name, value)
        elif isinstance(value, Mapping):
            out[name] = _with_transforms(mi, value)
        elif isinstance(value, np.ndarray) and name in ("bitmap", "table"):
            image = value if value.ndim == 3 else value[..., None]
            out[name] = mi.Bitmap(np.ascontiguousarray(image, np.float32))
        elif isinstance(value, np.ndarray) and name == "grid":
            out[name] = mi.VolumeGrid(np.ascontiguousarray(value, np.float32))
        elif name == "to_world":
            out[name] = mi.ScalarTransform4f(np.asarray(value, np.float64))
        else:
            out[name] = value
    return out


def _shape(mi: Any, name: str, description: Mapping[str, Any]) -> Any:
    """Return Mitsuba's mesh with normals, texture coordinates and a material."""
    mesh: Mesh = description["mesh"]
    properties = mi.Properties()
    for part in ("bsdf", "interior"):
        if part in description:
            properties[part] = mi.load_dict(_with_transforms(mi, description[part]), parallel=False)
    properties["face_normals"] = bool(description.get("face_normals", False))
    shape = mi.Mesh(
        name,
        len(mesh.vertices_mm),
        len(mesh.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = pad_memory(mesh.vertices_mm)
    parameters["vertex_normals"] = pad_memory(mesh.normals)
    parameters["vertex_texcoords"] = pad_memory(mesh.uv)
    parameters["faces"] = pad_memory(mesh.faces.astype(np.uint32))
    parameters.update()
    return shape
