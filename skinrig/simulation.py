"""Simulated captures: a world of boxes and a scene, driven through the real drivers by URL."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.plan import Plan, flash_calibration_plan, flash_plan
from capture.rig import Rig, load_rig
from capture.session import Session, Subject
from model import store
from model.skin import UNITS, SkinAppearance, SkinMap

WIDTHS_PX = {"small": 768, "full": 3024}
TARGETS = ("white", "chart", "flat", "dark", "malus")
RIGS = ("flash",)
USES = ("research", "publication")
"""What may be done with a face that is nobody's, unless said otherwise."""


class SimulationError(ValueError):
    """A simulation that cannot be set up as asked."""


@dataclass(frozen=True, slots=True)
class Simulated:
    """What a simulated capture left behind."""

    session: Path
    truth: Path | None
    frames: int
    rig_seconds: float
    """Time that passed on the rig's own clock."""
    left_out: tuple[tuple[str, str], ...]
    """What the scene did not build, and why."""
    blur_mm: tuple[float, ...] = ()
    """Width from 10 to 90 % of an edge that light spreading in the skin blurs, R, G, B, mm."""

    def document(self) -> Mapping[str, Any]:
        """Return this as JSON values."""
        return {
            "session": self.session,
            "truth": self.truth,
            "frames": self.frames,
            "rig_seconds": self.rig_seconds,
            "left_out": self.left_out,
            "blur_mm": self.blur_mm,
        }


def truth_folder(session: Path) -> Path:
    """Return the folder beside a session that holds its truth.

    Examples
    --------
    >>> truth_folder(Path("demo/session-flash")).as_posix()
    'demo/truth-flash'
    """
    name = session.name
    short = name.removeprefix("session-") if name.startswith("session-") else name
    return session.with_name(f"truth-{short}")


def simulate_session(
    rig_name: str,
    out: str | Path,
    *,
    size: str = "small",
    seed: int = 0,
    subject: str = "III",
    mesh: str | Path | None = None,
    target: str | None = None,
    states: tuple[str, ...] = ("neutral",),
    repeats: int = 1,
    resume: bool = False,
    width_px: int | None = None,
    created: datetime | None = None,
    person: Subject | None = None,
    progress: Callable[[str], None] | None = None,
) -> Simulated:
    """Simulate a capture into SESSION/, and write its truth beside it.

    Parameters
    ----------
    rig_name
        "flash".
    out
        The session's folder. The truth goes to ``truth-NAME`` beside ``session-NAME``.
    size
        "small" (768 pixels across) or "full" (the camera's own 3024).
    seed
        Of the subject, the sensor and the boxes.
    subject
        Preset of the face, by skin type.
    mesh
        A face mesh to wear the skin instead of the procedural head.
    target
        One of :data:`TARGETS` instead of a face.
    states
        Expressions and physiological states, captured one after the other.
    repeats
        Image pairs a state.
    resume
        Go on with a session that was interrupted; what is on disk is kept.
    width_px
        Pixels across, instead of ``size``.
    created
        Date of the session; None: now.
    person
        Pseudonym and consent to record; None: one who agreed to :data:`USES`.
    progress
        Called with one line a frame.

    Raises
    ------
    SimulationError
        For an unknown rig, size or target.
    """
    if rig_name not in RIGS:
        raise SimulationError(f"rig: got {rig_name!r}, expected one of {', '.join(RIGS)}")
    if size not in WIDTHS_PX:
        raise SimulationError(f"size: got {size!r}, expected one of {', '.join(WIDTHS_PX)}")
    if target is not None and target not in TARGETS:
        raise SimulationError(f"target: got {target!r}, expected one of {', '.join(TARGETS)}")
    if seed < 0:
        raise SimulationError(f"seed: got {seed}, expected 0 or more")
    if target is None:
        from rigsim.perfusion import STATES

        unknown = [state for state in states if state not in STATES]
        if unknown:
            raise SimulationError(f"state: got {unknown[0]!r}, expected one of {', '.join(STATES)}")
    path = Path(out)
    width = width_px or WIDTHS_PX[size]
    rig = load_rig(rig_name)
    rig = rig.resized(width) if width != rig.views[0].width_px else rig
    asked = {
        "rig": rig_name, "width_px": width, "subject": subject, "target": target or "",
        "mesh": str(mesh or ""), "states": list(states), "repeats": repeats,
    }  # fmt: skip
    # what cannot be built must fail before a folder is made
    scenes = _scenes(rig, target, subject, mesh, states, seed)
    if resume:
        session = Session.resume(path)
        if session.manifest.extra.get("simulation") != asked or session.seed != seed:
            session.release()
            raise SimulationError(
                f"{path}: was simulated with {session.manifest.extra.get('simulation')} and seed "
                f"{session.seed}; resume with the same settings"
            )
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        session = Session.create(
            path,
            plan=_plan(rig, target, states, repeats),
            rig=rig,
            devices={"flash": "rigsim flash box", "cam": rig.views[0].serial},
            subject=person or Subject(f"simulated-{subject}-{seed}", USES),
            source="simulated",
            seed=seed,
            extra={"simulation": asked},
            now=None if created is None else (lambda: created),
        )
    rig_seconds = _drive(session, rig, scenes, seed, progress)
    truth = None
    if target is None:
        truth = truth_folder(path)
        for state, scene in scenes.items():
            folder = truth if state == states[0] else truth.with_name(f"{truth.name}-{state}")
            store.write(folder, _truth(scene.truth(), seed, session.content_hash, state))
    first = next(iter(scenes.values()))
    blur = () if target else tuple(float(width) for width in first.resolution_mm())
    left_out = tuple(first.left_out)
    return Simulated(path, truth, len(session.frames()), rig_seconds, left_out, blur)


