"""Run plans on simulated rigs and record their sessions and ground truth."""

import hashlib
import io
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from capture.acquire import Operator, run_plan
from capture.devices.camera import open_camera
from capture.documents import canonical_json, to_json_table
from capture.plan import Plan
from capture.rig import Rig
from capture.session import Session, SessionError, SubjectRecord
from capture.session.manifest import package_versions
from model import store
from model.skin import SkinAppearance
from skinrig.capturing.addresses import open_box
from skinrig.capturing.camera_colors import nominal_camera_colors
from skinrig.capturing.light_safety import light_figures, light_lines
from skinrig.console import format_count
from skinrig.resources.forecast import (
    ResourceForecast,
    count_megapixels,
    describe_disk,
    forecast_resources,
    forecast_smaller_widths,
    measure_folder_mb,
    require_resources,
)
from skinrig.simulating import subject_records
from skinrig.simulating.exposure_log import SceneLog
from skinrig.simulating.orders import (
    SIMULATED_USES,
    SimulationError,
    SimulationOrder,
    SimulationResult,
    truth_folder,
)
from skinrig.simulating.resumption import (
    ReplayedSession,
    ReplayedWorld,
    SessionComplete,
    exposures_folder,
    list_refusals,
)

Log = TypeVar("Log", bound=SceneLog)

RUN_ID = "sim1"
"""Prefix of the tokens of a simulated run; a resumed run is the same run."""


def list_effects(scene: Any) -> tuple[Mapping[str, Any], ...]:
    """List the effects that a scene builds and omits, for the manifest and `SimulationResult`."""
    return tuple(scene.needs.document())


def record_renderer(scene: Any) -> Mapping[str, str]:
    """Return the renderer of a scene's images and the reason, for the manifest."""
    variant = getattr(scene, "variant", None)
    if variant is None:
        return {"name": "none", "why": "closed forms and photon walks make the images"}
    name = getattr(scene, "renderer", variant.renderer)
    return {"name": name, "variant": variant.name, "why": variant.why}


def manifest_settings(order: SimulationOrder, **rig_settings: Any) -> dict[str, Any]:
    """Return the settings of a simulation for its session's manifest.

    Parameters
    ----------
    order
        Options common to all rigs.
    rig_settings
        Settings of this rig.
    """
    asked: dict[str, Any] = {
        "rig": order.rig,
        "subject": subject_records.manifest_record(order.subject),
        "target": order.target or "",
    }
    if order.plan is not None:
        asked["plan"] = order.plan.to_json()
    if order.renderer != "mitsuba":
        asked["renderer"] = order.renderer
    if order.leave_out:
        asked["leave_out"] = list(order.leave_out)
    return asked | rig_settings | session_settings(order)


def session_settings(order: SimulationOrder) -> dict[str, Any]:
    """Return the given settings that differ between sessions of one subject."""
    found: dict[str, Any] = {}
    if order.session_seed is not None:
        found["session_seed"] = order.session_seed
    if order.days_ago:
        found["days_ago"] = order.days_ago
    if order.iso_factor != 1.0:
        found["iso_factor"] = order.iso_factor
    return found


@contextmanager
def release_on_error(session: Session) -> Iterator[None]:
    """Release a session if the block raises."""
    try:
        yield
    except BaseException:
        session.release()
        raise


def open_logged_session(
    order: SimulationOrder,
    plan: Plan,
    rig: Rig,
    settings: Mapping[str, Any],
    scene: Any,
    kind: type[Log],
) -> tuple[Session, Log]:
    """Open the session of an order and the log that wraps its scene."""
    session = open_session(order, plan, rig, settings, scene)
    with release_on_error(session):
        truth = truth_folder(order.out)
        log_path = kind.path_of(truth)
        require_unfinished(order, session, scene, log_path)
        require_exposures_of_log(session, log_path)
        return session, kind(scene, truth, resume=order.resume, session=session)


def require_unfinished(
    order: SimulationOrder, session: Session, scene: Any, log_path: Path
) -> None:
    """Raise `SessionComplete` when the ground truth was written and its log removed.

    The ground truth cannot be written again without the log.
    """
    truth = truth_folder(order.out)
    if session.closed and truth.is_dir() and not log_path.exists():
        raise SessionComplete(build_result(order, session, scene, 0.0, truth))


