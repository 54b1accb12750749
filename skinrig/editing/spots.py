"""Add spots to an appearance's R_d, and remove existing ones."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from model.skin import SkinMap
from reconstruction.correspondence import common_parameterization
from reconstruction.correspondence.charts import TexelChart
from reconstruction.correspondence.common_parameterization import CommonFrame
from reconstruction.surface import texture_fill
from skinrig.appearances import face_textures
from skinrig.appearances.face_textures import Face
from skinrig.arrays import BoolArray, Float32Array
from skinrig.editing import pigment_spots, spot_removal
from skinrig.errors import require_choice
from skinrig.traits import albedo_vectors


class SpotRequestError(ValueError):
    """Invalid request to add or remove spots."""


@dataclass(frozen=True, slots=True)
class SpotRequest:
    """Spots to add or to remove.

    Attributes
    ----------
    kind
        One of `pigment_spots.SPOT_KINDS`.
    amount
        Above 0: pigment of added spots; below 0: fraction by which existing spots are removed.
    density_per_cm2
        Density of added spots, 1/cm^2; None: that of `pigment_spots.SPOT_KINDS`.
    """

    kind: str
    amount: float
    density_per_cm2: float | None = None

    def __post_init__(self) -> None:
        """Raise for an unknown kind and for amounts below -1."""
        require_choice("spots", self.kind, pigment_spots.SPOT_KINDS, SpotRequestError)
        if not np.isfinite(self.amount) or self.amount < -1.0:
            raise SpotRequestError(
                f"--spots: got {self.kind}={self.amount}, expected at least -1; enter another"
            )


def build_spot_frame(face: Face) -> CommonFrame:
    """Return a seamless common map of the face, with about the resolution of its texture."""
    if face.landmarks:
        return face_textures.build_common_frame([face])
    cylinder = common_parameterization.find_cylinder(face.position, face.surface)
    places = cylinder.unroll(face.position[face.surface])
    around = common_parameterization.fit_common_frame((), np.empty((0, 2)), [places], size=64)
    size = face_textures.choose_size(around.side_mm, face.texel_mm())
    return dataclasses.replace(around, size=size)


def add_spots(
    face: Face, source: SkinMap, spot: SpotRequest, weight: Float32Array, rng: np.random.Generator
) -> tuple[Float32Array, dict[str, Any]]:
    """Return R_d with added spots, and a record as JSON values."""
    place, density = (face.position, face.surface), spot.density_per_cm2
    drawn = pigment_spots.draw_spots(
        spot.kind,
        source.values,
        *place,
        weight,
        amount=spot.amount,
        density_per_cm2=density,
        rng=rng,
    )
    gain = _dilate_factors(drawn.gain, face.surface, weight)
    values = np.where(gain == 1.0, source.values, source.values * gain)
    return values, {
        "drawn": len(drawn.center_mm),
        "transmitted": drawn.transmitted.tolist(),
        "camera": pigment_spots.DOME_CAMERA,
        "illuminant": pigment_spots.DOME_ILLUMINANT,
    }


def remove_spots(
    source: SkinMap, spot: SpotRequest, weight: Float32Array, chart: TexelChart, frame: CommonFrame
) -> tuple[Float32Array, dict[str, Any]]:
    """Return R_d with spots removed, and a record as JSON values."""
    valid, sizes = (
        face_textures.find_valid_texels(source),
        pigment_spots.SPOT_KINDS[spot.kind].range_mm,
    )
    found = spot_removal.fill_spots(
        source.values, valid, chart, pixel_mm=frame.pixel_mm, range_mm=sizes
    )
    part = (np.float32(-spot.amount) * weight * found.share)[..., None]
    wanted = source.values * (1 - part) + found.fill * part
    ratio = np.where(
        part == 0.0, 1.0, wanted / np.maximum(source.values, albedo_vectors.MIN_REFLECTANCE)
    )
    gain = _dilate_factors(ratio.astype(np.float32), chart.on_surface, weight)
    values = np.where(part == 0.0, source.values * gain, wanted)
    values = np.where(gain == 1.0, source.values, values)
    return values.astype(np.float32), {"found": found.spots}


def _dilate_factors(gain: Float32Array, surface: BoolArray, weight: Float32Array) -> Float32Array:
    """Extend factors by two texels beyond the rims of a texture's islands, for lookups there."""
    rim = ndimage.binary_dilation(surface, iterations=2) & ~surface & (weight > 0)
    if not rim.any():
        return gain
    filled = texture_fill.push_pull(np.log(gain), surface.astype(np.float32), mask=surface | rim)
    return np.where(rim[..., None], np.exp(filled.values), gain).astype(np.float32)


def replace_values(source: SkinMap, values: Float32Array) -> SkinMap:
    """Replace a map's values and scale its standard uncertainties by the same factor."""
    error = source.stderr
    if error is not None:
        ratio = np.abs(values) / np.maximum(np.abs(source.values), np.float32(1e-12))
        error = np.where(values == source.values, error, error * ratio)
    return dataclasses.replace(source, values=values, stderr=error)