def _plan(rig: Rig, target: str | None, states: tuple[str, ...], repeats: int) -> Plan:
    if target is None:
        return flash_plan(rig, states=states, repeats=repeats)
    if target == "white":
        return flash_plan(rig, states=("white",), repeats=max(4, repeats))
    return flash_calibration_plan(rig, target)  # type: ignore[arg-type]


def _scenes(
    rig: Rig,
    target: str | None,
    subject: str,
    mesh: str | Path | None,
    states: tuple[str, ...],
    seed: int,
) -> dict[str, Any]:
    from rigsim import targets
    from rigsim.scenes.flash import FlashScene
    from rigsim.subject import make_subject

    if target is not None:
        state = "white" if target == "white" else ""
        return {state: FlashScene(rig, targets.make_target(target), seed=seed)}
    person = make_subject(subject, seed=seed, mesh=mesh)
    return {state: FlashScene(rig, person, state=state, seed=seed) for state in states}


def _drive(
    session: Any,
    rig: Rig,
    scenes: Mapping[str, Any],
    seed: int,
    progress: Callable[[str], None] | None,
) -> float:
    """Run the session's plan through the drivers, on a world registered under its id."""
    from capture.acquire import run_plan
    from capture.devices.camera import open_camera
    from capture.devices.flash import FlashBox
    from capture.devices.port import Port
    from rigsim.world import World

    world = World(rig, seed=seed, clock="virtual", scene=next(iter(scenes.values())))
    name = world.register(session.id)
    box = FlashBox(Port(f"sim://flash?world={name}"))
    cameras = {view.name: open_camera(f"sim://{name}/{view.name}") for view in rig.views}

    def prompt(state: str) -> None:
        world.scene = scenes[state]

    try:
        run_plan(
            session.plan, rig, boxes={"flash": box}, cameras=cameras, session=session,
            progress=progress, prompt=prompt,
        )  # fmt: skip
        session.close()
        return float(world.now)
    finally:
        for camera in cameras.values():
            camera.close()
        box.close()
        world.unregister()
        session.release()


def to_superpixels(values: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> NDArray[Any]:
    """Average 2 x 2 pixels, over those inside ``mask`` only.

    Parameters
    ----------
    values
        (H, W) or (H, W, C) with even H and W.
    mask
        (H, W); a block without any pixel inside is 0.

    Examples
    --------
    >>> to_superpixels(np.arange(4.0).reshape(2, 2)).tolist()
    [[1.5]]
    """
    height, width = values.shape[0] // 2, values.shape[1] // 2

    def blocks(image: NDArray[Any]) -> NDArray[Any]:
        shape = (height, 2, width, 2, *image.shape[2:])
        return np.asarray(image[: 2 * height, : 2 * width].reshape(shape))

    if mask is None:
        return np.asarray(blocks(values).mean(axis=(1, 3)))
    weight = mask.astype(np.float64)
    if values.ndim == 3:
        weight = weight[..., None]
    total = blocks(np.where(weight > 0, values, 0.0)).sum(axis=(1, 3))
    count = blocks(weight).sum(axis=(1, 3))
    return np.asarray(total / np.maximum(count, 1.0))


_TRUTH_NAMES = {"diffuse": "diffuse_radiance", "specular": "specular_radiance", "shading": "light"}
"""The simulator's light is in its own unit; an estimate's is relative to a white tile."""


def _truth(maps: Mapping[str, NDArray[Any]], seed: int, session: str, state: str) -> SkinAppearance:
    mask = np.asarray(maps["mask"], bool)
    # a superpixel on the outline mixes skin and background: no truth is claimed for it
    # and where hair covers the skin there is none
    bare = mask & (np.asarray(maps["melanin"]) > 0)
    whole = to_superpixels(bare.astype(float)) == 1.0
    kept = {}
    for name, values in maps.items():
        if name == "mask" or (np.ndim(values) == 3 and np.shape(values)[2] != 3):
            continue
        small = to_superpixels(np.asarray(values, np.float64), mask).astype(np.float32)
        unit = "mm" if name.endswith("_mm") else UNITS.get(name.removesuffix("_blurred"), "1")
        kept[_TRUTH_NAMES.get(name, name)] = SkinMap(small, unit, valid=whole)
    kept["mask"] = SkinMap(whole.astype(np.float32), "1")
    return SkinAppearance(
        kept,
        "simulated",
        parameters={"kind": "truth", "state": state},
        inputs={"session": session},
        seed=seed,
    )
