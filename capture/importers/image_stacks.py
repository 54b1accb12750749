"""Import images of one object under many lights into a closed SESSION/."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from capture import raw
from capture.arrays import Float64Array, FloatArray
from capture.documents import Fault
from capture.importers import light_lists
from capture.importers.image_checks import PhotoError
from capture.importers.images import Photo, read_photo
from capture.importers.imported_session import (
    DISTANCE_MM,
    create_imported_session,
    find_common_white,
    hash_file,
    make_placeholder_light,
    make_placeholder_rig,
    make_placeholder_view,
    restate_white,
)
from capture.importers.light_lists import LightList
from capture.importers.light_tables import LightListError
from capture.plan import Plan, Step, Value
from capture.rig import Rig
from capture.session import Session, SubjectRecord

Encoding = Literal["auto", "sRGB", "linear"]

LIGHT_LIST_RIG_NAME = "light-list"
N_SAMPLE_POINTS = 3000
LINEAR_MISFIT_RATIO = 0.8
"""Values count as linear when their misfit is below this fraction of the sRGB misfit."""


@dataclass(frozen=True, slots=True)
class ImageStackImport:
    """Result of an import of images with a light list."""

    path: str
    """The SESSION/ folder."""
    frames: int
    lights: str
    """Source of the lights: file or folder, and kind."""
    encoding: str
    """Interpretation of the values: "raw", "linear" or "sRGB"."""
    mask: str
    """Name of the mask's file, empty when there is none."""
    assumed: list[str]


def import_light_list(
    directory: str | Path,
    *,
    out: str | Path,
    lights: str | Path | LightList | None = None,
    mask: str | Path | None = None,
    encoding: Encoding = "auto",
    resolved_encoding: Encoding = "auto",
    mm_per_px: float | None = None,
    subject: SubjectRecord | None = None,
    assumed: Sequence[str] = (),
    video: Mapping[str, Any] | None = None,
    now: Callable[[], datetime] | None = None,
) -> ImageStackImport:
    """Import images of one object under many lights into a closed session; all, or none.

    Parameters
    ----------
    directory : str or Path
        Folder of the images, in any format that `read_photo` reads; see `light_lists.find`.
    out : str or Path
        The new SESSION/ folder.
    lights : str, Path or LightList, optional
        Light list or folder of a chrome ball; default: found in the folder.
    mask : str or Path, optional
        Image that is bright where the object is; default the folder's own ``*mask*``.
    encoding : {"auto", "sRGB", "linear"}
        Encoding of 8-bit and PNG values. "auto" reads them as linear when three images then predict
        the others clearly better, because light adds up linearly.
    resolved_encoding : {"auto", "sRGB", "linear"}
        What the caller found in the images where `encoding` is "auto"; not recorded as asked.
    mm_per_px : float, optional
        Size of a pixel at the object: then the list's rows are positions in mm around the image's
        center, and the lights are near.
    subject : Subject, optional
        Subject of the images; default an unnamed one.
    assumed : sequence of str
        What the caller assumed about images and lights; stored with the import's own assumptions.
    video : mapping, optional
        Description of the video whose frames these are, for the manifest; see `ImageSource`.
    now : callable, optional
        Clock, returns a time with its zone.

    Returns
    -------
    ImportedStack

    Raises
    ------
    LightListError, PhotoError
        When the input is invalid; the message names the fault, and nothing is written.
    SessionError
        When `out` is not free.
    """
    clock = now or (lambda: datetime.now(UTC))
    if encoding not in ("auto", "sRGB", "linear"):
        raise LightListError.at("cannot be read so", "encoding", encoding, "auto, sRGB or linear")
    if isinstance(lights, LightList):
        found = lights
    else:
        source = Path(lights) if lights else None
        found = light_lists.find_light_list(Path(directory), lights=source)
    if len(found.images) < 3:
        raise LightListError(
            "has too few images",
            where=str(directory),
            faults=[Fault("pictures", str(len(found.images)), "at least 3, one per light")],
            advice="Name a folder with more images.",
            code="SR-IMP-009",
        )
    near = mm_per_px is not None
    if near and found.kind == "images":
        raise LightListError.at(
            "has no positions", "mm_per_px", str(mm_per_px), "none with estimated directions"
        )
    if mm_per_px is not None and not 0 < mm_per_px < 1e3:
        raise LightListError.at("has no such scale", "mm_per_px", str(mm_per_px), "0 < mm < 1000")
    where_mask = Path(mask) if mask else light_lists.find_mask(found.images[0].parent)
    sampled, first, notes = _sample(found, where_mask)
    read_as = resolved_encoding if encoding == "auto" else encoding
    as_linear = first.encoding == "sRGB" and (
        read_as == "linear" or (read_as == "auto" and _is_linear_despite_encoding(sampled, found))
    )
    shown = "linear" if as_linear else first.encoding
    every = _list_assumptions(found, notes, near=near, as_linear=as_linear, encoding=encoding)
    every = [*assumed, *every]
    rig = _rig(found, first.frame, near=near)
    steps = _steps(found)
    extra = {
        "assumed": every,
        "light_list": {
            "kind": found.kind,
            "near": near,
            "mm_per_px": mm_per_px,
            "encoding": shown,
            "intensity": None if found.intensity is None else found.intensity.tolist(),
            "stderr_deg": None if found.stderr_deg is None else found.stderr_deg.tolist(),
        },
        "photographs": [
            {"step": step.id, "sha256": hash_file(file), "encoding": shown}
            for step, file in zip(steps, found.images, strict=True)
        ],
    } | ({"video": dict(video)} if video else {})
    target = Path(out)
    with create_imported_session(
        target, Plan(rig.name, steps), rig, subject, extra, clock
    ) as session:
        if where_mask is not None:
            session.attach("mask.png", _mask_png(where_mask, first.frame))
        for step, file in zip(steps, found.images, strict=True):
            photo = read_photo(file, white_value=first.white_value)
            _commit(session, step, photo, clock, as_linear=as_linear)
    listed, masked = f"{found.file} ({found.kind})", where_mask.name if where_mask else ""
    return ImageStackImport(str(target), len(steps), listed, shown, masked, every)


