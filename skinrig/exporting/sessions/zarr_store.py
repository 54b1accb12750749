"""Write the frames of a session as Zarr arrays with named dimensions, one group per kind of step.

Zarr 3 without extensions other than strings; xarray, zarr-python and other readers open it. A frame
is one chunk, so that a session of any size is written and read frame by frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from capture.session import Session
from skinrig.console import format_count
from skinrig.errors import MissingExtra
from skinrig.exporting.options import ExportSettings
from skinrig.exporting.sessions.step_cubes import PIXEL_AXES, StepCube, arrange_steps, read_cube

if TYPE_CHECKING:
    from zarr import Group

STORE_FOLDER: Final = "session.zarr"
STORE_SCHEMA: Final = "skinrig.export.zarr/1"


def write(session: Session, out: Path, delivery: ExportSettings) -> list[tuple[str, str]]:
    """Write the last attempt of each committed frame, and what its journal line reports.

    Parameters
    ----------
    session
        Any session.
    out
        Existing folder; the store is `STORE_FOLDER` in it.
    delivery
        Only its `report` is used: frames are copied without any change.

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
        "schema": STORE_SCHEMA,
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
    total = len(session.frames())
    numbers = itertools.count(1)

    def report_frame() -> None:
        delivery.report(f"write {next(numbers)}/{total} frames")

    for cube in arrange_steps(session):
        _write_cube(root.create_group(cube.name), cube, session, report_frame)
    kept = "remains in the session; `skinrig export --to mhl` copies it"
    left_out = [(name, kept) for name in session.attachments()]
    steps: dict[str, list[str]] = {}
    for step, reason in session.omitted_steps().items():
        steps.setdefault(reason, []).append(step)
    return left_out + [
        (f"{format_count(len(ids), 'step')} from {ids[0]} on", reason)
        for reason, ids in steps.items()
    ]


def _write_cube(
    group: Group, cube: StepCube, session: Session, report_frame: Callable[[], None]
) -> None:
    """Write the arrays of one kind of step; frames go to the disk one by one."""
    axes = tuple(cube.labels)

    def create_image(shape: tuple[int, ...], dtype: Any, fill: int) -> Any:
        return group.create_array(
            "image",
            shape=shape,
            chunks=(*(1 for _ in axes), *shape[-2:]),
            dtype=dtype,
            fill_value=fill,
            dimension_names=(*axes, *PIXEL_AXES),
        )

    for name, one in read_cube(cube, session, create_image, report_frame).items():
        if name == "image":
            one.values.update_attributes(dict(one.attributes))
            continue
        group.create_array(
            name,
            data=one.values,
            chunks=one.values.shape,
            dimension_names=one.axes,
            attributes=dict(one.attributes),
        )
