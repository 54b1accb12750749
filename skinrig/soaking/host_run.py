"""Run one host against a simulated rig: open, capture or resume, end; with at most one fault."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import xxhash

from capture.acquire import CaptureInterrupted, Operator, run_plan
from capture.devices.camera import open_camera
from capture.devices.port import Port, PortBusy
from capture.plan import Plan
from capture.session import NewFrame, Session, SubjectRecord
from rigsim.world import World
from rigsim.world.line_faults import LineTap
from skinrig.capturing.acquisition import discard_unused_session
from skinrig.capturing.addresses import open_box
from skinrig.console import Console
from skinrig.errors import EXIT_DONE, exit_code
from skinrig.soaking.fault_draw import HostFault
from skinrig.soaking.host_life import HostKilled, HostLife
from skinrig.soaking.storage import FaultyDisk
from skinrig.soaking.witnesses import WitnessRig

FORCE_LIMIT_N = 2.0
"""Greatest force of the caliper, N."""
SECONDS_PER_DAY = 86_400.0
FIRST_DAY_S = 1.8e9
"""Time of the host's clock at the beginning of day 0, s since 1970."""
KILLED_CODE = -1
"""In place of the exit code of a killed host."""


@dataclass(slots=True)
class Ledger:
    """What a session has acknowledged.

    Attributes
    ----------
    frames
        Digest of each acknowledged frame, by step, camera and attempt.
    closed
        Whether the session's end was acknowledged.
    """

    frames: dict[tuple[str, str, int], str] = field(default_factory=dict)
    closed: bool = False


class SimulatedInterrupt(KeyboardInterrupt):
    """Ctrl-C at a simulated host; a real one ends the soak."""


class SilentConsole(Console):
    """A console that prints no progress."""

    def progress(self, text: str, left_s: float | None = None) -> None:
        """Print nothing."""


class WitnessedSession(Session):
    """A session that enters what it acknowledges into a ledger."""

    ledger: Ledger

    def commit_step(self, step_id: str, frames: Iterable[NewFrame]) -> None:
        """Commit frames of a step; see `Session.commit_step`."""
        committed = list(frames)
        super().commit_step(step_id, committed)
        for frame in committed:
            key = (step_id, frame.camera, frame.attempt)
            self.ledger.frames[key] = xxhash.xxh3_128_hexdigest(frame.blob)