def _list_properties(photo: Photo) -> tuple[str, ...]:
    """Return what all images of a stack have in common: they are not turned differently."""
    height, width = _pixel_shape(photo.frame)
    turned = () if photo.orientation == 1 else (f"EXIF orientation {photo.orientation}",)
    size = f"{width} x {height}"
    return (photo.encoding, size, photo.frame.pattern, *turned, str(photo.frame.white))


def _pixel_shape(frame: raw.RawFrame) -> tuple[int, int]:
    """Return rows and columns of an imported image: a 2 x 2 cell is one pixel, unless MONO."""
    height, width = frame.cfa.shape
    return (height, width) if frame.pattern == "MONO" else (height // 2, width // 2)


def encode_srgb(linear: FloatArray) -> FloatArray:
    """Encode linear light in [0, 1] as display values, IEC 61966-2-1.

    Examples
    --------
    >>> encode_srgb(np.array([0.0, 0.214041, 1.0])).round(5).tolist()
    [0.0, 0.5, 1.0]
    """
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _sample(found: LightList, mask: Path | None) -> tuple[Float64Array, Photo, dict[str, None]]:
    """Read every image once; return samples (N, P) over white, the first photo, and its notes."""
    rows, notes, faults = [], {}, []
    whites: list[float | None] = []
    first: Photo | None = None
    chosen: NDArray[np.intp] | None = None
    for file in found.images:
        photo = read_photo(file)
        frame = photo.frame
        notes.update(dict.fromkeys(photo.notes))
        shape = _pixel_shape(frame)
        if first is None:
            first = photo
            inside = np.ones(shape, bool) if mask is None else light_lists.read_mask(mask, shape)
            places = np.flatnonzero(inside)
            chosen = places[:: max(1, places.size // N_SAMPLE_POINTS)]
        if _list_properties(photo) != _list_properties(first):
            got, expected = (" ".join(_list_properties(one)[:-1]) for one in (photo, first))
            faults.append(Fault(file.name, got, expected))
            continue
        whites.append(photo.white_value)
        (black, *_), white = frame.black, frame.white
        gray = light_lists.to_gray(frame).reshape(-1)[chosen].astype(np.float64)
        rows.append((gray - black) / (white - black))
    if faults or first is None:
        raise PhotoError(
            "images differ",
            where=str(found.images[0].parent),
            faults=faults,
            advice="Use images of one camera and one setting, turned alike.",
            code="SR-IMP-010",
        )
    samples = np.array(rows)
    white_value = find_common_white(whites)
    if white_value is not None:
        samples *= np.array([1.0 if w is None else w / white_value for w in whites])[:, None]
        first = replace(first, white_value=white_value)
        notes = dict.fromkeys(restate_white(list(notes), white_value))
    return samples, first, notes


def _is_linear_despite_encoding(samples: Float64Array, found: LightList) -> bool:
    """Return whether the stored values fit the shading model better than their decoded light."""
    decoded = np.clip(samples, 0.0, 1.0)
    codes = np.asarray(encode_srgb(decoded))
    return _misfit(codes, found.directions) < LINEAR_MISFIT_RATIO * _misfit(
        decoded, found.directions
    )


def _misfit(samples: FloatArray, directions: Float64Array) -> float:
    """Return the mean residual of a matte shading over the mean, from the brightest samples."""
    lit = samples[:, samples.mean(axis=0) > 0.02]
    if lit.shape[1] < 10 or len(lit) < 4:
        return 1.0
    weight = lit**2
    A = np.einsum("np,ni,nj->pij", weight, directions, directions)
    A = A + 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    b = np.linalg.solve(A, np.einsum("np,ni->pi", weight * lit, directions)[..., None])[..., 0]
    residual = np.abs(lit - np.maximum(directions @ b.T, 0.0))
    return float(residual.mean() / lit.mean())


def _list_assumptions(
    found: LightList, notes: dict[str, None], *, near: bool, as_linear: bool, encoding: Encoding
) -> list[str]:
    texts = [n for n in notes if not (as_linear and "were decoded by the sRGB curve" in n)]
    if as_linear:
        why = "as asked" if encoding == "linear" else "since shading adds up so, not as sRGB"
        texts.append(f"the files' values count as linear light, {why}")
    if not near:
        texts.append("the lights are far away: only their directions count")
        if not found.has_unit_vectors:
            texts.append("the list's rows are positions; give mm_per_px to use them as such")
    if found.kind == "images":
        return texts
    if found.intensity is None:
        texts.append("all lights are of one strength, over the exposure where files state it")
    if found.kind != "lp":
        texts.append("the lights are in the order of the images' names, numbers sorted by value")
    return texts


def _rig(found: LightList, frame: raw.RawFrame, *, near: bool) -> Rig:
    positions = found.vectors if near else DISTANCE_MM * found.directions
    lights = [
        make_placeholder_light(f"L{k:03d}", (float(x), float(y), float(z)), "D65")
        for k, (x, y, z) in enumerate(positions)
    ]
    return make_placeholder_rig(
        LIGHT_LIST_RIG_NAME,
        lights,
        make_placeholder_view(frame, spectral_sensitivity="linear sRGB"),
    )


def _steps(found: LightList) -> tuple[Step, ...]:
    steps = []
    for number in range(len(found.images)):
        light = f"L{number:03d}"
        index: dict[str, str | int | float] = {"light": light, "exposure": 0, "pass": 0}
        settings: dict[str, Value] = {"light": light}
        steps.append(Step(f"P{number:04d}", "olat", index, settings, ("cam",)))
    return tuple(steps)


def _mask_png(path: Path, frame: raw.RawFrame) -> bytes:
    import cv2

    inside = light_lists.read_mask(path, _pixel_shape(frame))
    _, data = cv2.imencode(".png", inside.astype(np.uint8) * 255)
    return bytes(data)


def _commit(
    session: Session, step: Step, photo: Photo, clock: Callable[[], datetime], *, as_linear: bool
) -> None:
    frame = photo.frame
    if as_linear:
        share = np.arange(frame.white + 1) / frame.white
        undone = np.rint(frame.white * encode_srgb(share)).astype(np.uint16)
        frame = replace(frame, cfa=undone[np.minimum(frame.cfa, frame.white)])
    settings: dict[str, Value] = {**step.settings, **photo.exposure_settings}
    frame = replace(frame, camera_serial="unknown", step_id=step.id, session_id=session.id)
    blob, now_s = raw.encode_frame(frame), clock().timestamp()
    session.commit(step.id, "cam", blob, settings=settings, actual={}, t_host_s=now_s)
