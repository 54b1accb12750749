"""Arrange the frames of a session, and what their journal lines report, on grids of indices."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np

from capture.plan import Step, Value
from capture.raw import RawFrame
from capture.session import FrameRecord, Session
from skinrig.exporting.options import ExportError
from skinrig.exporting.sessions.copies import name_unit

MAX_CELLS_PER_STEP: Final = 2
"""Cells of a cube per planned step; sparser kinds get one dimension, the step."""
FILL_CODE: Final = 65535
"""Value of frames that were not taken, of sensors that saturate below it."""
FILL_CODE_WIDE: Final = -1
"""Value of frames that were not taken, as int32, of sensors that saturate at 65535."""
PIXEL_AXES: Final = ("y", "x")
CreateImage = Callable[[tuple[int, ...], Any, int], Any]
"""Create an image array of a shape, a dtype and a fill value, to which frames are assigned."""


@dataclass(frozen=True)
class LabelledArray:
    """Values with the names of their dimensions.

    Attributes
    ----------
    axes
        Name of each dimension.
    values
        The array.
    attributes
        Unit and further descriptions.
    """

    axes: tuple[str, ...]
    values: Any
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(axes: tuple[str, ...], values: Any, unit: str | None = None) -> LabelledArray:
        """Return values, texts as `StringDType`, with their unit."""
        data = np.asarray(values)
        if data.dtype.kind in "UO":
            data = data.astype(np.dtypes.StringDType())
        return LabelledArray(axes, data, {} if unit is None else {"units": unit})


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


def read_cube(
    cube: StepCube,
    session: Session,
    create_image: CreateImage,
    report_frame: Callable[[], None] = lambda: None,
) -> dict[str, LabelledArray]:
    """Return images, masks, coordinates and reported values of the steps of a cube.

    Coordinates have the name of their dimension. Frames are read one by one.

    Parameters
    ----------
    cube
        Steps of the session.
    session
        Any session.
    create_image
        Called once, when the first frame was read.
    report_frame
        Called before each frame.

    Raises
    ------
    ExportError
        If a frame has another size than its camera, or contains the fill value.
    capture.session.SessionDamage
        If a file differs from what was committed.
    """
    axes, shape = tuple(cube.labels), tuple(len(labels) for labels in cube.labels.values())
    found = {
        axis: LabelledArray.of((axis,), labels, name_unit(axis))
        for axis, labels in cube.labels.items()
    }
    if "step" in axes:
        for key in cube.keys:
            found[key] = LabelledArray.of(("step",), [step.index[key] for step in cube.steps])
    planned, taken = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    for step, camera in itertools.product(cube.steps, cube.cameras):
        planned[cube.cell(step, camera)] |= camera in step.cameras
    ids = {step.id for step in cube.steps}
    records = {
        cube.cell(record.step, record.camera): record
        for record in session.frames(cube.steps[0].kind)
        if record.step_id in ids and record.camera in cube.cameras
    }
    for cell, record in records.items():
        report_frame()
        frame = session.read(record)
        if "image" not in found:
            wide = frame.white >= FILL_CODE
            fill, dtype = (FILL_CODE_WIDE, np.int32) if wide else (FILL_CODE, np.uint16)
            image = create_image((*shape, *frame.cfa.shape), dtype, fill)
            about = {
                "_FillValue": fill,
                "units": "DN",
                "long_name": "sensor values as read out, row 0 at the top",
                "color_filter_array": frame.pattern,
            }
            found["image"] = LabelledArray((*axes, *PIXEL_AXES), image, about)
            white = np.full(shape, np.nan)
            black = np.full((*shape, len(frame.black)), np.nan)
            found["white_level"] = LabelledArray.of(axes, white, "DN")
            found["black_level"] = LabelledArray.of((*axes, "cell"), black, "DN")
        _check_frame(frame, image, f"{session.path / record.file}", black.shape[-1])
        image[cell], white[cell], black[cell] = frame.cfa, frame.white, frame.black
        taken[cell] = True
    found |= {"planned": LabelledArray(axes, planned), "taken": LabelledArray(axes, taken)}
    for name, values in _reported_values(records, shape).items():
        found[name] = LabelledArray.of(axes, values, name_unit(name))
    return found


def _check_frame(frame: RawFrame, image: Any, where: str, cells: int) -> None:
    """Raise for a frame of another size than the first, or with the fill value."""
    if frame.cfa.shape != image.shape[-2:] or len(frame.black) != cells:
        raise ExportError(
            f"{where}: got {frame.pattern} {frame.cfa.shape}, expected frames of "
            f"{image.shape[-2:]} as of the same camera before; restore the session"
        )
    if image.dtype == np.uint16 and frame.cfa.max(initial=0) == FILL_CODE:
        raise ExportError(
            f"{where}: got the value {FILL_CODE}, expected at most the sensor's white level "
            f"{frame.white}; export with --to frames instead"
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
        arrays[name] = array
    return arrays
