"""Import a folder of photographs into a closed SESSION/, with every assumption recorded."""

import logging
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from capture import raw
from capture.documents import Fault, InputError
from capture.importers.framing import Framing
from capture.importers.image_checks import VIDEO_SUFFIXES, PhotoError, advise_conversion
from capture.importers.images import Encoding, Photo, read_photo
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
from capture.importers.pair_exposures import relate_exposures
from capture.importers.video_frames import ImageSource
from capture.plan import Kind, Plan, Step, Value
from capture.rig import Rig, View
from capture.session import Session, SubjectRecord

logger = logging.getLogger(__name__)

Report = Callable[[str], None]

IMPORTED_RIG_NAME = "imported"
UNKNOWN_SERIAL = "unknown"
RAW_CURVES = "Nikon 5100 (NPL)"  # assumed for a camera without a measured sensitivity
IMAGE_CURVES = "linear sRGB"
SIDECAR_SUFFIXES = VIDEO_SUFFIXES | frozenset(
    ".txt .md .csv .json .npy .lp .xmp .aae .thm .pp3 .dop .xml .html .pdf .doc .docx .xlsx .zip"
    " .db .ini".split()
)
UNEQUAL_PAIR_NOTE = "differ in color or size, so that no specular image follows from them"
"""End of an assumption that begins with the names of two files."""
_POLARIZER_WORDS = {"parallel": "parallel", "crossed": "crossed", "cross": "crossed"}


@dataclass(frozen=True, slots=True)
class PhotoImport:
    """Result of an import."""

    path: str
    """The SESSION/ folder."""
    frames: int
    assumed: list[str]
    """Assumptions, one sentence each; also in the session's manifest."""
    states: tuple[str, ...]
    """Names of the subject's states, one per photograph or pair of photographs."""
    ignored: tuple[str, ...]
    """Omitted files that are not photographs."""
    color_states: tuple[str, ...] = ()
    """Subset of `states` with color photographs; chromophores need color."""
    has_pairs: bool = False
    """Whether a state has a parallel and a crossed photograph of one size and color.

    Both files name their polarizer: one that names none counts as crossed by assumption only.
    """


@dataclass(frozen=True, slots=True)
class _Entry:
    """One valid photograph, before it is written."""

    file: Path
    sha256: str
    encoding: Encoding
    view: View
    exposure: Mapping[str, str | int | float]
    """Settings of the exposure that the file states, see `Photo.exposure_settings`."""
    notes: tuple[str, ...]
    white_value: float | None
    framing: Framing
    face: tuple[float, ...]
    """Square of the face relative to the image, see `Framing.locate`; empty: not looked for."""
    turn_raw: bool = True
    """See `read_photo`."""

    @property
    def camera(self) -> tuple[object, ...]:
        """Key that distinguishes one camera (and its setting) from another."""
        view = self.view
        shape = (view.height_px, view.width_px)
        return view.camera_model, view.cfa, shape, view.black_level, view.white_level


