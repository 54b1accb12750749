"""Serve a simulated rig with a subject on local ports until interrupted."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture.plan.probe import PHANTOM_SITE, PROBE_SITES
from capture.rig import SCANNER_BOX, Probe, Rig, load_rig
from capture.session import Session
from rigsim.as_built.dome import build_dome
from rigsim.mitsuba.variant import Renderer, choose_renderer
from rigsim.population import files as subject_file
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.dome.stripes import scan_face
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.reference.flash_session import crop_to_patch
from rigsim.subject.head_motion import draw_head_position
from rigsim.world.serve import serve_world
from rigsim.world.suction import HeadState
from skinrig.arrays import UInt16Array
from skinrig.console import Console, select_attributes
from skinrig.errors import EXIT_INTERRUPTED, UsageError
from skinrig.next_steps import shell_quote
from skinrig.simulating import dome as simulating_dome
from skinrig.simulating import flash, gradient, reference
from skinrig.simulating import probe as simulating_probe
from skinrig.simulating.orders import (
    MIN_WIDTH_PX,
    SimulationError,
    SimulationOptionsError,
    require_size,
)
from skinrig.simulating.resumption import count_shots
from skinrig.simulating.subject_records import find_unused_subject_keys

if TYPE_CHECKING:
    from rigsim.scenes.probe.scene import ProbeScene
    from rigsim.subject import SimulatedSubject

GRADIENT_WIDTH_PX = 96
"""Width of the gradient rig's image when served, px."""
PROBE_PHOTONS = 20_000
"""Photons per site of the served probe: a few seconds per site, and noise of a few percent, more in
the farthest fibers. The ground truth of `skinrig simulate probe` uses ten times as many or more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOrder:
    """Options of a served rig."""

    pty: bool = False
    """Serve controllers on pseudo terminals; cameras always use TCP."""
    tcp: str = "127.0.0.1:0"
    """HOST:PORT; port 0 chooses a free one."""
    subject: str = "III"
    size: str = "small"
    seed: int = 0
    session_seed: int | None = None
    """Seed of one session of the same subject and rig; None: `seed`."""
    renderer: Renderer = "mitsuba"
    """Renderer of a face's images."""
    site: str | None = None
    """Site of the skin (gradient rig only)."""
    scanner: bool = False
    """Serve the dome's scanner, too."""
    resume: Path | None = None
    """Session with frames of an earlier server of the same seed. The number of the shot seeds the
    noise, and counting continues after those frames. None: from 0."""

    def __post_init__(self) -> None:
        require_size(self.size)
        if not re.fullmatch(r".+:\d+", self.tcp):
            raise UsageError(f"--tcp: got {self.tcp!r}, expected HOST:PORT, such as 127.0.0.1:0")

    @property
    def noise_seed(self) -> int:
        """Seed of everything that differs between two sessions of one subject."""
        return self.seed if self.session_seed is None else self.session_seed

    def face(self) -> SimulatedSubject:
        """Return the subject's face where it is in the session."""
        face = subject_file.load_subject(self.subject).face(seed=self.seed)
        return face.translate(draw_head_position(self.session_seed))


def serve_rig(rig_name: str, order: ServeOrder, console: Console) -> None:
    """Print the addresses of controllers and cameras, one ``NAME URL`` per line, and serve.

    A dome is served with all its lights and cameras at both sizes, so that it matches the rig file
    of the host. The gradient sphere is served small only, because images are rendered while the
    caliper waits for the host. The fiber probe is on skin, or on the phantom if the host places it
    there; its images have one size.

    Parameters
    ----------
    rig_name
        "flash", or a rig's TOML file.
    order
        Options of the served rig.
    console
        With ``as_json`` the addresses and the next step are one JSON document.
    """
    rig = load_rig(rig_name)
    made = _shots_made(order.resume, rig)
    if order.site is not None and rig.caliper is None:
        raise SimulationOptionsError("site: an option of the gradient rig only; remove it")
    rig, scene = _build_served_rig(rig.with_scanner() if order.scanner else rig, order)
    options = select_attributes(order, "pty", "tcp")
    options |= {"seed": order.noise_seed, "subject_seed": order.seed}
    with serve_world(rig, scene=scene, shots_made=made, **options) as served:
        command = _next_step(rig_name, rig, served.addresses, order)
        if console.as_json:
            addresses = {"addresses": dict(served.addresses), "next": command}
            console.print_document("skinrig.serve/1", addresses)
        else:
            for name, url in served.addresses.items():
                print(f"{name} {url}", flush=True)
        print(f"next: {command}\nCtrl-C stops serving", file=sys.stderr)
        try:
            served.wait()
        except KeyboardInterrupt:
            print("stopped serving; the lights are off", file=sys.stderr)
            if console.as_json:  # the one document of the command is already printed
                raise SystemExit(EXIT_INTERRUPTED) from None
            raise


