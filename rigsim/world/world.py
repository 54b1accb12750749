"""Simulate one world: its clock, controllers, cameras and light.

`World.advance` is the only way in which time passes, for ports, cameras and servers alike, so that
all observers see the same lamps. A world has a virtual clock, which jumps to the next event, or the
real one. Controllers live as long as their world, not as long as the port to them.
"""

from __future__ import annotations

import hashlib
import math
import threading
import time
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, Protocol

import numpy as np

from capture.devices.camera import Exposure
from capture.rig import SCANNER_BOX, Rig, View, load_rig
from rigsim.arrays import UInt16Array
from rigsim.boxes.controller import Controller
from rigsim.boxes.device import Wiring
from rigsim.boxes.faults import NO_FAULTS, Faults
from rigsim.boxes.flash import FlashPop
from rigsim.world.camera_body import CameraBody
from rigsim.world.light_record import Light, LightRecord
from rigsim.world.link import Link
from rigsim.world.rig_boxes import make_box
from rigsim.world.suction import CameraCooler, HeadState, ProbeHead
from rigsim.world.taped_skin import GripState, TapedSkin

TRANSCRIPT_LINES = 4096


class Scene(Protocol):
    """Interface of the scene in front of the rig."""

    @property
    def exposure(self) -> Callable[..., UInt16Array]:
        """Return the DN, shape (H, W), of an exposure.

        It takes the camera's name and ``pops``, the light during the exposure; ``exposure_s``;
        ``seed`` of the sensor's noise; for a caliper ``grip``, a
        `rigsim.world.taped_skin.GripState`; and for a contact probe ``head``, a
        `rigsim.world.suction.HeadState`.
        """


class WorldClock:
    """A world's time as a clock for ports and drivers."""

    def __init__(self, world: World) -> None:
        self._world = world

    def monotonic(self) -> float:
        """Return the world's time, in s."""
        return self._world.now

    def sleep(self, seconds: float) -> None:
        """Advance the world's time by `seconds`."""
        self._world.wait(self._world.now + seconds)


