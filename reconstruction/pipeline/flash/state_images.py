"""Reconstruct every expression and repeat of one subject's flash sessions alike."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from capture.session import Session
from model.checks import Checks
from model.skin import SkinMap
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.flash import stages as flash_stages
from reconstruction.pipeline.inputs import Inputs, InputsError

NEUTRAL_STATE = "neutral"
SINGLE_MAPS = ("diffuse",)
CHROMOPHORE_NAMES = ("melanin", "hemoglobin")
REPEATED_MAPS = (
    *SINGLE_MAPS,
    *CHROMOPHORE_NAMES,
    *(name + flash_stages.NOISE_STDERR_SUFFIX for name in CHROMOPHORE_NAMES),
)
"""Where states are repeated, each image's own chromophores measure their repeatability."""

Landmarks = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class StateImage:
    """One parallel and crossed pair of one state.

    Attributes
    ----------
    state
        Name of the state.
    repeat
        Number of the pair within its session and state.
        Number of the pair within its session and state.
        Index of the session among those given.
    captured_s
        When the crossed image was taken, seconds since the first session began.
    maps
        Diffuse reflectance; where any state is repeated also the chromophores estimated from this
        image alone, and their errors by noise.
    """

    state: str
    repeat: int
    session: int
    captured_s: float
    maps: Mapping[str, SkinMap]

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"{self.state}, repeat {self.repeat} of session {self.session}"


@dataclass(frozen=True, slots=True, eq=False)
class SubjectImages:
    """Images of one subject in all captured states.

    Attributes
    ----------
    images
        In the order of capture.
    inputs
        SHA-256 of everything that was read.
    assumed
        Assumptions that replace missing calibrations.
    source, seed
        Of the sessions.
    camera, illuminant
        Names of the spectra of the color table.
    has_white
        Whether a white reference fixes the exposure.
    consent
        Consent of the subject of each measured session, as in its session.json.
    timed
        Whether times are those of capture; for photographs only the time of import is known.
    """

    images: tuple[StateImage, ...]
    inputs: Mapping[str, str]
    assumed: tuple[str, ...]
    source: str
    seed: int | None
    camera: str
    illuminant: str
    has_white: bool
    timed: bool
    consent: tuple[Mapping[str, Any], ...] = ()

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, neutral first."""
        names = list(dict.fromkeys(image.state for image in self.images))
        return (NEUTRAL_STATE, *(name for name in names if name != NEUTRAL_STATE))

    def images_of_state(self, state: str) -> list[StateImage]:
        """Return a state's images."""
        return [image for image in self.images if image.state == state]


def reconstruct_states(
    sessions: Sequence[Path],
    *,
    calibration: Path | None,
    progress: Callable[[str], None] | None = None,
) -> SubjectImages:
    """Reconstruct every state and repeat of flash sessions.

    Parameters
    ----------
    sessions
        SESSION/ folders of one subject and one camera, with a neutral state among them.
    calibration
        CALIBRATION/ folder; None: everything is assumed.
    progress
        Called with one line before each image.

    Raises
    ------
    InputsError
        When a session shows no subject, no state is neutral, or sizes or cameras differ.
    """
    check = Checks(InputsError)
    check.require(sessions, "sessions", "none", "at least one of the flash rig; give one")
    opened = [Session.open(path) for path in sessions]
    start = min(session.manifest.created_at for session in opened)
    images: list[StateImage] = []
    read_hashes: dict[str, str] = {}
    assumed: dict[str, None] = {}
    table: set[tuple[str, str]] = set()
    has_white = True
    pairs = [_pairs(session, path) for path, session in zip(sessions, opened, strict=True)]
    named = [state for group in pairs for state, _, _ in group]
    # checked before minutes of computation
    shown, expected = (
        ", ".join(sorted(set(named))),
        f"{NEUTRAL_STATE!r}, to which the others are aligned; add its session",
    )
    check.require(NEUTRAL_STATE in named, "states of sessions", shown, expected)
    maps = REPEATED_MAPS if len(set(named)) < len(named) else SINGLE_MAPS
    for number, (path, session) in enumerate(zip(sessions, opened, strict=True)):
        began_s = (session.manifest.created_at - start).total_seconds()
        for state, repeat, since_s in pairs[number]:
            if progress is not None:
                progress(f"{path.name}: {state}, repeat {repeat}")
            inputs = Inputs.of(session, calibration, state=state)
            inputs.repeat = repeat
            found = stages.run_stages(flash_stages.graph(inputs), list(maps)).products
            kept = MappingProxyType(dict(found))
            images.append(StateImage(state, repeat, number, began_s + since_s, kept))
            hashes = dict(inputs.hashes)
            read_hashes[f"session {number}"] = hashes.pop("session")
            read_hashes |= hashes
            assumed |= dict.fromkeys(inputs.assumed)
            spectra = inputs.noted["color_table"]
            table.add((str(spectra["camera"]), str(spectra["illuminant"])))
            has_white = has_white and "calibration white" in inputs.hashes
    one_rig = "one of each; choose sessions of one rig"
    check.require(len(table) == 1, "sessions", f"{len(table)} cameras or lights", one_rig)
    shapes = {image.maps["diffuse"].values.shape for image in images}
    one_size = "one size; choose sessions of one camera setting"
    check.require(len(shapes) == 1, "sessions", f"images of sizes {sorted(shapes)}", one_size)
    ((camera, illuminant),) = table
    simulated = any(session.source == "simulated" for session in opened)
    return SubjectImages(
        images=tuple(sorted(images, key=lambda image: image.captured_s)),
        inputs=read_hashes,
        assumed=tuple(assumed),
        source="simulated" if simulated else "measured",
        seed=opened[0].seed,
        camera=camera,
        illuminant=illuminant,
        has_white=has_white,
        timed=not any("photographs" in session.manifest.extra for session in opened),
        consent=tuple(s.manifest.to_json()["subject"] for s in opened if s.source == "measured"),
    )


def _pairs(session: Session, path: Path) -> list[tuple[str, int, float]]:
    """Return state, repeat and seconds since the first frame of each crossed image."""
    crossed = session.frames("subject", polarizer="crossed")
    got = "no crossed frame of a subject"
    Checks(InputsError).require(crossed, f"{path}", got, "a session of the flash rig; give one")
    first = min(record.line.t_host_s for record in session.frames())
    return [
        (str(at["state"]), int(at.get("repeat", 0)), float(line.t_host_s - first))
        for at, line in ((record.index, record.line) for record in crossed)
    ]