def _build_served_rig(rig: Rig, order: ServeOrder) -> tuple[Rig, Any]:
    """Return the served rig and its scene."""
    subject, seed = order.subject, order.seed
    # a rig file may have any name, so the kind of the rig follows from its parts
    kind = "gradient" if "gradient_sphere" in rig.boxes else "probe" if rig.probe else "other"
    find_unused_subject_keys(subject, kind, _report)
    if kind == "gradient":
        if order.size != "small":
            raise SimulationError(
                f"size: got {order.size!r}, expected small: larger pictures take longer to make "
                "than the caliper waits for its host; use skinrig simulate gradient [SR-SIM-007]"
            )
        rig = rig.cropped(GRADIENT_WIDTH_PX)
        scene = gradient.make_scene(
            rig,
            subject=subject,
            seed=seed,
            progress=_report,
            **select_attributes(order, "site", "noise_seed", "renderer"),
        )
        # rendered before the first request, so that no client waits for it
        scene.moments(NEUTRAL_GRIP)
        return rig, scene
    if rig.probe is not None:
        return rig, _probe_scene(rig, rig.probe, order)
    dome = "dome" in rig.boxes
    if order.renderer == "reference" and not dome:
        return _reference_flash(rig, order)
    width = (simulating_dome if dome else flash).WIDTHS_PX[order.size]
    rig = rig.resized(width) if width != rig.views[0].width_px else rig
    return rig, (_dome_scene if dome else _flash_scene)(rig, order)


def _next_step(rig_name: str, rig: Rig, urls: Mapping[str, str], order: ServeOrder) -> str:
    """Return the command that captures from a served rig."""
    boxes = " ".join("--port " + shell_quote(f"{name}={urls[name]}") for name in rig.boxes)
    cameras = " ".join("--camera " + shell_quote(f"{v.name}={urls[v.name]}") for v in rig.all_views)
    more = "" if rig.caliper is None else " --force-limit 2 --eyes closed"
    if rig.caliper is not None and order.renderer == "reference":
        more += " --steps 0..0"  # voxels are at rest
    if SCANNER_BOX in rig.boxes:
        more += " --scanner --eyes closed"
    resume = order.resume
    out = "session" if resume is None else f"{shell_quote(resume)} --resume"
    return f"skinrig capture {shell_quote(rig_name)} {boxes} {cameras}{more} --out {out}"


def _shots_made(session: Path | None, rig: Rig) -> Mapping[str, int]:
    """Count the shots that a session's cameras have made; empty without a session."""
    if session is None:
        return {}
    opened = Session.open(session)
    if opened.rig.name != rig.name:
        raise SimulationError(
            f"resume: got a session of rig {opened.rig.name!r}, expected one of {rig.name!r}; "
            "name one"
        )
    return count_shots(opened)


def _flash_scene(rig: Rig, order: ServeOrder) -> Any:
    choice = choose_renderer(order.renderer)
    scene = FlashScene(rig, order.face(), seed=order.noise_seed, choice=choice)
    # rendered before the first request, so that no client waits for it
    scene.radiance("crossed")
    return scene


def _report(text: str) -> None:
    print(text, file=sys.stderr)


def _reference_flash(rig: Rig, order: ServeOrder) -> tuple[Rig, Any]:
    """Return the cropped rig and its patch of voxel skin, rendered before the first request."""
    rig = crop_to_patch(rig, MIN_WIDTH_PX)
    given = select_attributes(order, "subject", "seed", "noise_seed", "size")
    return rig, reference.make_patch_scene(rig, site=None, progress=_report, **given)


def _dome_scene(rig: Rig, order: ServeOrder) -> Any:
    built = build_dome(rig, seed=order.seed)
    if order.renderer == "reference":
        if SCANNER_BOX in rig.boxes:
            raise SimulationError(
                "renderer: got 'reference' with a scanner, expected mitsuba or fast; voxel skin "
                "has no stripes"
            )
        given = select_attributes(order, "noise_seed", "size")
        return reference.make_dome_scene(rig, order.face(), dome=built, progress=_report, **given)
    choice = choose_renderer(order.renderer)
    scene = DomeScene(rig, order.face(), dome=built, seed=order.noise_seed, choice=choice)
    if SCANNER_BOX in rig.boxes:
        scan_face(scene, seed=order.seed, noise_seed=order.noise_seed)
    if scene.stripes is not None:
        # traced before the first request, so that no client waits for it
        scene.stripes.trace()
    return scene


def _probe_scene(rig: Rig, probe: Probe, order: ServeOrder) -> Any:
    given = select_attributes(order, "subject", "seed", "noise_seed")
    block = simulating_probe.make_scene(rig, "phantom", photons=PROBE_PHOTONS, **given)
    skin: ProbeScene
    if order.renderer == "reference":
        places = [(site, 0.0) for site in PROBE_SITES]
        given |= {"size": order.size, "places": places, "progress": _report}
        voxels = reference.make_probe_scene(rig, **given)
        # voxels of another place take longer than the controller waits for its host
        voxels.profiles.trace_only(places)
        skin = voxels
    else:
        skin = simulating_probe.make_scene(rig, None, photons=PROBE_PHOTONS, **given)
    # photons of the default sites are traced before the first request: during one, the head is
    # under suction, and the controller waits for its host for a few seconds only
    for site in (*PROBE_SITES, PHANTOM_SITE):
        scene = block if site == PHANTOM_SITE else skin
        scene.fiber_radiance(HeadState(site, 0.0, True, probe.suction_mbar, probe.camera_c))
    return _SkinAndBlock(skin, block, PHANTOM_SITE)


class _SkinAndBlock:
    """Scene of a subject's skin, and of the phantom when the head is placed on it."""

    def __init__(self, skin: ProbeScene, block: ProbeScene, block_site: str) -> None:
        self._skin, self._block, self._block_site = skin, block, block_site

    def exposure(self, view_name: str, *, head: HeadState, **exposed: Any) -> UInt16Array:
        scene = self._block if head.site == self._block_site else self._skin
        return scene.exposure(view_name, head=head, **exposed)
