"""Convert frames and maps to labelled arrays, and labelled images to a session."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from capture.session import Session, SubjectRecord
from model.skin import SkinAppearance
from skinrig.errors import MissingExtra, UnusableError, UsageError
from skinrig.exporting.sessions.step_cubes import StepCube, arrange_steps, read_cube

if TYPE_CHECKING:
    import xarray

DIRECTION_NAMES: Final = ("direction_x", "direction_y", "direction_z")
STACK_AXES: Final = ("light", "y", "x")
MAX_CODE: Final = 65535
"""Largest code of the 16-bit images of a stack; it counts as saturated, so values stay below."""


def load_xarray() -> Any:
    """Return the module xarray.

    Raises
    ------
    MissingExtra
        If xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise MissingExtra("labelled arrays", "notebook") from error
    return xarray


def read_frames(session: Session, kind: str | None = None) -> xarray.Dataset:
    """Return the frames of one kind of step with named dimensions, in memory.

    Parameters
    ----------
    session
        Any session.
    kind
        Kind of step, such as "olat"; None: that of most frames.

    Returns
    -------
    xarray.Dataset
        ``image`` (DN), with dimensions of the steps' indices, camera, y and x; ``taken`` and
        ``planned``; levels, settings and reports of each frame. Frames that were not taken have
        the value of the attribute ``_FillValue``. See `skinrig export --to zarr`.

    Raises
    ------
    UnusableError
        If the session has no step of the kind.
    """
    cubes: dict[str, StepCube] = {cube.name: cube for cube in arrange_steps(session)}
    largest = max(cubes.values(), key=lambda cube: len(cube.steps)).name
    name = largest if kind is None else kind
    if name not in cubes:
        raise UnusableError(
            f"kind: got {name!r}, expected one of {', '.join(cubes)}; choose one of them"
        )

    def create_image(shape: tuple[int, ...], dtype: Any, fill: int) -> Any:
        return np.full(shape, fill, dtype)

    cube = cubes[name]
    arrays = read_cube(cube, session, create_image)
    found = {key: (one.axes, one.values, dict(one.attributes)) for key, one in arrays.items()}
    places = {key: found.pop(key) for key in (*cube.labels, *cube.keys) if key in found}
    dataset: xarray.Dataset = load_xarray().Dataset(found, places, {"session": session.id})
    return dataset


def maps_to_dataset(appearance: SkinAppearance) -> xarray.Dataset:
    """Return maps with their standard errors and valid pixels as labelled arrays.

    Parameters
    ----------
    appearance
        Any appearance.

    Returns
    -------
    xarray.Dataset
        NAME (dimensions y, x and of vectors channel), NAME_stderr, and NAME_valid; units as
        attributes. Maps of another size have dimensions of their own, with the size as suffix.
        Values outside the valid pixels are NaN.
    """
    variables: dict[str, Any] = {}
    sizes = [one.values.shape[:2] for one in appearance.maps.values()]
    usual = max(set(sizes), key=sizes.count) if sizes else (0, 0)
    for name, one in appearance.maps.items():
        height, width = one.values.shape[:2]
        axes = ("y", "x") if (height, width) == usual else (f"y_{height}", f"x_{width}")
        full = (*axes, "channel")[: one.values.ndim]
        about = {"units": one.unit, "long_name": one.description}
        outside = ~one.mask
        values = one.values.copy()
        values[outside] = np.nan
        variables[name] = (full, values, about)
        variables[f"{name}_valid"] = (axes, one.mask)
        if one.stderr is not None:
            errors = one.stderr.copy()
            errors[outside] = np.nan
            variables[f"{name}_stderr"] = (full, errors, {"units": one.unit})
    about_all = {"source": appearance.source}
    dataset: xarray.Dataset = load_xarray().Dataset(variables, attrs=about_all)
    return dataset


def write_stack_session(images: xarray.DataArray, out: Path, subject: SubjectRecord) -> Path:
    """Write images under one light each to a session, by the import of light lists.

    Parameters
    ----------
    images
        See `skinrig.load_session`.
    out
        New SESSION/ folder.
    subject
        Pseudonym and consent.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    UsageError
        If a dimension or a coordinate is missing, or a value is negative or infinite.
    capture.session.SessionError
        If the folder exists.
    """
    import tifffile

    from capture.importers.image_stacks import import_light_list

    missing = [axis for axis in STACK_AXES if axis not in images.dims]
    missing += [name for name in DIRECTION_NAMES if name not in images.coords]
    if missing:
        raise UsageError(
            f"images: got dimensions {', '.join(map(str, images.dims))} without "
            f"{', '.join(missing)}; expected {', '.join(STACK_AXES)}, and coordinates "
            f"{', '.join(DIRECTION_NAMES)} along light"
        )
    order = [*STACK_AXES, *(axis for axis in images.dims if axis not in STACK_AXES)]
    given = np.asarray(images.transpose(*order).values, np.float64)
    values = np.where(np.isnan(given), 0.0, given)
    if infinite := int(np.isinf(values).sum()):
        raise UsageError(
            f"images: got {infinite} infinite values, expected finite ones, or NaN where nothing "
            "was recorded; replace them"
        )
    if values.ndim > 4 or (values.ndim == 4 and values.shape[3] != 3) or values.min(initial=0) < 0:
        raise UsageError(
            f"images: got shape {values.shape} and minimum {values.min(initial=0):g}, expected "
            "(light, y, x) or (light, y, x, 3) of linear values, 0 or more"
        )
    directions = np.stack([np.asarray(images[name].values) for name in DIRECTION_NAMES], axis=1)
    scale = (MAX_CODE - 1) / max(float(values.max(initial=0.0)), 1e-300)
    with tempfile.TemporaryDirectory() as folder:
        names = [f"light{number:04}.tif" for number in range(len(values))]
        for name, one in zip(names, values, strict=True):
            codes = np.rint(one * scale).astype(np.uint16)
            photometric = "minisblack" if codes.ndim == 2 else "rgb"
            tifffile.imwrite(Path(folder) / name, codes, photometric=photometric)
        rows = [
            f"{n} {x:.9f} {y:.9f} {z:.9f}" for n, (x, y, z) in zip(names, directions, strict=True)
        ]
        (Path(folder) / "lights.lp").write_text("\n".join([str(len(rows)), *rows]) + "\n")
        import_light_list(folder, out=out, encoding="linear", subject=subject)
    return out
