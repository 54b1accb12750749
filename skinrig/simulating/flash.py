"""The flash rig simulated: a face or a target, its plan, its truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.plan import Plan, flash_calibration_plan, flash_plan
from capture.rig import Rig, load_rig
from model import store
from model.skin import UNITS, SkinAppearance, SkinMap
from skinrig.simulating import subject_records
from skinrig.simulating.simulation import (
    Order,
    Simulated,
    SimulationError,
    drive,
    effects_of,
    open_session,
    truth_folder,
)

WIDTHS_PX = {"small": 768, "full": 3024}
TARGETS = ("white", "chart", "flat", "dark", "malus")


def simulate_flash(order: Order) -> Simulated:
    """Simulate a capture with the flash rig; see `simulation.simulate_session`."""
    if order.sequence is not None:
        from skinrig.simulating.sequence import simulate_sequence

        return simulate_sequence(order, order.sequence)
    target, states, seed = order.target, order.states, order.seed
    if target is not None and target not in TARGETS:
        raise SimulationError(f"target: got {target!r}, expected one of {', '.join(TARGETS)}")
    order.refuse(
        "flash", lights=None, views=None, move=False, site=None, angles=None, steps=None,
        sites=None, all_brackets=False, wrapped=False,
    )  # fmt: skip
    if target is None:
        from rigsim.subject.perfusion import STATES

        unknown = [state for state in states if state not in STATES]
        if unknown:
            raise SimulationError(f"state: got {unknown[0]!r}, expected one of {', '.join(STATES)}")
    width = order.width_px or WIDTHS_PX[order.size]
    rig = load_rig("flash")
    rig = rig.resized(width) if width != rig.views[0].width_px else rig
    shown = subject_records.of_manifest(order.subject)
    asked = {
        "rig": "flash", "width_px": width, "subject": shown, "target": target or "",
        "mesh": str(order.mesh or ""), "states": list(states), "repeats": order.repeats,
        "movement": order.movement,
        **({} if order.plan is None else {"plan": order.plan.to_json()}),
        **({"leave_out": list(order.leave_out)} if order.leave_out else {}),
        **({"nearer_mm": order.nearer_mm} if order.nearer_mm else {}),
    }  # fmt: skip
    # what cannot be built must fail before a folder is made
    plan = order.plan or _plan(rig, target, states, order.repeats)
    scenes = _scenes(rig, order, plan)
    first = next(iter(scenes.values()))
    session = open_session(order, plan, rig, asked, first)

    def prompt(world: Any, state: str) -> None:
        world.scene = scenes[state]

    rig_seconds = drive(session, rig, first, seed, prompt, order.progress)
    truth = None
    if target is None:
        truth = truth_folder(order.out)
        told = subject_records.of_truth(order.subject, "flash", order.progress)
        for state, scene in scenes.items():
            folder = truth if state == states[0] else truth.with_name(f"{truth.name}-{state}")
            appearance = truth_of(scene, seed, session.content_hash, state, about=told)
            store.write(folder, appearance)
    blur = () if target else tuple(float(width) for width in first.resolution_mm())
    left_out = tuple(first.left_out)
    return Simulated(
        order.out, truth, len(session.frames()), rig_seconds, left_out, blur,
        effects=effects_of(first),
    )  # fmt: skip


def _plan(rig: Rig, target: str | None, states: tuple[str, ...], repeats: int) -> Plan:
    if target is None:
        return flash_plan(rig, states=states, repeats=repeats, interleave=True)
    if target == "white":
        return flash_plan(rig, states=("white",), repeats=max(4, repeats))
    return flash_calibration_plan(rig, target)  # type: ignore[arg-type]


def _scenes(rig: Rig, order: Order, plan: Plan) -> dict[str, Any]:
    from rigsim import targets
    from rigsim.population import files as subject_file
    from rigsim.scenes.flash.scene import FlashScene

    seed = order.seed
    powers = [float(step.settings.get("power", 0.0)) for step in plan.steps]
    power = max(powers, default=0.0) or 1.0
    if order.target is not None:
        state = "white" if order.target == "white" else ""
        return {state: FlashScene(rig, targets.make_target(order.target), seed=seed, power=power)}
    person = subject_file.named(order.subject).face(seed=seed, mesh=order.mesh)
    person = person.moved_by(_stance_mm(rig, order.nearer_mm))
    return {
        state: FlashScene(
            rig, person, state=state, movement=order.movement, seed=seed, power=power,
            **order.without("flash"),
        )
        for state in order.states
    }  # fmt: skip


NEAREST_SHARE = 0.5
"""Of the camera's distance: how far off the tile's place a face may stand, either way. Far beyond
what a lens of f/11 shows with any sharpness."""


def _stance_mm(rig: Rig, nearer_mm: float) -> tuple[float, float, float]:
    """Return how far a face is off the tile's place that stands so much nearer to the camera."""
    view = rig.views[0]
    most = NEAREST_SHARE * view.distance_mm
    if not abs(nearer_mm) < most:
        raise SimulationError(
            f"nearer: got {nearer_mm:g} mm, expected between {-most:g} and {most:g} mm: the camera "
            f"is {view.distance_mm:g} mm from the tile's place"
        )
    x, y, z = (nearer_mm * axis for axis in view.axes[2])
    return x, y, z


