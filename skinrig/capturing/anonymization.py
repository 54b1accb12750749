"""Copy a session without its eyes and landmarks, or without its images; the original is only read.

The copy is a session of its own: new identifier, new seal, the subject's consent unchanged. What
links it to the photographs or to other sessions is left out where no reader needs it.
"""

import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture import raw
from capture.arrays import BoolArray, UInt16Array
from capture.importers.photos import UNEQUAL_PAIR_NOTE
from capture.plan import Plan, Step
from capture.rig import View
from capture.session import Session, SubjectRecord
from reconstruction.correspondence.landmark_table import LandmarkError, read_landmark_table
from skinrig.errors import UnusableError, UsageError

DEFAULT_RADIUS = 0.05
"""Radius of the black disc at a landmark, of the image's width."""
MIN_RADIUS_PX = 2.0
NO_IMAGES = "images removed to anonymize the session"
EXTRA_KEY = "anonymized"
"""Key of the manifest's further values: what was made black or removed."""
SUBJECTLESS_KINDS = ("dark", "flat", "chart", "malus", "ball", "phantom", "mask")
"""Kinds of steps that show no subject."""
KEPT_STATE = "neutral"
"""The only state of photographs that keeps its name: the others are aligned to it."""
LINKING_KEYS = frozenset({"token", "run"})
"""Entries of a frame that name the run of the controller; no reader of a session uses them."""