class World:
    """A rig with simulated physics.

    Parameters
    ----------
    rig
        The rig; by default the shipped flash rig.
    seed
        Seeds controllers, faults and sensors: same seed, same bytes.
    subject_seed
        Seeds the mechanics of the subject's skin; None: `seed`.
    clock
        ``"virtual"``: time passes when a client waits; ``"real"``: it passes continuously.
    scene
        Scene of the cameras; without one, frames contain black level and read noise.
    faults
        Faults; by default none.
    shots_made
        Number of earlier shots by view, made in another world of the same seed: their noise must
        not repeat.

    Attributes
    ----------
    scene : Scene or None
        May be exchanged between exposures.
    pops : list of FlashPop
        All pops so far.
    switched : list of LedPulse, PatternLight or SourceLight
        All other light that has ended, ordered by end time.
    grips : list of (float, GripState)
        State of the caliper's grip from each world time in s on; empty where the rig has none.
    skin : TapedSkin or None
        Load on the caliper's jaws; None where the rig has none.
    head : ProbeHead or None
        The contact probe's head and the surface below it; None where the rig has none.
    """

    def __init__(
        self,
        rig: Rig | None = None,
        *,
        seed: int = 0,
        subject_seed: int | None = None,
        clock: Literal["virtual", "real"] = "virtual",
        scene: Scene | None = None,
        faults: Faults | None = None,
        shots_made: Mapping[str, int] | None = None,
    ) -> None:
        if clock not in ("virtual", "real"):
            raise ValueError(f"clock: got {clock!r}, expected 'virtual' or 'real'")
        self.rig = load_rig("flash") if rig is None else rig
        self.seed = seed
        self.virtual = clock == "virtual"
        self.scene = scene
        self.faults = NO_FAULTS if faults is None else faults
        self._light = light = LightRecord()
        self.pops, self.switched = light.pops, light.switched
        self.grips: list[tuple[float, GripState]] = []
        person = seed if subject_seed is None else subject_seed
        self.skin: TapedSkin | None = None
        if self.rig.caliper is not None:
            stiffness = self.faults.skin_stiff
            self.skin = TapedSkin(
                self.rig.caliper, seed=person, tape_seed=seed, stiffness=stiffness
            )
            self._note_grip(0.0)
        self.head: ProbeHead | None = None
        if self.rig.probe is not None:
            kept_c, fails_after_s = self.rig.probe.camera_c, self.faults.camera_warms_after
            self.head = ProbeHead(
                CameraCooler(kept_c, fails_after_s=fails_after_s),
                seed=person,
                leak=self.faults.pump_leak,
                pump_dead=self.faults.pump_dead,
                lifts_after_s=self.faults.head_lifts_after,
            )
        self.clock = WorldClock(self)
        self.transcript: deque[str] = deque(maxlen=TRANSCRIPT_LINES)
        self.lock = threading.RLock()
        self._digest = hashlib.sha256()
        self._started = time.monotonic()
        self._now = 0.0
        self._name = ""
        self._shots_made = dict(shots_made or {})
        self._cameras: dict[str, CameraBody] = {}
        self._links = {name: self._make_link(name) for name in self.rig.boxes}

    def _make_link(self, name: str) -> Link:
        wiring = Wiring(
            rig=self.rig,
            rng=self.rng_for("box", name),
            faults=self.faults,
            on_light=self._light.add,
            on_trigger=self._trigger_scanner if name == SCANNER_BOX else self._trigger,
            on_grip=self._note_grip,
            skin=self.skin,
            head=self.head,
        )
        return Link(
            make_box(name, wiring),
            faults=self.faults,
            rng=self.rng_for("link", name),
            record=self._record_bytes,
        )

    def rng_for(self, *names: str) -> np.random.Generator:
        """Return a generator that depends on the world's seed and on `names` only."""
        words = [zlib.crc32(name.encode()) for name in names]
        return np.random.default_rng(np.random.SeedSequence([self.seed, *words]))

    # time -------------------------------------------------------------------------------------

    @property
    def now(self) -> float:
        """Time of the world since its construction, in s."""
        return self._now if self.virtual else time.monotonic() - self._started

    def deadline(self) -> float:
        """Return the time of the next event, in s; inf for never."""
        with self.lock:
            dues = [link.deadline(self._now) for link in self._links.values()]
            return min(dues, default=math.inf)

    def advance(self, now: float) -> float:
        """Advance time to `now`, in s; everything due before happens at its own time.

        Return the time of the next event, in s, as known at present; inf for never.
        """
        with self.lock:
            while (due := self.deadline()) <= now:
                self._now = max(self._now, due)
                for link in self._links.values():
                    link.advance(self._now)
            self._now = max(self._now, now)
            return due

    def wait(self, until: float) -> None:
        """Advance the world's time to `until`, in s: at once, or by waiting."""
        if self.virtual:
            self.advance(until)
            return
        while (remaining := until - self.now) > 0.0:
            self.advance(self.now)
            time.sleep(min(remaining, max(0.0, self.deadline() - self.now)))
        self.advance(self.now)

    # controllers ------------------------------------------------------------------------------

    def link(self, name: str) -> Link:
        """Return the line to the controller `name`."""
        if name not in self._links:
            raise KeyError(f"box: got {name!r}, expected one of {', '.join(self._links)}")
        return self._links[name]

    def box(self, name: str) -> Controller:
        """Return the controller `name`."""
        return self.link(name).box

    def _record_bytes(self, now: float, direction: str, data: bytes) -> None:
        line = f"{now:.6f} {direction} {data!r}"
        self.transcript.append(line)
        self._digest.update(line.encode() + b"\n")

    @property
    def transcript_sha256(self) -> str:
        """Hash of all bytes on the lines, with their times."""
        return self._digest.hexdigest()

    # cameras ----------------------------------------------------------------------------------

    def camera(self, view_name: str) -> CameraBody:
        """Return the camera of a view; it lives as long as the world."""
        with self.lock:
            if view_name not in self._cameras:
                first = self._shots_made.get(view_name, 0)
                self._cameras[view_name] = CameraBody(
                    self, self.rig.view(view_name), first_shot=first
                )
            return self._cameras[view_name]

    def _trigger(self, now: float, mask: int = -1) -> None:
        """Pulse the camera line; a dome pulses the lines of the mask's bits, in the rig's order."""
        self._release(self.rig.views, now, mask)

    def _trigger_scanner(self, now: float, mask: int) -> None:
        """Pulse the lines of the scanner's cameras, by the mask's bits."""
        if self.rig.scanner is not None:
            self._release(self.rig.scanner.views, now, mask)

    def _release(self, views: Iterable[View], now: float, mask: int) -> None:
        for number, view in enumerate(views):
            if mask >> number & 1 and view.name in self._cameras:
                self._cameras[view.name].edge(now)

    def light_between(self, start: float, end: float) -> tuple[Light, ...]:
        """Return pops from `start` to `end`, both included, and LEDs' light clipped to them."""
        with self.lock:
            now, boxes = self.now, [link.box.device for link in self._links.values()]
            going_on = [light for box in boxes for light in box.light_now(now)]
            return self._light.between(start, end, going_on)

    def pops_between(self, start: float, end: float) -> tuple[FlashPop, ...]:
        """Return the pops from `start` to `end`, both included, in s."""
        with self.lock:
            return self._light.pops_between(start, end)

    def grip_at(self, t_s: float) -> GripState:
        """Return the state of the caliper's grip at a world time, s.

        Raises
        ------
        ValueError
            Where the rig has no caliper.
        """
        with self.lock:
            if not self.grips:
                raise ValueError(f"caliper: rig {self.rig.name!r} has none")
            first = bisect_right(self.grips, t_s, key=lambda entry: entry[0])
            return self.grips[max(first - 1, 0)][1]

    def head_at(self, t_s: float) -> HeadState:
        """Return the state of the contact probe's head at a world time, s.

        Raises
        ------
        ValueError
            Where the rig has no contact probe.
        """
        with self.lock:
            if self.head is None:
                raise ValueError(f"probe: rig {self.rig.name!r} has none")
            self.head.advance(self.now)
            return self.head.state_at(t_s)

    @property
    def head_history(self) -> list[tuple[float, HeadState]]:
        """World times, s, of changes under the probe's head, with the states.

        In between the suction relaxes; `head_at` evaluates it at any time.
        """
        with self.lock:
            times = () if self.head is None else self.head.change_times_s
            return [(t_s, self.head_at(t_s)) for t_s in times]

    def _note_grip(self, now: float) -> None:
        if self.skin is not None and (state := self.skin.state) != self._last_grip():
            self.grips.append((now, state))

    def _last_grip(self) -> GripState | None:
        return self.grips[-1][1] if self.grips else None

    def expose(
        self,
        view_name: str,
        exposure: Exposure,
        t_start: float,
        *,
        seed: int,
        pops: Iterable[Light] | None = None,
    ) -> UInt16Array:
        """Return the DN, shape (H, W), of an exposure that began at `t_start`.

        Parameters
        ----------
        view_name
            Camera.
        exposure
            Its settings.
        t_start
            World time at which the shutter opened, s.
        seed
            Seed of the sensor's noise.
        pops
            Light of the exposure; by default that emitted while the shutter was open.
        """
        end = t_start + exposure.exposure_s
        seen = self.light_between(t_start, end) if pops is None else tuple(pops)
        if self.scene is None:
            return _dark_frame(self.rig.view(view_name), np.random.default_rng(seed))
        held: dict[str, Any] = {}
        if self.rig.caliper is not None:
            held = {"grip": self.grip_at(t_start)}
        elif self.rig.probe is not None:
            held = {"head": self.head_at(t_start)}
        exposure_s = exposure.exposure_s
        return self.scene.exposure(view_name, pops=seen, exposure_s=exposure_s, seed=seed, **held)

    # names ------------------------------------------------------------------------------------

    def register(self, name: str) -> str:
        """Make the world reachable as ``sim://flash?world=NAME`` and return `name`."""
        other = _WORLDS.setdefault(name, self)
        if other is not self:
            raise ValueError(f"name: got {name!r}, used by another world; unregister it first")
        self._name = name
        return name

    def unregister(self) -> None:
        """Unregister the world's name; a second call is allowed."""
        if _WORLDS.get(self._name) is self:
            del _WORLDS[self._name]
        self._name = ""