def _nearer_mm(scene: Any) -> float:
    """Return how much nearer to its first camera than the tile's place a scene's face stands."""
    return float(np.dot(scene.subject.offset_mm, scene.rig.views[0].axes[2]))


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


def landmarks_at_superpixels(pixels: Mapping[str, tuple[float, float]]) -> dict[str, list[float]]:
    """Return where points are after 2 x 2 pixels have been averaged.

    Parameters
    ----------
    pixels
        (x, y) on the sensor; the centre of pixel (0, 0) is (0, 0).

    Returns
    -------
    dict
        [x, y] on the averaged map, whose first pixel's centre lies amid four of the sensor's.

    Examples
    --------
    >>> landmarks_at_superpixels({"chin": (0.5, 2.5)})
    {'chin': [0.0, 1.0]}
    """
    return {name: [0.5 * (x - 0.5), 0.5 * (y - 0.5)] for name, (x, y) in pixels.items()}


def truth_of(
    scene: Any, seed: int, session: str, state: str, *, about: Mapping[str, Any] | None = None
) -> SkinAppearance:
    """Return the truth of a scene of a face, at superpixels; `about` joins its parameters."""
    maps: Mapping[str, NDArray[Any]] = scene.truth()
    mask = np.asarray(maps["mask"], bool)
    # a superpixel on the outline mixes skin and background: no truth is claimed for it
    # and where hair covers the skin there is none
    bare = mask & (np.asarray(maps["melanin"]) > 0)
    whole = to_superpixels(bare.astype(float)) == 1.0
    at_rest = np.asarray(maps.get("mask_at_rest", mask), bool)
    whole_at_rest = to_superpixels(at_rest.astype(float)) == 1.0
    kept = {}
    for name, values in maps.items():
        if name.startswith("mask") or (np.ndim(values) == 3 and np.shape(values)[2] != 3):
            continue
        unmoved = name.endswith("_at_rest")
        inside, valid = (at_rest, whole_at_rest) if unmoved else (mask, whole)
        small = to_superpixels(np.asarray(values, np.float64), inside).astype(np.float32)
        known = name.removesuffix("_at_rest").removesuffix("_blurred")
        unit = "mm" if name.endswith("_mm") else UNITS.get(known, "1")
        kept[_TRUTH_NAMES.get(name, name)] = SkinMap(small, unit, valid=valid)
    kept["mask"] = SkinMap(whole.astype(np.float32), "1")
    return SkinAppearance(
        kept,
        "simulated",
        parameters={
            "kind": "truth",
            "state": state,
            "movement": scene.movement,
            "nearer_mm": _nearer_mm(scene),
            "landmarks_px": landmarks_at_superpixels(scene.landmarks_px()),
            **(about or {}),
        },
        inputs={"session": session},
        left_out=tuple(scene.left_out),
        seed=seed,
    )