_Landmarks = Mapping[str, Mapping[str, tuple[float, float]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class AnonymizationOrder:
    """What to hide, and under which name.

    Attributes
    ----------
    landmarks
        Table ``name,x,y`` by view, in pixels of its maps: each row becomes the center of a black
        disc. Maps of a color filter array have half the width of the sensor.
    radius
        Radius of the discs, of the image's width, > 0.
    drop_images
        Whether to keep no frame at all.
    pseudonym
        New pseudonym of the subject; None: that of the session.

    Raises
    ------
    UsageError
        When nothing, or both, is to be hidden.
    UnusableError
        For a radius that is not above 0.
    """

    landmarks: Mapping[str, Path]
    radius: float = DEFAULT_RADIUS
    drop_images: bool = False
    pseudonym: str | None = None

    def __post_init__(self) -> None:
        if bool(self.landmarks) == self.drop_images:
            raise UsageError(
                "what to hide: got "
                + ("landmarks and --drop-images" if self.drop_images else "nothing")
                + ", expected --landmarks VIEW=FILE for each view, or --drop-images"
            )
        if not 0.0 < self.radius < 1.0:
            raise UnusableError(
                f"--radius: got {self.radius:g}, expected a fraction of the image's width, "
                "above 0 and below 1"
            )


@dataclass(frozen=True, slots=True)
class AnonymizedSession:
    """Result of an anonymization.

    Attributes
    ----------
    path
        The new session.
    frames, blackened
        Number of frames, and of those with black pixels.
    removed
        Names of removed attachments.
    identifiable
        What still identifies the subject, a sentence each.
    """

    path: Path
    frames: int
    blackened: int
    removed: tuple[str, ...]
    identifiable: tuple[str, ...]


def find_disc_pixels(
    shape: tuple[int, ...], centers_px: Sequence[tuple[float, float]], radius_px: float
) -> BoolArray:
    """Return the mask of the pixels in discs, (H, W).

    Parameters
    ----------
    shape
        Height and width, px.
    centers_px
        Centers x, y, px; pixel (0, 0)'s center is (0, 0).
    radius_px
        Radius, px.

    Examples
    --------
    >>> find_disc_pixels((2, 5), [(2.0, 1.0)], 1.0)[1].tolist()
    [False, True, True, True, False]
    """
    y, x = np.indices(shape)
    hidden = np.zeros(shape, bool)
    for center_x, center_y in centers_px:
        hidden |= np.hypot(x - center_x, y - center_y) <= radius_px
    return hidden


def blacken_pixels(cfa: UInt16Array, hidden: BoolArray, black: Sequence[float]) -> UInt16Array:
    """Return sensor values with black pixels; the input is not modified.

    Parameters
    ----------
    cfa
        (H, W) uint16 DN, row 0 at the top.
    hidden
        (H, W) pixels to make black.
    black
        Black level, DN, of each position of the 2 x 2 cell row by row; one value for MONO.

    Examples
    --------
    >>> image = np.full((1, 3), 900, np.uint16)
    >>> blacken_pixels(image, np.array([[False, True, False]]), (64.0,)).tolist()
    [[900, 64, 900]]
    """
    height, width = cfa.shape
    levels = np.resize(np.rint(np.asarray(black)), 4).reshape(2, 2)
    cells = np.tile(levels, (-(-height // 2), -(-width // 2)))[:height, :width]
    return np.where(hidden, cells, cfa).astype(np.uint16)


def to_sensor_pixels(point: tuple[float, float], view: View) -> tuple[float, float]:
    """Transform a point from map pixels to sensor pixels of a view.

    A map of a color filter array has one pixel per 2 x 2 cell: its first pixel's center is at
    (0.5, 0.5) on the sensor. Maps of a monochrome sensor have its pixels.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> to_sensor_pixels((3.0, 0.0), load_rig("flash").view("cam"))
    (6.5, 0.5)
    """
    x, y = point
    return (x, y) if view.cfa == "MONO" else (2.0 * x + 0.5, 2.0 * y + 0.5)


def anonymize_session(
    path: Path,
    out: Path,
    order: AnonymizationOrder,
    progress: Callable[[str], None] = lambda line: None,
) -> AnonymizedSession:
    """Write a copy of a session without eyes and landmarks, or without images.

    Attachments are removed: meshes and scans show the whole face. Frames without a subject, such
    as darks, are kept as they are.

    Parameters
    ----------
    path
        Session, closed.
    out
        New folder.
    order
        What to hide.
    progress
        Called with a line per ten frames.

    Raises
    ------
    UsageError
        For an open session, a view without landmarks, or one that the session does not have.
    LandmarkError
        For a table without rows, or a landmark outside the image.
    SessionError
        When the session is damaged, or the folder is not free.
    """
    source = Session.open(path)
    if not source.closed:
        raise UsageError(f"{path}: not closed; complete it with --resume first")
    _require_views(source, order)
    landmarks = {
        view: _read_landmarks(file, source.rig.view(view)) for view, file in order.landmarks.items()
    }
    hidden = {
        "radius": order.radius,
        "landmarks": {view: sorted(named) for view, named in landmarks.items()},
        "images": "removed" if order.drop_images else "kept",
        "attachments": len(source.attachments()),
    }
    manifest, subject, fresh = source.manifest, source.subject, not out.exists()
    if order.pseudonym is not None:
        subject = SubjectRecord(order.pseudonym, subject.consent_scope, subject.consent_expires)
    target = Session.create(
        out,
        plan=_rename_states(source),
        rig=source.rig,
        devices=dict(manifest.devices),
        subject=subject,
        source=source.source,
        calibrations=[replace(one, path="") for one in manifest.calibrations],
        seed=source.seed,
        extra={**_remove_links(manifest.extra), EXTRA_KEY: hidden},
        session_id=uuid.uuid4().hex,
        now=lambda: manifest.created_at,
    )
    blackened = 0
    with _remove_on_error(out, fresh=fresh), target:
        shots = _hide_frames(source, order, landmarks)
        for number, (record, frame, is_hidden) in enumerate(shots, start=1):
            blackened += is_hidden
            target.commit(
                record.step_id,
                record.camera,
                raw.encode_frame(replace(frame, session_id=target.id, captured_at=None)),
                settings=record.settings,
                actual=_drop_linking_keys(record.actual),
                t_box_s=record.line.t_box_s,
                t_host_s=record.line.t_host_s,
            )
            if number % 10 == 0:
                progress(f"{number} frames")
        for step_id, reason in source.omitted_steps().items():
            target.omit_steps([step_id], reason=reason, t_host_s=0.0)
        reason = NO_IMAGES if order.drop_images else "missing in the original session"
        target.close(missing_reason=reason)
    return AnonymizedSession(
        out,
        len(target.frames()),
        blackened,
        source.attachments(),
        tuple(_list_identifiable(source, order)),
    )


@contextmanager
def _remove_on_error(out: Path, *, fresh: bool) -> Iterator[None]:
    """Remove the files of the new session if the block raises: nothing half hidden stays."""
    try:
        yield
    except BaseException:
        for entry in out.iterdir():
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
        if fresh:
            out.rmdir()
        raise


def _require_views(source: Session, order: AnonymizationOrder) -> None:
    shown = {record.camera for record in source.frames() if record.kind not in SUBJECTLESS_KINDS}
    known = {view.name for view in source.rig.all_views}
    if unknown := sorted(set(order.landmarks) - known):
        raise UsageError(
            f"--landmarks: got the view {unknown[0]!r}, the session has {', '.join(sorted(known))}"
        )
    missing = sorted(shown - set(order.landmarks))
    if missing and not order.drop_images:
        raise UsageError(
            f"--landmarks: got none for the view {missing[0]!r}, expected a table for each view "
            "that shows the subject; add --landmarks VIEW=FILE, or use --drop-images"
        )


def _read_landmarks(file: Path, view: View) -> Mapping[str, tuple[float, float]]:
    """Return a table's points on the sensor, px; refuse an empty table and points outside."""
    cell = 1 if view.cfa == "MONO" else 2
    width, height = view.width_px // cell, view.height_px // cell
    found = read_landmark_table(file)
    if not found:
        raise LandmarkError(f"{file}: got no landmark, expected at least one; add a row per eye")
    for name, (x, y) in found.items():
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise LandmarkError(
                f"{file}: {name!r}: got ({x:g}, {y:g}), expected a point of the {width} x {height} "
                f"pixels of the maps of view {view.name!r}; correct it"
            )
    return {name: to_sensor_pixels(point, view) for name, point in found.items()}


def _hide_frames(
    source: Session, order: AnonymizationOrder, landmarks: _Landmarks
) -> Iterator[tuple[Any, raw.RawFrame, bool]]:
    """Yield each frame's record, the frame with black discs, and whether it has any."""
    for record in () if order.drop_images else source.frames():
        frame = source.read(record)
        frame = replace(frame, light=_drop_linking_keys(frame.light))
        if record.kind in SUBJECTLESS_KINDS:
            yield record, frame, False
            continue
        radius_px = max(order.radius * frame.cfa.shape[1], MIN_RADIUS_PX)
        centers_px = list(landmarks[record.camera].values())
        hidden = find_disc_pixels(frame.cfa.shape, centers_px, radius_px)
        cfa = blacken_pixels(frame.cfa, hidden, frame.black)
        yield record, replace(frame, cfa=cfa), bool(hidden.any())


def _drop_linking_keys(entries: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entries.items() if key not in LINKING_KEYS}


def _list_states(plan: Plan) -> list[str]:
    """Return the names of states but the neutral one, in the order of the plan."""
    named = dict.fromkeys(str(one.index["state"]) for one in plan.steps if "state" in one.index)
    return [state for state in named if state != KEPT_STATE]


def _rename_states(source: Session) -> Plan:
    """Return the plan; states of photographs, named after files, become numbers."""
    if "photographs" not in source.manifest.extra:
        return source.plan
    states = _list_states(source.plan)
    numbered = {state: f"state-{number}" for number, state in enumerate(states, start=1)}

    def rename(step: Step) -> Step:
        state = str(step.index.get("state"))
        if state not in numbered:
            return step
        return replace(step, index={**step.index, "state": numbered[state]})

    return replace(source.plan, steps=tuple(map(rename, source.plan.steps)))


def _remove_links(extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return the further values without names and hashes of the photographs' files."""
    kept = dict(extra)
    if "photographs" in kept:
        kept["photographs"] = [
            {key: value for key, value in photo.items() if key != "sha256"}
            for photo in kept["photographs"]
        ]
        kept["assumed"] = [
            f"two photographs {UNEQUAL_PAIR_NOTE}" if text.endswith(UNEQUAL_PAIR_NOTE) else text
            for text in kept.get("assumed", ())
        ]
    return kept


def _list_identifiable(source: Session, order: AnonymizationOrder) -> Iterator[str]:
    """Yield what still identifies the subject after the anonymization."""
    if not order.drop_images:
        yield "skin outside the black discs: nevi, scars, wrinkles, hair and the face's outline"
        yield "a subject who moved during the session may show what the discs cover in other frames"
    if order.pseudonym is None:
        yield f"the pseudonym {source.subject.pseudonym!r}, which other sessions may share"
    yield f"the time of capture, {source.manifest.created_at.isoformat()}, and that of each frame"
    yield "serial numbers of cameras and addresses of controllers, which name the laboratory"
    if source.manifest.calibrations:
        yield "hashes of calibrations, which other sessions of the laboratory share"
    states = _list_states(source.plan)
    if states and "photographs" not in source.manifest.extra:
        yield f"the names of states: {', '.join(states)}"
    if source.manifest.extra:
        names = ", ".join(sorted(source.manifest.extra))
        yield f"further values of the manifest: {names}"
    yield "maps and meshes that were computed from the original session: this copy has none"
