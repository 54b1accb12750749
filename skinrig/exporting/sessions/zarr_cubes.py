"""Write the frames of a session as Zarr arrays with named dimensions, one group per kind of step.

Zarr 3 without extensions other than strings; xarray, zarr-python and other readers open it. A frame
is one chunk, so that a session of any size is written and read frame by frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from capture.plan import Step, Value
from capture.session import FrameRecord, Session
from skinrig.console import format_count
from skinrig.errors import MissingExtra
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sessions.copies import name_unit

if TYPE_CHECKING:
    from zarr import Group

STORE_FOLDER: Final = "session.zarr"
SCHEMA: Final = "skinrig.export.zarr/1"
MAX_CELLS_PER_STEP: Final = 2
"""Cells of a cube per planned step; sparser kinds get one dimension, the step."""
FILL_CODE: Final = 65535
"""Value of frames that were not taken, of sensors that saturate below it."""
FILL_CODE_WIDE: Final = -1
"""Value of frames that were not taken, as int32, of sensors that saturate at 65535."""
IMAGE_AXES: Final = ("camera", "y", "x")


@dataclass(frozen=True)
class StepCube:
    """Steps of one kind and frame size, on a grid of their indices.

    Attributes
    ----------
    name
        Name of the group.
    steps
        Steps in the order of the plan.
    cameras
        Views of these steps with the same frame size.
    keys
        Keys of the steps' indices.
    """

    name: str
    steps: tuple[Step, ...]
    cameras: tuple[str, ...]
    keys: tuple[str, ...]

    @cached_property
    def labels(self) -> dict[str, list[Any]]:
        """Labels of each dimension before y and x, in the order of the plan."""
        found: dict[str, list[Any]] = {
            key: list(dict.fromkeys(step.index[key] for step in self.steps)) for key in self.keys
        }
        cells = int(np.prod([len(labels) for labels in found.values()]))
        unique = len({tuple(step.index.values()) for step in self.steps}) == len(self.steps)
        if not self.keys or not unique or cells > MAX_CELLS_PER_STEP * len(self.steps):
            found = {"step": [step.id for step in self.steps]}
        return {**found, "camera": list(self.cameras)}

    @cached_property
    def _numbers(self) -> dict[str, dict[Any, int]]:
        return {
            axis: {label: number for number, label in enumerate(labels)}
            for axis, labels in self.labels.items()
        }

    def cell(self, step: Step, camera: str) -> tuple[int, ...]:
        """Return the position of a frame along the dimensions before y and x."""
        where = {**step.index, "step": step.id, "camera": camera}
        return tuple(numbers[where[axis]] for axis, numbers in self._numbers.items())


def write(session: Session, out: Path, delivery: ExportSettings) -> list[tuple[str, str]]:
    """Write the last attempt of each committed frame, and what its journal line reports.

    Parameters
    ----------
    session
        Any session.
    out
        Existing folder; the store is `STORE_FOLDER` in it.
    delivery
        Not used: frames are copied without any change.

    Returns
    -------
    list of (str, str)
        Parts of the session that the arrays do not contain.

    Raises
    ------
    MissingExtra
        If Zarr is not installed.
    ExportError
        If a frame has another size than its camera, or contains the fill value.
    """
    try:
        import zarr
    except ImportError as error:
        raise MissingExtra("export to Zarr", "zarr") from error
    manifest = session.manifest
    about = {
        "schema": SCHEMA,
        "session": session.id,
        "created_at": manifest.created_at.isoformat(),
        "content_hash": session.content_hash,
        "source": session.source,
        "seed": session.seed,
        "subject": manifest.to_json()["subject"],
        "rig": session.rig.name,
        "versions": dict(manifest.versions),
    }
    root = zarr.create_group(out / STORE_FOLDER, zarr_format=3, attributes=about)
    for cube in arrange_steps(session):
        _write_cube(root.create_group(cube.name), cube, session)
    kept = "remains in the session; `skinrig export --to mhl` copies it"
    left_out = [(name, kept) for name in session.attachments()]
    steps: dict[str, list[str]] = {}
    for step, reason in session.omitted_steps().items():
        steps.setdefault(reason, []).append(step)
    return left_out + [
        (f"{format_count(len(ids), 'step')} from {ids[0]} on", reason)
        for reason, ids in steps.items()
    ]


def arrange_steps(session: Session) -> Iterator[StepCube]:
    """Yield the planned steps of a session by kind, keys of their index, and frame size."""
    groups: dict[tuple[Any, ...], tuple[list[Step], dict[str, None]]] = {}
    for step in session.plan.steps:
        for camera in step.cameras:
            view = session.rig.view(camera)
            sort = (step.kind, tuple(step.index), view.height_px, view.width_px)
            steps, cameras = groups.setdefault(sort, ([], {}))
            if not steps or steps[-1] is not step:
                steps.append(step)
            cameras[camera] = None
    counts: dict[str, int] = {}
    for (kind, keys, *_), (steps, cameras) in groups.items():
        counts[kind] = counts.get(kind, 0) + 1
        name = kind if counts[kind] == 1 else f"{kind}-{counts[kind]}"
        yield StepCube(name, tuple(steps), tuple(cameras), keys)


def _write_cube(group: Group, cube: StepCube, session: Session) -> None:
    """Write images, masks, coordinates and reported values of the steps of one kind."""
    axes, shape = tuple(cube.labels), tuple(len(labels) for labels in cube.labels.values())
    for axis, labels in cube.labels.items():
        _put(group, axis, np.array(labels), (axis,), units=name_unit(axis))
    if "step" in axes:
        for key in cube.keys:
            _put(group, key, np.array([step.index[key] for step in cube.steps]), ("step",))
    planned, taken = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    records: dict[tuple[int, ...], FrameRecord] = {}
    ids = {step.id for step in cube.steps}
    for step, camera in itertools.product(cube.steps, cube.cameras):
        planned[cube.cell(step, camera)] |= camera in step.cameras
    for record in session.frames(cube.steps[0].kind):
        if record.step_id in ids and record.camera in cube.cameras:
            records[cube.cell(record.step, record.camera)] = record
    image: Any = None
    levels: dict[str, Any] = {}
    for cell, record in records.items():
        frame = session.read(record)
        if image is None:
            wide = frame.white >= FILL_CODE
            image = _create_image(group, (*shape, *frame.cfa.shape), axes, wide=wide)
            levels = {
                "white_level": np.full(shape, np.nan),
                "black_level": np.full((*shape, len(frame.black)), np.nan),
            }
            image.attrs["color_filter_array"] = frame.pattern
        if (
            frame.cfa.shape != image.shape[-2:]
            or len(frame.black) != levels["black_level"].shape[-1]
        ):
            raise ExportError(
                f"{session.path / record.file}: got {frame.pattern} {frame.cfa.shape}, expected "
                f"frames of {image.shape[-2:]} as of the same camera before; restore the session"
            )
        if image.dtype == np.uint16 and frame.cfa.max(initial=0) == FILL_CODE:
            raise ExportError(
                f"{session.path / record.file}: got the value {FILL_CODE}, expected at most the "
                f"sensor's white level {frame.white}; export with --to frames instead"
            )
        image[cell] = frame.cfa
        levels["white_level"][cell], levels["black_level"][cell] = frame.white, frame.black
        taken[cell] = True
    for name, values in levels.items():
        more = ("cell",) if values.ndim > len(axes) else ()
        _put(group, name, values, (*axes, *more), units="DN")
    _put(group, "planned", planned, axes)
    _put(group, "taken", taken, axes)
    for name, values in _reported_values(records, shape).items():
        _put(group, name, values, axes, units=name_unit(name))


def _create_image(
    group: Group, shape: tuple[int, ...], axes: tuple[str, ...], *, wide: bool
) -> Any:
    """Create the array of the frames, one chunk each, empty."""
    fill = FILL_CODE_WIDE if wide else FILL_CODE
    return group.create_array(
        "image",
        shape=shape,
        chunks=(*(1 for _ in axes), *shape[-2:]),
        dtype=np.int32 if wide else np.uint16,
        fill_value=fill,
        dimension_names=(*axes, *IMAGE_AXES[1:]),
        attributes={
            "_FillValue": fill,
            "units": "DN",
            "long_name": "sensor values as read out, row 0 at the top",
        },
    )


def _reported_values(
    records: Mapping[tuple[int, ...], FrameRecord], shape: tuple[int, ...]
) -> dict[str, Any]:
    """Return the journal's settings of all frames by name; missing: NaN, or an empty text."""
    rows: dict[tuple[int, ...], dict[str, Value]] = {
        cell: {
            "step_id": record.step_id,
            "attempt": record.attempt,
            "t_host_s": record.line.t_host_s,
            **{f"set_{key}": value for key, value in record.settings.items()},
            **{f"actual_{key}": value for key, value in record.actual.items()},
        }
        for cell, record in records.items()
    }
    arrays: dict[str, Any] = {}
    for name in dict.fromkeys(itertools.chain.from_iterable(rows.values())):
        values = {cell: row[name] for cell, row in rows.items() if name in row}
        text = any(isinstance(value, str) for value in values.values())
        array: Any = np.full(shape, "" if text else np.nan, dtype=object if text else np.float64)
        for cell, value in values.items():
            array[cell] = str(value) if text else float(value)
        arrays[name] = array.astype(np.dtypes.StringDType()) if text else array
    return arrays


def _put(
    group: Group, name: str, values: Any, axes: Sequence[str], *, units: str | None = None
) -> None:
    """Write a small array in one chunk."""
    data = values.astype(np.dtypes.StringDType()) if values.dtype.kind == "U" else values
    attributes: dict[str, Any] = {} if units is None else {"units": units}
    group.create_array(
        name, data=data, chunks=data.shape, dimension_names=tuple(axes), attributes=attributes
    )