def require_exposures_of_log(session: Session, log_path: Path) -> None:
    """Forget the stored images of a session if the log of their exposures is missing.

    Exposures are logged when they are computed; without these images they are computed again.
    """
    if isinstance(session, ReplayedSession) and not log_path.is_file():
        session.exposures.clear()


def open_session(
    order: SimulationOrder, plan: Plan, rig: Rig, settings: Mapping[str, Any], scene: Any
) -> Session:
    """Create the session of an order, or resume it if its settings are the same."""
    if order.resume:
        opened = Session.open(order.out)
        # a refused session stays as it is: a measured one has frames that no replay gives again
        if lines := list_refusals(opened, settings, order.seed, order.person):
            differing = "".join(f"\n  {line}" for line in lines)
            raise SimulationError(
                f"{order.out}: cannot be resumed with these settings{differing}\n"
                "  resume with the same settings, or name another folder [SR-SIM-001]"
            )
        if not opened.complete:
            return ReplayedSession.resume(order.out)
        shutil.rmtree(exposures_folder(order.out), ignore_errors=True)
        return opened
    order.out.parent.mkdir(parents=True, exist_ok=True)
    created = order.captured_at
    subject = order.person or SubjectRecord(
        subject_records.pseudonym(order.subject, order.seed), SIMULATED_USES
    )
    session = ReplayedSession.create(
        order.out,
        plan=plan,
        rig=rig,
        devices={
            **{name: f"rigsim {name} box" for name in rig.boxes},
            **{view.name: view.serial for view in rig.all_views},
        },
        subject=subject,
        source="simulated",
        seed=order.seed,
        extra={
            "simulation": dict(settings),
            "effects": [dict(one) for one in list_effects(scene)],
            "renderer": record_renderer(scene),
        },
        session_id=derive_session_id(created, order.seed, settings, subject),
        now=lambda: created,
    )
    if isinstance(session, ReplayedSession):
        session.exposures.clear()  # of a removed session of this name
    return session


def derive_session_id(
    created: datetime, seed: int, settings: Mapping[str, Any], subject: SubjectRecord
) -> str:
    """Return the id of a simulated session, by all that determines its frames and its date.

    Returns
    -------
    str
        32 hexadecimal digits.

    Examples
    --------
    >>> from datetime import UTC, datetime
    >>> subject = SubjectRecord("P1", ("research",))
    >>> len(derive_session_id(datetime(2026, 1, 1, tzinfo=UTC), 3, {"rig": "flash"}, subject))
    32
    """
    content = {
        "created_at": created.isoformat(),
        "seed": seed,
        "settings": dict(settings),
        "subject": to_json_table(subject),
        "versions": package_versions(),
    }
    return hashlib.sha256(canonical_json(content)).hexdigest()[:32]


def require_room(order: SimulationOrder, rig: Rig, plan: Plan, temporary_mb: float = 0.0) -> None:
    """Raise unless memory and disk suffice for what a simulation lacks; report the disk space.

    Voxels of skin are not forecast. A resumed session that has all frames needs no more.

    Parameters
    ----------
    order, rig, plan
        Order of the simulation, its rig, and its plan.
    temporary_mb
        Largest size of a temporary file, which is reported, but not required.
    """
    if order.renderer != "mitsuba":
        return
    if order.resume:
        with suppress(SessionError):  # a session that cannot be read is refused on resuming
            if Session.open(order.out).complete:
                return
    work = f"simulate {order.rig}"
    amounts = count_megapixels(rig, plan)
    smaller = {}
    if hasattr(order, "width_px") and not order.resume:
        smaller = forecast_smaller_widths(work, rig.views[0].width_px, amounts)
    need = forecast_rest(order, rig, plan, temporary_mb)
    require_resources(work, need, order.out, smaller=smaller)
    if temporary_mb and order.progress is not None:
        order.progress(describe_disk(need, order.out))


def forecast_rest(
    order: SimulationOrder, rig: Rig, plan: Plan, temporary_mb: float
) -> ResourceForecast:
    """Forecast memory and disk of a simulation without the files that a resumed one has."""
    need = forecast_resources(f"simulate {order.rig}", count_megapixels(rig, plan))
    held_mb = measure_folder_mb(order.out) if order.resume else 0.0
    return replace(need, disk_mb=need.disk_mb - held_mb, temporary_mb=temporary_mb)


def announce_light(plan: Plan, rig: Rig, order: SimulationOrder) -> Mapping[str, float | str]:
    """Compute flicker and light dose of a plan, and report them before the capture."""
    if order.progress is not None:
        for line in light_lines(plan, rig):
            order.progress(line)
    return light_figures(plan, rig)


