"""Copy a session without its eyes and landmarks, or without its images; the original is only read.

The copy is a session of its own: new identifier, new seal, the subject's consent unchanged.
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
from capture.arrays import UInt16Array
from capture.session import Session, SubjectRecord
from skinrig.errors import UnusableError, UsageError

DEFAULT_RADIUS = 0.05
"""Radius of the black disc at a landmark, of the image's width."""
MIN_RADIUS_PX = 2.0
NO_IMAGES = "images removed to anonymize the session"
EXTRA_KEY = "anonymized"
"""Key of the manifest's further values: what was made black or removed."""
SUBJECTLESS_KINDS = ("dark", "flat", "chart", "malus", "ball", "phantom", "mask")
"""Kinds of steps that show no subject."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnonymizationOrder:
    """What to hide, and under which name.

    Attributes
    ----------
    landmarks
        Positions by view and name, pixels: each becomes the center of a black disc.
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

    landmarks: Mapping[str, Mapping[str, tuple[float, float]]]
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


def blacken_discs(
    cfa: UInt16Array,
    centers_px: Sequence[tuple[float, float]],
    radius_px: float,
    black: Sequence[float],
) -> UInt16Array:
    """Return sensor values with black discs; the input is not modified.

    Parameters
    ----------
    cfa
        (H, W) uint16 DN, row 0 at the top.
    centers_px
        Centers x, y, px; pixel (0, 0)'s center is (0, 0).
    radius_px
        Radius, px.
    black
        Black level, DN, of each position of the 2 x 2 cell row by row; one value for MONO.

    Examples
    --------
    >>> image = np.full((5, 5), 900, np.uint16)
    >>> blacken_discs(image, [(2.0, 1.0)], 1.0, (64.0,)).tolist()[1]
    [900, 64, 64, 64, 900]
    """
    height, width = cfa.shape
    y, x = np.mgrid[:height, :width]
    hidden = np.zeros(cfa.shape, bool)
    for center_x, center_y in centers_px:
        hidden |= np.hypot(x - center_x, y - center_y) <= radius_px
    levels = np.resize(np.rint(np.asarray(black)), 4).reshape(2, 2)
    cells = np.tile(levels, (-(-height // 2), -(-width // 2)))[:height, :width]
    return np.where(hidden, cells, cfa).astype(np.uint16)


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
    SessionError
        When the session is damaged, or the folder is not free.
    """
    source = Session.open(path)
    if not source.closed:
        raise UsageError(f"{path}: not closed; complete it with --resume first")
    _require_views(source, order)
    hidden = {
        "radius": order.radius,
        "landmarks": {view: sorted(named) for view, named in order.landmarks.items()},
        "images": "removed" if order.drop_images else "kept",
        "attachments": len(source.attachments()),
    }
    manifest, subject, fresh = source.manifest, source.subject, not out.exists()
    if order.pseudonym is not None:
        subject = SubjectRecord(order.pseudonym, subject.consent_scope, subject.consent_expires)
    target = Session.create(
        out,
        plan=source.plan,
        rig=source.rig,
        devices=dict(manifest.devices),
        subject=subject,
        source=source.source,
        calibrations=manifest.calibrations,
        seed=source.seed,
        extra={**manifest.extra, EXTRA_KEY: hidden},
        session_id=uuid.uuid4().hex,
        now=lambda: manifest.created_at,
    )
    blackened = 0
    with _remove_on_error(out, fresh=fresh), target:
        for number, (record, frame, is_hidden) in enumerate(_hide_frames(source, order), start=1):
            blackened += is_hidden
            target.commit(
                record.step_id,
                record.camera,
                raw.encode_frame(replace(frame, session_id=target.id, captured_at=None)),
                settings=record.settings,
                actual=record.actual,
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


def _hide_frames(
    source: Session, order: AnonymizationOrder
) -> Iterator[tuple[Any, raw.RawFrame, bool]]:
    """Yield each frame's record, the frame with black discs, and whether it has any."""
    for record in () if order.drop_images else source.frames():
        frame = source.read(record)
        if record.kind in SUBJECTLESS_KINDS:
            yield record, frame, False
            continue
        radius_px = max(order.radius * frame.cfa.shape[1], MIN_RADIUS_PX)
        centers_px = list(order.landmarks[record.camera].values())
        cfa = blacken_discs(frame.cfa, centers_px, radius_px, frame.black)
        yield record, replace(frame, cfa=cfa), True


def _list_identifiable(source: Session, order: AnonymizationOrder) -> Iterator[str]:
    """Yield what still identifies the subject after the anonymization."""
    if not order.drop_images:
        yield "skin outside the black discs: nevi, scars, wrinkles, hair and the face's outline"
        yield "a subject who moved during the session may show what the discs cover in other frames"
    if order.pseudonym is None:
        yield f"the pseudonym {source.subject.pseudonym!r}, which other sessions may share"
    yield f"the time of capture, {source.manifest.created_at.isoformat()}, and that of each frame"
    yield "serial numbers of cameras and addresses of controllers, which name the laboratory"
    if source.manifest.extra:
        names = ", ".join(sorted(source.manifest.extra))
        yield f"further values of the manifest: {names}"
    yield "maps and meshes that were computed from the original session: this copy has none"