def import_photos(
    directory: str | Path,
    *,
    out: str | Path,
    rig: Rig | None = None,
    camera_serial: str = UNKNOWN_SERIAL,
    sensitivity: str | None = None,
    illuminant: str | None = None,
    kind: Kind = "subject",
    subject: SubjectRecord | None = None,
    framing: Framing | None = None,
    source: ImageSource | None = None,
    progress: Report = lambda _text: None,
    now: Callable[[], datetime] | None = None,
) -> PhotoImport:
    """Import photographs into a closed session; all of them, or none.

    Every photograph becomes a state of the subject, named after its file; a single one is called
    "neutral". Two files whose names differ only by the words "parallel" and "crossed" are the two
    polarizer states of one photograph. Time, location, owner and serial numbers are dropped.

    Parameters
    ----------
    directory : str or Path
        A folder (its subfolders are not entered), or one file.
    out : str or Path
        The new SESSION/ folder.
    rig : Rig, optional
        The rig whose first camera took the photographs, so that its calibrations apply; they must
        be raw files of that camera's size. Default: a rig assembled from the files' metadata.
    camera_serial : str
        Serial number to record, for calibrations; without `rig` only.
    sensitivity : str, optional
        Name of the camera's spectral sensitivity, see ``model.spectra``; without `rig` only.
        Default "linear sRGB" for developed images, that of a common camera for raw files.
    illuminant : str, optional
        Name of the light; default "D65" for developed images, "D55" for raw files.
    kind : {"subject", "chart", "flat", "dark"}
        Content of the photographs.
    subject : Subject, optional
        Person in the photographs; default an unnamed one who agreed to nothing beyond the capture.
    framing : Framing, optional
        Part and width of the photographs to import; default: all of them.
    source : ImageSource, optional
        Origin of the photographs; its assumptions are stored before the import's own.
    progress : callable
        Called with a line of text before each photograph is read, and before each is stored.
    now : callable, optional
        Clock, returns a time with its zone.

    Returns
    -------
    Imported

    Raises
    ------
    PhotoError
        Listing every file that cannot be used; then nothing is written.
    SessionError
        When `out` is not free.
    """
    clock = now or (lambda: datetime.now(UTC))
    files, ignored = _files(Path(directory))
    framing, source = framing or Framing(), source or ImageSource(Path(directory))
    if rig is not None and framing != Framing():
        raise PhotoError(
            "cannot be imported so",
            where=str(directory),
            faults=[Fault("crop or width", "one together with a rig", "whole photographs")],
            advice="Leave the rig out, or crop and width.",
        )
    repair = "Cut these frames out" if source.video else "Repair these files or move them away"
    entries = _inspect(files, framing, progress, turn_raw=rig is None, repair=repair)
    light = illuminant or ("D65" if any(e.encoding != "raw" for e in entries) else "D55")
    used, views = _rig(entries, rig, camera_serial, sensitivity, light)
    steps, exposures = _relate_pairs(_steps(entries, views, kind))
    own = _assumptions(entries, made_up=rig is None, light=light, camera=used.views[0])
    assumed = [*source.assumed, *own, *_list_unequal_partners(steps), *exposures]
    plan = Plan(used.name, tuple(step for step, _ in steps))
    listed = [
        {"step": s.id, "sha256": e.sha256, "encoding": e.encoding}
        | ({"face": list(e.face)} if e.face else {})
        for s, e in steps
    ]
    extra = {"assumed": assumed, "photographs": listed} | source.to_manifest()
    target = Path(out)
    with create_imported_session(target, plan, used, subject, extra, clock) as session:
        for number, (step, entry) in enumerate(steps):
            progress(f"store photograph {number}/{len(steps)}")
            _commit(session, step, entry, clock)
    states = tuple(dict.fromkeys(str(step.index["state"]) for step, _ in steps))
    color = {str(step.index["state"]) for step, entry in steps if entry.view.cfa != "MONO"}
    colored = tuple(state for state in states if state in color)
    pairs = any(_is_polarized_pair(pair) for pair in _group_pairs(steps))
    return PhotoImport(str(target), len(steps), assumed, states, tuple(ignored), colored, pairs)


def _files(directory: Path) -> tuple[list[Path], list[str]]:
    """Return the photographs in a folder, sorted by name, and the omitted entries."""
    if directory.is_file():
        return [directory], []
    if not directory.is_dir():
        raise PhotoError(
            "folder not found",
            where=str(directory),
            advice="Name a folder or one file.",
            code="SR-IMP-011",
        )
    files, ignored = [], []
    for file in sorted(directory.iterdir()):
        if file.is_dir() or file.name.startswith(".") or file.suffix.lower() in SIDECAR_SUFFIXES:
            ignored.append(file.name)
        else:
            files.append(file)
    if not files:
        raise PhotoError(
            "contains no photographs",
            where=str(directory),
            faults=[Fault("files", f"{len(ignored)} other entries", "at least one photograph")],
            advice=_advise(ignored) or "Name a folder with photographs.",
            code="SR-IMP-012",
        )
    return files, ignored


def _advise(names: Sequence[str]) -> str:
    """Return how the first file of another format is converted; empty where there is none."""
    return next((text for name in names if (text := advise_conversion(name))), "")