def write_truth(
    folder: Path,
    order: SimulationOrder,
    session: Session,
    appearance: SkinAppearance,
    *,
    files: Mapping[str, bytes] | None = None,
    **own_parameters: Any,
) -> None:
    """Write the ground truth of a session, with its parameters and those of its simulation.

    Parameters
    ----------
    folder
        Folder of the ground truth.
    order, session
        Order and closed session of the simulation.
    appearance
        Ground truth of the scene.
    files
        Further files by name.
    own_parameters
        Further parameters; those of the appearance take precedence.
    """
    parameters = {
        "kind": "truth",
        "state": "neutral",
        **own_parameters,
        **appearance.parameters,
        **subject_records.truth_parameters(order.subject, order.rig, order.progress),
    }
    inputs = {"session": session.content_hash}
    truth = replace(appearance, parameters=parameters, inputs=inputs, seed=order.seed)
    store.write(folder, truth if files is None else replace(truth, files=files))


def encode_arrays(arrays: Mapping[str, Any]) -> bytes:
    """Return arrays as the bytes of a compressed .npz; equal arrays give equal bytes."""
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def build_result(
    order: SimulationOrder,
    session: Session,
    scene: Any,
    rig_seconds: float,
    truth: Path | None,
    **more: Any,
) -> SimulationResult:
    """Return the result of a simulation; `more` are fields that only some rigs have."""
    return SimulationResult(
        order.out,
        truth,
        len(session.frames()),
        rig_seconds,
        tuple(scene.omitted),
        effects=list_effects(scene),
        **more,
    )


def drive_plan(
    order: SimulationOrder,
    session: Session,
    rig: Rig,
    scene: Any,
    prompt: Callable[[Any, str], None] | None = None,
    *,
    signal: Callable[[Any, str], None] | None = None,
    **run: Any,
) -> float:
    """Run a session's plan through the drivers in a simulated world, and close it.

    Parameters
    ----------
    order
        Order of the simulation, with the world's seeds and the progress callback.
    session, rig
        Session, open for writing, and the nominal rig.
    scene
        First scene in front of the cameras.
    prompt
        Called with the world and the instruction to the operator; None: prompts are ignored.
    signal
        Called with the world and the expression that a sequence requests, at that time.
    run
        Further arguments of `capture.acquire.run_plan`: ``eyes``, ``force_limit_n``,
        ``all_brackets``.

    Returns
    -------
    float
        Time elapsed on the rig's clock, s.
    """
    if session.closed:  # resumed after its last frame
        if order.progress is not None:
            order.progress("complete: nothing is left to capture")
        return 0.0
    if not isinstance(session, ReplayedSession):
        raise TypeError(f"session: got {type(session).__name__}, expected ReplayedSession")
    if session.recorded_count and order.progress is not None:
        order.progress(f"replay {format_count(session.recorded_count, 'recorded line')}")
    world = ReplayedWorld(
        rig,
        seed=order.noise_seed,
        subject_seed=order.seed,
        clock="virtual",
        scene=scene,
        session=session,
    )
    begun_s = session.manifest.created_at.timestamp()
    name = world.register(uuid.uuid4().hex)
    boxes = {
        # a fixed first number: random ones vary in length, and so would the time of a transfer
        kind: open_box(kind, f"sim://{kind}?world={name}", clock=world.clock, first_seq=1)
        for kind in rig.boxes
    }
    cameras = {view.name: open_camera(f"sim://{name}/{view.name}") for view in rig.all_views}
    operator = Operator(
        progress=order.progress or (lambda line: None),
        prompt=lambda text: None if prompt is None else prompt(world, text),
        signal=lambda state: None if signal is None else signal(world, state),
        timer=world.clock,
        # the host's clock is the world's: a resumed run has the times of an undisturbed one
        clock=lambda: begun_s + world.now,
        run_id=RUN_ID,
    )
    try:
        run_plan(
            session.plan,
            rig,
            boxes=boxes,
            cameras=cameras,
            session=session,
            operator=operator,
            camera_colors=nominal_camera_colors(rig),
            **run,
        )
        session.close()
        if order.progress is not None:
            order.progress("compute the ground truth")
        return float(world.now)
    finally:
        for camera in cameras.values():
            camera.close()
        for box in boxes.values():
            box.close()
        world.unregister()
        session.release()
