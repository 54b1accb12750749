"""Write the maps of an appearance as OME-Zarr images with their masks as labels.

Zarr 3 with the metadata of OME-Zarr 0.5 (https://ngff.openmicroscopy.org/0.5/). Each map is an
image of one resolution; units, description and provenance are attributes of its group.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from model.skin import SkinAppearance, SkinMap
from skinrig.errors import MissingExtra
from skinrig.exporting.maps import choose_maps
from skinrig.exporting.options import ExportSettings
from skinrig.exporting.sealing import IMAGE_ORIENTATION, describe_provenance

if TYPE_CHECKING:
    from zarr import Group

STORE_FOLDER: Final = "maps.zarr"
SCHEMA: Final = "skinrig.export.ome-zarr/1"
OME_VERSION: Final = "0.5"
MAX_CHUNK_PX: Final = 1024
MASK_NAME: Final = "valid"


def write(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write the maps of an appearance; invalid pixels are NaN.

    Parameters
    ----------
    appearance
        Any appearance.
    folder
        Existing, empty folder; the store is `STORE_FOLDER` in it.
    delivery
        Selected maps, with or without errors.

    Returns
    -------
    list of (str, str)
        Omissions with reasons.

    Raises
    ------
    MissingExtra
        If Zarr is not installed.
    ExportError
        If a selected map is missing, or the appearance has none.
    """
    try:
        import zarr
    except ImportError as error:
        raise MissingExtra("export to OME-Zarr", "zarr") from error
    names = choose_maps(appearance, delivery)
    about = {"schema": SCHEMA, **describe_provenance(appearance), "orientation": IMAGE_ORIENTATION}
    root = zarr.create_group(
        folder / STORE_FOLDER,
        zarr_format=3,
        attributes={"ome": {"version": OME_VERSION}, "skinrig": about},
    )
    for number, name in enumerate(names):
        delivery.report(f"content {number}/{len(names)}: {name}")
        one = appearance.maps[name]
        text = {"unit": one.unit, "description": one.description, **about}
        _write_image(root.create_group(name), name, one.values, one, text)
        if delivery.with_errors and one.stderr is not None:
            errors = f"{name}.stderr"
            text = {**text, "description": f"standard uncertainty of {name}, 68 %"}
            _write_image(root.create_group(errors), errors, one.stderr, one, text)
    return [(name, "OME-Zarr has no such files") for name in sorted(appearance.files)]


def _write_image(
    group: Group, name: str, values: Any, skin_map: SkinMap, about: dict[str, Any]
) -> None:
    """Write an image (H, W[, 3]) as axes [c,] y, x, and its mask as a label image."""
    planes = np.where(
        skin_map.mask.reshape(skin_map.mask.shape + (1,) * (values.ndim - 2)), values, np.nan
    )
    planes = np.moveaxis(planes, -1, 0) if values.ndim == 3 else planes
    _write_array(group, name, planes.astype("<f4"), fill=np.nan)
    group.update_attributes({"skinrig": about})
    labels = group.create_group("labels")
    labels.update_attributes({"ome": {"version": OME_VERSION, "labels": [MASK_NAME]}})
    mask = np.broadcast_to(skin_map.mask, (*planes.shape[:-2], *skin_map.mask.shape))
    valid = labels.create_group(MASK_NAME)
    label = {"source": {"image": "../../"}, "colors": [{"label-value": 1, "rgba": [255] * 4}]}
    _write_array(valid, f"{name}: 1 where valid", mask.astype("|u1"), fill=0, label=label)


def _write_array(
    group: Group, name: str, values: Any, *, fill: float, label: dict[str, Any] | None = None
) -> None:
    """Write an array as the only resolution of an image."""
    from zarr.codecs import BloscCodec

    axes = ["c", "y", "x"][3 - values.ndim :]
    kinds = {"c": "channel", "y": "space", "x": "space"}
    scale = [{"type": "scale", "scale": [1.0] * values.ndim}]
    ome: dict[str, Any] = {
        "version": OME_VERSION,
        "multiscales": [
            {
                "name": name,
                "axes": [{"name": axis, "type": kinds[axis]} for axis in axes],
                "datasets": [{"path": "0", "coordinateTransformations": scale}],
            }
        ],
    }
    group.update_attributes({"ome": ome if label is None else {**ome, "image-label": label}})
    chunks = tuple(min(size, MAX_CHUNK_PX) for size in values.shape)
    group.create_array(
        "0",
        data=values,
        chunks=(*(1 for _ in axes[:-2]), *chunks[-2:]),
        # zarr's gzip writes the time into each chunk; equal maps must give equal bytes
        compressors=[BloscCodec(cname="zstd", clevel=5)],
        fill_value=fill,
        dimension_names=axes,
    )