def _inspect(
    files: Sequence[Path], framing: Framing, progress: Report, *, turn_raw: bool, repair: str
) -> list[_Entry]:
    """Decode every file once, so that a bad one is found before anything is written.

    Calibrations of a rig apply to the rows of its sensor: its raw files are not turned.
    """
    entries, faults = [], []
    placed: dict[tuple[str, tuple[int, ...]], tuple[Framing, tuple[float, ...]]] = {}
    for number, file in enumerate(files):
        progress(f"read photograph {number}/{len(files)}")
        try:
            photo = read_photo(file, turn_raw=turn_raw)
            if photo.white_value == 0.0:
                raise PhotoError("is black", where=str(file))
        except InputError as exc:
            found = "; ".join(f"{fault.path}: {fault.got}" for fault in exc.faults)
            reason = f"one that {exc.what}" + (f" ({found})" if found else "")
            faults.append(Fault(file.name, reason, "a photograph"))
            continue
        # the two polarizer states of one photograph keep one crop
        key = _parse_stem(file.stem)[0], photo.frame.cfa.shape
        if key not in placed:
            placed[key] = framing.locate(photo, where=str(file))
        own, face = placed[key]
        made = _entry(file, own.apply(photo, where=str(file)), own, face)
        entries.append(replace(made, turn_raw=turn_raw))
    if faults:
        raise PhotoError(
            f"{len(faults)} of {len(files)} files cannot be imported",
            where=str(files[0].parent),
            faults=faults,
            advice=" ".join(
                [f"{repair}; nothing was written.", _advise([fault.path for fault in faults])]
            ).strip(),
            code="SR-IMP-013",
        )
    white_value = find_common_white([entry.white_value for entry in entries])
    if white_value is None:
        return entries
    return [
        entry
        if entry.white_value is None
        else replace(entry, white_value=white_value, notes=restate_white(entry.notes, white_value))
        for entry in entries
    ]


def _entry(file: Path, photo: Photo, framing: Framing, face: tuple[float, ...]) -> _Entry:
    frame = photo.frame
    view = make_placeholder_view(frame, analyzer_axis_deg=0.0)
    return _Entry(
        file,
        hash_file(file),
        photo.encoding,
        view,
        photo.exposure_settings,
        photo.notes,
        photo.white_value,
        framing,
        face,
    )


def _rig(
    entries: Sequence[_Entry],
    rig: Rig | None,
    serial: str,
    sensitivity: str | None,
    illuminant: str,
) -> tuple[Rig, list[str]]:
    """Return the session's rig and the view of every photograph."""
    if rig is not None:
        view = rig.views[0]
        wanted = f"raw {view.width_px} x {view.height_px} {view.cfa}"
        for entry in entries:
            own = entry.view
            got = f"{entry.encoding} {own.width_px} x {own.height_px} {own.cfa}"
            if got != wanted:
                raise PhotoError(
                    "was not taken by this rig's camera",
                    where=str(entry.file),
                    faults=[Fault("picture", got, wanted)],
                    advice="Import it without a rig.",
                )
        return rig, [view.name] * len(entries)
    cameras = list(dict.fromkeys(entry.camera for entry in entries))
    names = {camera: "cam" if k == 0 else f"cam{k + 1}" for k, camera in enumerate(cameras)}
    first = {entry.camera: entry for entry in reversed(entries)}
    views = tuple(
        replace(
            first[camera].view,
            name=name,
            serial=serial,
            spectral_sensitivity=sensitivity
            or (RAW_CURVES if first[camera].encoding == "raw" else IMAGE_CURVES),
        )
        for camera, name in names.items()
    )
    place = (0.0, 0.0, DISTANCE_MM)
    light = make_placeholder_light("unknown", place, illuminant, polarizer_axis_deg=0.0)
    made = make_placeholder_rig(IMPORTED_RIG_NAME, [light], *views)
    return made, [names[entry.camera] for entry in entries]


def _parse_stem(stem: str) -> tuple[str, str | None]:
    """Split a file's stem into a state and the polarizer state in its words.

    Examples
    --------
    >>> _parse_stem("anna crossed-2"), _parse_stem("portrait"), _parse_stem("crossed")
    (('anna-2', 'crossed'), ('portrait', None), ('neutral', 'crossed'))
    """
    words = [word for word in re.split(r"[^A-Za-z0-9]+", stem) if word]
    polarizer = next(
        (_POLARIZER_WORDS[w.lower()] for w in words if w.lower() in _POLARIZER_WORDS), None
    )
    rest = [word for word in words if word.lower() not in _POLARIZER_WORDS]
    return "-".join(rest)[:60] or "neutral", polarizer


