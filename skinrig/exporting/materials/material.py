"""Convert an appearance on its mesh to the quantities that material formats share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import dipole, fresnel, skin_reflectance
from model.skin import SkinAppearance
from skinrig.appearances.contents import list_assumptions
from skinrig.appearances.dynamic import WRINKLES, describe_parts
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.errors import UsageError, require_choice
from skinrig.exporting.images import CAMERA_SPACE, DATA_SPACE, SRGB_SPACE, ExportImage
from skinrig.exporting.materials import subsurface_radius, surface_fit, tangents, udim
from skinrig.exporting.materials.tangents import FramedMesh
from skinrig.exporting.materials.udim import TiledMesh
from skinrig.exporting.options import FIRST_TILE, ExportError, ExportSettings
from skinrig.rendering.geometry import FittedSurface, read_own_mesh
from skinrig.rendering.hole_patches import ClosedMesh, close_holes
from skinrig.viewer.map_filling import fill_holes

COLOR_NOTE: Final = (
    "camera RGB, linear, relative to a perfect white; used as linear sRGB in formats that have no "
    "other space, without color calibration"
)
MAP_NOTES: Final[dict[str, str]] = {
    "base_color": "R_d (1 - F_diffuse): diffuse reflection below a dielectric whose reflection "
    "renderers subtract themselves; equal to the measured model under uniform illumination",
    "specular_roughness": "square root of GGX's alpha, the lobe nearest to the measured mixture",
    "specular_weight": "factor of the reflection of a smooth dielectric of specular_ior",
    "specular_misfit": "residual of the single lobe from the measured mixture, relative RMS",
    "subsurface_radius": "mean free path for which OpenPBR's medium of this color has the decay "
    "of the measured medium, by exact transport",
    "translucency": "1/sigma_tr as measured or assumed",
}


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """Material quantities of an appearance on its mesh.

    Attributes
    ----------
    mesh
        Mesh in mm, rig frame, with tangents.
    shapes
        Displacement of `mesh`'s vertices at weight 1 by blend shape, mm, (V, 3).
    base_color, base_color_stderr
        (H, W, 3), linear; see `COLOR_NOTE`. Not clipped. None: unknown uncertainty.
    normals, normals_rig
        (H, W, 3), unit: in the mesh's tangent frames, +Y up; and in the rig frame.
    axes
        (H, W, 3, 3), tangent, bitangent and normal of each texel.
    covered
        (H, W), texels of the mesh.
    valid
        (H, W), texels with all quantities measured; others are filled from their surroundings.
    surface
        Roughness, weight and misfit of the specular lobe.
    translucency_mm, translucency_stderr_mm
        1/sigma_tr, (H, W, 3), mm.
    deficit
        1 - alpha' of the measured medium, (H, W, 3), of R_d clipped to 0.001 to 0.999.
    eta
        Refractive index.
    assumed
        Assumptions about unmeasured quantities.
    source
        "measured" or "simulated".
    tiles
        UDIM tiles of the mesh; maps cover the first.
    closed_holes
        Omissions about holes of the scan, with reasons; the mask is 0 on their patches.
    """

    mesh: FramedMesh
    shapes: dict[str, Float32Array]
    base_color: Float32Array
    base_color_stderr: Float32Array | None
    normals: Float32Array
    normals_rig: Float32Array
    axes: Float64Array
    covered: BoolArray
    valid: BoolArray
    surface: surface_fit.SurfaceFit
    translucency_mm: Float32Array
    translucency_stderr_mm: Float32Array | None
    deficit: Float64Array
    eta: float
    assumed: tuple[str, ...]
    source: str
    tiles: tuple[int, ...] = (FIRST_TILE,)
    closed_holes: tuple[tuple[str, str], ...] = ()

    @staticmethod
    def of(appearance: SkinAppearance, mesh_file: Path | None = None) -> Material:
        """Create the material of a dome's or a fitted appearance.

        Parameters
        ----------
        appearance
            Appearance with position, normals, r_d, basis BRDFs and mesh.
        mesh_file
            Another mesh with the same texture coordinates on tile 1001, and optionally others on
            other tiles; .npz, .obj, .ply, .gltf or .glb.

        Raises
        ------
        model.skin_reflectance.SkinReflectanceError, skinrig.rendering.geometry.GeometryError,
        rigsim.geometry.mesh.MeshError, ExportError
            If a map or file is missing or inconsistent; the message names it.
        """
        model = skin_reflectance.assemble(appearance)
        own = read_own_mesh(appearance)
        closed = close_holes(own) if mesh_file is None else ClosedMesh(own, (), ())
        mesh = TiledMesh.of(closed.mesh) if mesh_file is None else udim.read(mesh_file)
        surface = FittedSurface.of(model, own if mesh_file is None else mesh.first(), rest=own)

        def paint(values: FloatArray) -> FloatArray:
            if not closed.charts:
                return np.nan_to_num(values)
            filled = fill_holes(values, model.valid).astype(np.float32)
            painted = closed.paint(filled)  # rims need values; elsewhere nothing changes
            return np.where(painted == filled, np.nan_to_num(values), painted)

        framed = FramedMesh.of(mesh)
        # frames are those of the whole mesh, as in a renderer, also at borders of tiles
        on_maps = framed.select_faces(mesh.tile == FIRST_TILE)
        axes, covered = on_maps.texel_frames(surface.atlas.size)
        turned = tangents.rotate_to_tangent(surface.normals, axes, covered)
        inside = 1.0 - fresnel.diffuse_external(model.eta)
        r_d = paint(model.r_d)
        stderr = model.r_d_stderr
        depth = model.translucency_mm
        usual = np.median(depth[model.valid], axis=0) if model.valid.any() else np.ones(3)
        known = np.isfinite(depth) & (depth > 0.0)
        depth = closed.paint(np.where(known, depth, usual))
        return Material(
            mesh=framed,
            shapes={n: d[framed.source].astype(np.float32) for n, d in mesh.shapes.items()},
            base_color=(inside * r_d).astype(np.float32),
            base_color_stderr=None if stderr is None else (inside * stderr).astype(np.float32),
            normals=tangents.fill_tangent_normals(turned, model.valid & covered),
            normals_rig=np.asarray(surface.normals, np.float32),
            axes=axes,
            covered=covered,
            valid=model.valid & covered,
            surface=surface_fit.fit_ggx_lobe(model.lobes, paint(model.weights), eta=model.eta),
            translucency_mm=depth,
            translucency_stderr_mm=model.translucency_stderr_mm,
            deficit=similarity_albedo_deficit(r_d, model.eta),
            eta=model.eta,
            assumed=model.assumed,
            source=appearance.source,
            tiles=mesh.tiles,
            closed_holes=closed.summary(),
        )

    @property
    def radius_mm(self) -> Float32Array:
        """Mean free path, (H, W, 3), mm; see `skinrig.exporting.materials.subsurface_radius`."""
        found = subsurface_radius.radius_mm(self.translucency_mm, self.base_color, self.deficit)
        return found.astype(np.float32)

    def list_mesh_omissions(self, delivery: ExportSettings) -> list[tuple[str, str]]:
        """Return the mesh's omissions with reasons: holes of a scan, maps of other tiles.

        Raises
        ------
        skinrig.errors.UsageError
            If the mesh has several tiles and file names have no tile numbers.
        """
        if self.tiles[1:] and delivery.udim == "none":
            numbers = ", ".join(map(str, self.tiles))
            raise UsageError(
                f"--udim: got none for a mesh on tiles {numbers}, expected dot or underscore; "
                "choose one"
            )
        holes = self.mesh.count_holes()
        omissions = [
            (f"the surface at {holes} holes", "not in the scan; give a complete mesh with --mesh")
        ]
        return [*self.closed_holes, *(omissions if holes else [])] + [
            (
                f"maps of tile {tile}",
                f"maps cover tile {FIRST_TILE}; filled by medians and flat normals",
            )
            for tile in self.tiles[1:]
        ]

    def median_radius_mm(self) -> list[float]:
        """Return the median of `radius_mm` over the valid texels, red, green, blue."""
        shown = self.radius_mm[self.valid] if self.valid.any() else self.radius_mm
        return [float(r) for r in np.median(shown.reshape(-1, 3), axis=0)]

    @property
    def specular_weight(self) -> Float32Array:
        """The specular weight, clipped to [0, 1] as formats require, (H, W)."""
        return np.clip(self.surface.weight, 0.0, 1.0)

    def sigma_tr(self) -> dict[str, Any]:
        """Return medians over valid texels as JSON values, for formats without subsurface light."""
        shown = self.translucency_mm[self.valid] if self.valid.any() else self.translucency_mm
        depth = np.median(shown.reshape(-1, 3), axis=0)
        return {
            "sigma_tr_per_mm": [float(1.0 / d) for d in depth],
            "translucency_mm": [float(d) for d in depth],
            "mean_free_path_mm": self.median_radius_mm(),
            "channels": "red, green, blue; median over the valid texels",
            "assumed": list(self.assumed),
        }

    def facts(self, appearance: SkinAppearance) -> dict[str, Any]:
        """Return the entries that documents of all exported materials share, as JSON values."""
        subsurface = {**self.sigma_tr(), "mapping": MAP_NOTES["subsurface_radius"]}
        return {
            "base_color": f"{MAP_NOTES['base_color']}; {COLOR_NOTE}",
            "subsurface": subsurface,
            "specular_ior": self.eta,
            "figures": self.figures(),
            "assumed": list(dict.fromkeys([*list_assumptions(appearance), *self.assumed])),
        }

    def figures(self) -> dict[str, Any]:
        """Return the approximation errors of the material relative to the model, as JSON values."""
        on = self.valid if self.valid.any() else np.ones_like(self.valid)
        weight, color = self.surface.weight[on], self.base_color[on]
        return {
            "texels": int(on.sum()),
            "specular_misfit_median": float(np.median(self.surface.misfit[on])),
            "specular_weight_above_1_share": float(np.mean(weight > 1.0)),
            "base_color_outside_0_1_share": float(np.mean((color < 0.0) | (color > 1.0))),
            "normals_behind_surface_share": float(np.mean(self.normals[on][:, 2] <= 1.1e-3)),
        }

    def image(self, name: str, delivery: ExportSettings) -> ExportImage:
        """Return one of the material's textures.

        Parameters
        ----------
        name
            "base_color", "normal", "specular_roughness", "specular_weight",
            "subsurface_radius" (mm), "translucency" (mm), "specular_misfit", "mask".
        delivery
            Direction of the normals' green.
        """
        if name == "normal":
            return self.normal_image(name, self.normals, delivery)
        # values, unit, color space, and the value of the PNG code 65535
        simple: dict[str, tuple[Float32Array, str, str, float]] = {
            "base_color": (self.base_color, "1", SRGB_SPACE, 1.0),
            "specular_roughness": (self.surface.roughness, "1", DATA_SPACE, 1.0),
            "specular_weight": (self.specular_weight, "1", DATA_SPACE, 1.0),
            "specular_misfit": (self.surface.misfit, "1", DATA_SPACE, 1.0),
            "subsurface_radius": (self.radius_mm, "mm", DATA_SPACE, 4.0),
            "translucency": (self.translucency_mm, "mm", DATA_SPACE, 16.0),
            "mask": (self.valid.astype(np.float32), "1", DATA_SPACE, 1.0),
        }
        values, unit, space, high = simple[require_choice("texture", name, simple, ExportError)]
        what = MAP_NOTES.get(name, "1 where all quantities were measured")
        if name == "base_color":
            what = f"{what}; {COLOR_NOTE}"
        valid, filler = (None, (0.0,)) if name == "mask" else (self.valid, None)
        return ExportImage(name, values, unit, space, what, 0.0, high, valid, filler)

    def normal_image(
        self, name: str, normals: Float32Array, delivery: ExportSettings
    ) -> ExportImage:
        """Return a texture of normals in the mesh's tangent frames.

        Parameters
        ----------
        name
            Name of the texture.
        normals
            (H, W, 3), unit, +Y up.
        delivery
            Direction of the normals' green.
        """
        what = f"tangent space of the mesh's vertex frames, {delivery.green_direction}"
        what = f"{what}, x and y and z in -1 to 1"
        up = (0.0, 0.0, 1.0)
        return ExportImage.from_normals(name, normals, delivery, what, valid=self.valid, filler=up)

    def error_images(self) -> list[ExportImage]:
        """Return images of the available standard uncertainties, and of the mask."""
        out = [self.image("mask", ExportSettings())]
        for name, values, unit in (
            ("base_color", self.base_color_stderr, "1"),
            ("translucency", self.translucency_stderr_mm, "mm"),
        ):
            if values is not None:
                what = f"standard uncertainty of {name}, 68 %"
                space = CAMERA_SPACE if name == "base_color" else DATA_SPACE
                known = np.nan_to_num(values)
                out.append(
                    ExportImage(f"{name}_stderr", known, unit, space, what, valid=self.valid)
                )
        return out


def similarity_albedo_deficit(r_d: FloatArray, eta: float) -> Float64Array:
    """Return 1 - alpha' of the medium of an albedo, interpolated between 1 000 exact values.

    Parameters
    ----------
    r_d
        Any shape; clipped to 0.001 to 0.999.
    eta
        Refractive index over that of air.

    Examples
    --------
    >>> similarity_albedo_deficit(np.array([0.436, 7.0]), 1.3).round(3).tolist()
    [0.041, 0.0]
    """
    nodes = np.linspace(0.001, 0.999, 999)
    root = np.sqrt(
        dipole.invert_to_deficit(nodes, eta)
    )  # the root is smooth also at an albedo of 1
    return np.asarray(np.interp(r_d, nodes, root) ** 2, np.float64)


def list_expression_omissions(appearance: SkinAppearance) -> list[tuple[str, str]]:
    """Return measured wrinkles as an omission of a neutral face's material, with the reason.

    Parameters
    ----------
    appearance
        Maps of the face.
    """
    if WRINKLES not in describe_parts(appearance):
        return []
    why = (
        "the material is that of the neutral face; --to gltf and usd have a variant per "
        "expression, --to metahuman their maps and masks"
    )
    return [("wrinkles of expressions", why)]