class HostTap:
    """Line faults, and the fault of a host that strikes at a line to the controller.

    Parameters
    ----------
    faults
        Faults of the line.

    Attributes
    ----------
    life, fault
        Process of the host, and its fault.
    has_struck
        Whether the fault has happened; faults of the disk are noted by the disk.
    """

    def __init__(self, faults: LineTap) -> None:
        self._faults = faults
        self.begin(HostLife(), HostFault(), None)

    def begin(self, life: HostLife, fault: HostFault, world: World | None) -> None:
        """Begin the run of another host."""
        self.life, self.fault, self._world = life, fault, world
        self.has_struck = fault.kind == "clock jump"
        self._count = 0

    def pass_on(self, way: str, line: bytes) -> list[tuple[float, bytes]]:
        """Return what becomes of a line; see `LineTap`."""
        if way == ">":
            self.life.require()
            self._count += 1
            if self._count == self.fault.strike:
                self._strike()
        return self._faults.pass_on(way, line)

    def _strike(self) -> None:
        self.has_struck |= self.fault.kind in ("kill", "interrupt", "reset")
        if self.fault.kind == "kill":
            self.life.end()
        if self.fault.kind == "interrupt":
            raise SimulatedInterrupt
        if self.fault.kind == "reset" and self._world is not None:
            for name in self._world.rig.boxes:
                box = self._world.box(name)
                box.power_cycle(self._world.now, boot_s=0.5, announce=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class HostRun:
    """One run of a host: everything that determines it.

    Attributes
    ----------
    witness, world, world_name
        The rig, its world, and the world's name.
    plan
        Plan of a new session.
    folder
        Folder of the session.
    disk
        Disk of the host's computer.
    tap
        Tap of all lines.
    fault
        Fault of this run.
    ledger
        What was acknowledged; entries are added.
    label
        Unique name of the run, at most 24 characters; the part before the dot is the session's.
    day
        Day, which sets the host's clock.
    """

    witness: WitnessRig
    world: World
    world_name: str
    plan: Plan
    folder: Path
    disk: FaultyDisk
    tap: HostTap
    fault: HostFault
    ledger: Ledger
    label: str
    day: int

    def clock_s(self) -> float:
        """Return the host's clock, s since 1970."""
        return FIRST_DAY_S + self.day * SECONDS_PER_DAY + self.world.now + self.fault.jump_s

    def perform(self) -> tuple[int, str]:
        """Run the host; return its exit code, `KILLED_CODE` for a killed one, and its message."""
        opened: list[Any] = []
        self.tap.begin(self.disk.life, self.fault, self.world)
        ended = self._catch(lambda: self._capture(opened))
        for device in reversed(opened):
            closed = self._catch(device.close)
            if closed[0] != EXIT_DONE:  # the operating system closes what a dead process leaves
                ended = closed if ended[0] == EXIT_DONE else ended
                self._catch(device.close)
        self.disk.close_all()
        return ended

    @staticmethod
    def _catch(act: Callable[[], None]) -> tuple[int, str]:
        try:
            act()
        except HostKilled:
            return KILLED_CODE, "killed"
        except (Exception, SimulatedInterrupt, CaptureInterrupted) as error:
            return exit_code(error), f"{type(error).__name__}: {error}"
        return EXIT_DONE, "complete"

    def _capture(self, opened: list[Any]) -> None:
        boxes = self._open_boxes(opened)
        views = self.witness.rig.all_views
        cameras = {v.name: open_camera(f"sim://{self.world_name}/{v.name}") for v in views}
        opened.extend(cameras.values())
        fresh = not self.folder.exists()
        session, is_new = self._open_session()
        if session.closed:  # the host before was killed after its last write
            self.ledger.closed = True
            return
        unused = discard_unused_session(session, fresh, SilentConsole())
        with unused if is_new else nullcontext():
            run_plan(
                session.plan,
                self.witness.rig,
                boxes=boxes,
                cameras=cameras,
                session=session,
                operator=self._operator(),
                eyes=self.witness.eyes,
                force_limit_n=FORCE_LIMIT_N,
                all_brackets=True,
            )
            session.close()
        self.ledger.closed = True

    def _open_boxes(self, opened: list[Any]) -> Mapping[str, Any]:
        boxes: dict[str, Any] = {}
        first_seq = round(1e3 * self.clock_s()) % 2**32
        for kind in self.witness.rig.boxes:
            url = f"sim://{kind}?world={self.world_name}"
            boxes[kind] = open_box(kind, url, clock=self.world.clock, first_seq=first_seq)
            opened.append(boxes[kind])
        return boxes

    def _open_session(self) -> tuple[Session, bool]:
        if (self.folder / "session.json").exists():
            done = Session.open(self.folder)
            if done.closed:
                return done, False
            session, is_new = WitnessedSession.resume(self.folder, disk=self.disk), False
        else:
            now = datetime.fromtimestamp(self.clock_s(), UTC)
            session = WitnessedSession.create(
                self.folder,
                plan=self.plan,
                rig=self.witness.rig,
                devices={},
                subject=SubjectRecord("soak"),
                source="simulated",
                session_id=self.label.partition(".")[0],
                now=lambda: now,
                disk=self.disk,
            )
            is_new = True
        cast(WitnessedSession, session).ledger = self.ledger
        return session, is_new

    def _operator(self) -> Operator:
        asked = [0]

        def is_stopped() -> bool:
            self.disk.life.require()
            asked[0] += 1
            at_strike = asked[0] == 1 + self.fault.strike % 12
            self.tap.has_struck |= at_strike and self.fault.kind in ("second client", "abort")
            if at_strike and self.fault.kind == "second client":
                self._try_second_client()
            return at_strike and self.fault.kind == "abort"

        return Operator(
            interrupted=is_stopped, clock=self.clock_s, run_id=self.label, timer=self.world.clock
        )

    def _try_second_client(self) -> None:
        """Open each controller that this host uses; it must be refused."""
        for kind in self.witness.rig.boxes:
            url = f"sim://{kind}?world={self.world_name}"
            try:
                Port(url, clock=self.world.clock, first_seq=1).close()
            except PortBusy:
                continue
            raise SecondClientAdmitted(f"{url}: opened by two hosts")


class SecondClientAdmitted(Exception):
    """A controller has let two hosts in."""