def _steps(
    entries: Sequence[_Entry], views: Sequence[str], kind: Kind
) -> list[tuple[Step, _Entry]]:
    named = [_parse_stem(entry.file.stem) for entry in entries]
    if len({state for state, _ in named}) == 1:
        named = [("neutral", polarizer) for _, polarizer in named]
    seen: set[tuple[str, str]] = set()
    steps = []
    for number, (entry, view, (state, polarizer)) in enumerate(
        zip(entries, views, named, strict=True)
    ):
        shown = polarizer or "crossed"
        # two files of one name (raw and JPEG of one shot) are two photographs, not repeats
        name, count = state, 2
        while (name, shown) in seen:
            name, count = f"{state}-{count}", count + 1
        seen.add((name, shown))
        index: dict[str, str | int | float] = {"state": name, "polarizer": shown, "repeat": 0}
        settings: dict[str, Value] = {}
        if polarizer is not None:
            settings["polarizer"] = polarizer
        settings |= entry.exposure
        steps.append((Step(f"P{number:03d}", kind, index, settings, (view,)), entry))
    return steps


def _relate_pairs(
    steps: Sequence[tuple[Step, _Entry]],
) -> tuple[list[tuple[Step, _Entry]], list[str]]:
    """Return the steps with the relative exposure of parallel photographs, and what is assumed."""
    related, texts = list(steps), []
    for pair in _group_pairs(steps):
        if not _is_polarized_pair(pair) or len(pair) != 2:
            continue
        parallel, crossed = sorted(pair, key=lambda one: _parse_stem(one.file.stem)[1] == "crossed")
        names = parallel.file.name, crossed.file.name
        ratio, text = relate_exposures(parallel.exposure, crossed.exposure, names)
        texts += [text] * bool(text)
        if ratio != 1.0:
            at = next(k for k, (_, entry) in enumerate(steps) if entry is parallel)
            step = steps[at][0]
            settings = {**step.settings, "relative_exposure": ratio}
            related[at] = replace(step, settings=settings), parallel
    return related, texts


def _assumptions(
    entries: Sequence[_Entry], *, made_up: bool, light: str, camera: View
) -> list[str]:
    """Return every assumption once, with the number of photographs concerned."""
    counts = Counter(note for entry in entries for note in entry.notes)
    total = len(entries)
    texts = [note if n == total else f"{note} ({n} of {total})" for note, n in counts.items()]
    plain = sum(_parse_stem(entry.file.stem)[1] is None for entry in entries)
    if plain:
        of = "" if plain == total else f" ({plain} of {total})"
        texts.append(
            "no polarizers are named, so that specular light counts as diffuse as if the"
            f" photograph were crossed{of}"
        )
    if made_up:
        texts.append(
            f"the camera's spectral sensitivity is that of {camera.spectral_sensitivity!r} and the"
            f" light is {light}"
        )
        texts.append("distance, focal length and pixel pitch are not known: no lengths in mm")
    return texts


def _group_pairs(steps: Sequence[tuple[Step, _Entry]]) -> list[list[_Entry]]:
    """Return the photographs of each state that has two polarizer states."""
    states: dict[object, list[_Entry]] = {}
    for step, entry in steps:
        states.setdefault(step.index["state"], []).append(entry)
    return [entries for entries in states.values() if len(entries) > 1]


def _is_polarized_pair(entries: Sequence[_Entry]) -> bool:
    """Return whether photographs of one state name both polarizers, in one size and color."""
    named = {_parse_stem(entry.file.stem)[1] for entry in entries}
    return named == {"parallel", "crossed"} and len({e.camera[1:3] for e in entries}) == 1


def _list_unequal_partners(steps: Sequence[tuple[Step, _Entry]]) -> list[str]:
    """Return the pairs of polarizer states whose photographs cannot be subtracted."""
    return [
        f"{' and '.join(entry.file.name for entry in pair)} {UNEQUAL_PAIR_NOTE}"
        for pair in _group_pairs(steps)
        if len({(entry.view.cfa, entry.view.width_px, entry.view.height_px) for entry in pair}) > 1
    ]


def _commit(session: Session, step: Step, entry: _Entry, clock: Callable[[], datetime]) -> None:
    (view,) = step.cameras
    photo = read_photo(entry.file, white_value=entry.white_value, turn_raw=entry.turn_raw)
    frame = replace(
        entry.framing.apply(photo, where=str(entry.file)).frame,
        camera_serial=session.rig.view(view).serial,
        step_id=step.id,
        session_id=session.id,
    )
    blob, now_s = raw.encode_frame(frame), clock().timestamp()
    session.commit(step.id, view, blob, settings=step.settings, actual={}, t_host_s=now_s)