_WORLDS: dict[str, World] = {}


def get_world(name: str) -> World:
    """Return the registered world called `name`.

    Raises
    ------
    KeyError
        When there is none.
    """
    if name not in _WORLDS:
        known = ", ".join(_WORLDS) or "none"
        raise KeyError(f"world: got {name!r}, expected a registered one: {known}")
    return _WORLDS[name]


def find_world(name: str) -> World:
    """Return the registered world `name`, or the only unnamed one with that controller.

    Parameters
    ----------
    name
        Registered name; or the controller ``BOX`` of a world that ``sim://BOX`` or
        ``sim://BOX?...`` built without a name of its own.

    Raises
    ------
    KeyError
        When there is none, or several unnamed worlds have that controller.
    """
    unnamed = [url for url in _WORLDS if url.partition("?")[0] == f"sim://{name}"]
    if name in _WORLDS or not unnamed:
        return get_world(name)
    if len(unnamed) > 1:
        raise KeyError(
            f"world: got {name!r}, of which there are {len(unnamed)}, expected one with a name"
        )
    return _WORLDS[unnamed[0]]


def _dark_frame(view: View, rng: np.random.Generator) -> UInt16Array:
    shape = (view.height_px, view.width_px)
    noise = rng.normal(view.black_level, view.read_noise_e / view.gain_e_per_dn, shape)
    return np.rint(np.clip(noise, 0, 2**view.bit_depth - 1)).astype(np.uint16)
