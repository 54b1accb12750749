"""Capture one session by a row of hosts under faults, and check after each what must hold."""

import ast
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xxhash

from capture.devices.led_box import Eyes
from capture.devices.port import DeviceError
from capture.raw import RawError
from capture.session import Session, SessionError, verify
from rigsim.world import World
from rigsim.world.line_faults import LineFaults
from skinrig.errors import EXIT_BAD_INPUT, EXIT_DEVICE_FAILED, EXIT_DONE, EXIT_INTERRUPTED
from skinrig.soaking.fault_draw import NO_HOST_FAULT, HostFault, draw_host_fault
from skinrig.soaking.host_life import HostLife
from skinrig.soaking.host_run import KILLED_CODE, HostRun, HostTap, Ledger, SecondClientAdmitted
from skinrig.soaking.light_limits import find_limit_violations
from skinrig.soaking.reckless_host import LIGHT_COMMANDS, request_too_much_light
from skinrig.soaking.storage import (
    DATA_FATES,
    LOST_SYNC,
    FaultyDisk,
    Image,
    LoggedDisk,
    Medium,
    lay_out,
)
from skinrig.soaking.witnesses import WitnessRig

DARK_SLACK_S = 0.01
"""Largest time from the end of the lease to darkness, s."""
PAUSE_S = 2.0
"""Time from a host's end to the next host, s."""
MAX_FAULTY_RUNS = 12
MAX_SOUND_RUNS = 4
REPLAY_INTERVAL_S = 0.05
MAX_LEASE_S = 5.0
PERSISTENT_ERRORS = ("was refused with 107", "emergency stop", "draws no current")
"""Messages of a rig that cannot go on before a person has acted."""
DOCUMENTED_CODES = {EXIT_DONE, EXIT_BAD_INPUT, EXIT_DEVICE_FAILED, EXIT_INTERRUPTED, KILLED_CODE}


class InvariantViolated(AssertionError):
    """Something that must hold in every world does not."""


def require(holds: bool, invariant: str, found: object) -> None:
    """Raise `InvariantViolated` unless an invariant holds."""
    if not holds:
        raise InvariantViolated(f"{invariant}: {found}")


class Storage:
    """The disk of a host's computer through killed processes and power cuts.

    Parameters
    ----------
    root
        Empty folder for everything on the disk.

    Attributes
    ----------
    lies : bool
        Whether syncs were reported that were not done.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.lies = root, False
        self._restart({})

    def _restart(self, image: Image) -> None:
        self._medium = Medium()
        self._last = LoggedDisk(self.root)
        self._last.adopt(image)
        self._take_over()

    def _take_over(self) -> None:
        for operation in self._last.log:
            self._medium.apply(operation)
        self._last.log = []

    def open_disk(self, fault: HostFault) -> FaultyDisk:
        """Return the disk of the next process."""
        kind = "kill" if fault.kind == "power cut" else fault.kind
        on_disk = fault.kind in ("power cut", LOST_SYNC) or kind not in _NOT_OF_DISK
        strike = fault.strike if on_disk else 0
        disk = FaultyDisk(self.root, self._last, life=HostLife(), strike=strike, fault=kind)
        disk.lies = self.lies
        self._last = disk
        return disk

    def end_process(self) -> None:
        """Take the operations of an ended process over; names that it unlinked itself, too."""
        self.lies = isinstance(self._last, FaultyDisk) and self._last.lies
        self._take_over()
        for name in sorted(self._medium.tree(len(self._medium.names_coming)), reverse=True):
            if not (self.root / name).exists():
                self._medium.apply(("remove", name))

    def cut_power(self, rng: np.random.Generator) -> None:
        """Leave on the disk what a power cut would."""
        fates = list(DATA_FATES)
        arrived = int(rng.integers(len(self._medium.names_coming) + 1))
        image = self._medium.image(arrived, lambda: fates[int(rng.integers(len(fates)))])
        for entry in self.root.iterdir():
            shutil.rmtree(entry)
        lay_out(image, self.root)
        self._restart(image)


_NOT_OF_DISK = (*("none", "kill", "interrupt", "abort", "second client", "clock jump", "reset"),)


@dataclass(slots=True)
class SessionOutcome:
    """What became of a session.

    Attributes
    ----------
    shots, runs, power_cuts
        Number of accepted frames, of hosts, and of power cuts.
    codes, faults
        Number of hosts by exit code, and by fault.
    content_hash
        Hash of the session; empty unless it is complete.
    """

    shots: int = 0
    runs: int = 0
    power_cuts: int = 0
    codes: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    content_hash: str = ""


class SoakedSession:
    """One session of one subject.

    Parameters
    ----------
    witness, world, world_name
        The rig, its world, and the world's name.
    root
        Empty folder for the disk.
    label
        Name of the session, at most 16 characters, without dots.
    day
        Day, which sets the hosts' clocks.
    rng
        Draws everything.
    """

    def __init__(
        self,
        witness: WitnessRig,
        world: World,
        world_name: str,
        root: Path,
        *,
        label: str,
        day: int,
        rng: np.random.Generator,
    ) -> None:
        self._witness, self._world, self._world_name = witness, world, world_name
        self._label, self._day, self._rng = label, day, rng
        self._folder, self._storage = root / "s", Storage(root)
        self._ledger, self._outcome = Ledger(), SessionOutcome()
        self._plan = witness.plan(rng)
        self._line = LineFaults(rng, float(rng.choice([0.0, 0.0, 0.005, 0.03])))
        self._tap = HostTap(self._line)
        for kind in world.rig.boxes:
            world.link(kind).tap = self._tap
        self._pops_before = tuple(world.pops)
        self._first_light = len(world.switched)

    def run(self) -> SessionOutcome:
        """Capture the session; raise `InvariantViolated`."""
        persistent = False
        for number in range(MAX_FAULTY_RUNS + MAX_SOUND_RUNS):
            sound = number >= MAX_FAULTY_RUNS
            if sound:
                self._line.share = 0.0
            fault = NO_HOST_FAULT if sound else draw_host_fault(self._rng)
            code, message = self._run_host(fault, number)
            persistent = persistent or any(text in message for text in PERSISTENT_ERRORS)
            self._check_code(code, message, fault)
            self._check_darkness()
            self._check_disk()
            if code == EXIT_DONE:
                break
            self._world.clock.sleep(PAUSE_S)
            if persistent:
                break
        self._check_light(self._witness.eyes)
        self._check_frames()
        if not self._storage.lies and not persistent:
            require(self._ledger.closed, "a session can be finished", message)
        self._outcome.faults += self._line.strikes
        if self._witness.box in LIGHT_COMMANDS and not persistent and self._rng.random() < 0.3:
            self._request_too_much_light()
        return self._outcome

    def _request_too_much_light(self) -> None:
        world = self._world
        for kind in world.rig.boxes:
            world.link(kind).tap = None
        self._pops_before, self._first_light = tuple(world.pops), len(world.switched)
        first_seq = int(self._rng.integers(2**31))
        box = self._witness.box
        try:
            dark = request_too_much_light(
                world, self._world_name, box, rng=self._rng, first_seq=first_seq
            )
            require(dark, "dark at once when made dark", box)
        except DeviceError:  # the day's faults of the line: the light so far is judged
            self._outcome.faults["reckless host lost"] += 1
        world.clock.sleep(PAUSE_S + MAX_LEASE_S)
        self._check_light("open")

    def _run_host(self, fault: HostFault, number: int) -> tuple[int, str]:
        disk = self._storage.open_disk(fault)
        run = HostRun(
            witness=self._witness,
            world=self._world,
            world_name=self._world_name,
            plan=self._plan,
            folder=self._folder,
            disk=disk,
            tap=self._tap,
            fault=fault,
            ledger=self._ledger,
            label=f"{self._label}.{number}",
            day=self._day,
        )
        code, message = run.perform()
        self._storage.end_process()
        if fault.kind == "power cut" and disk.life.ended:
            self._storage.cut_power(self._rng)
            self._outcome.power_cuts += 1
        self._outcome.runs += 1
        self._outcome.codes[code] += 1
        if self._tap.has_struck or disk.struck:
            self._outcome.faults[fault.kind] += 1
        return code, message

    # what must hold -----------------------------------------------------------------------------

    def _check_code(self, code: int, message: str, fault: HostFault) -> None:
        admitted = message.startswith(SecondClientAdmitted.__name__)
        require(not admitted, "a controller has one host at a time", message)
        documented = code in DOCUMENTED_CODES
        if code == EXIT_BAD_INPUT:
            documented = self._storage.lies or "SessionDiskError" in message
        if code == EXIT_INTERRUPTED:
            documented = fault.kind in ("interrupt", "abort")
        require(documented, "a host ends with a documented exit code", f"{code}, {message}")

    def _check_darkness(self) -> None:
        """Check that all light ends with the lease, although lines of the dead host come again."""
        world = self._world
        units = {kind: world.box(kind) for kind in world.rig.boxes}
        from_s = max([world.now, *(world.link(kind).quiet_from_s for kind in units)])
        world.clock.sleep(from_s - world.now)
        ends_s = {kind: world.now + unit.lease_s + DARK_SLACK_S for kind, unit in units.items()}
        replays = self._find_delivered() if self._rng.random() < 0.6 else []
        while world.now < max(ends_s.values()):
            for kind, unit in units.items():
                if replays and self._witness.box == kind:
                    line = replays[int(self._rng.integers(len(replays)))]
                    unit.feed(line, world.now)
            step_s = REPLAY_INTERVAL_S if replays else np.inf
            world.clock.sleep(
                min(step_s, min(e for e in ends_s.values() if e > world.now) - world.now)
            )
            for kind, unit in units.items():
                if world.now >= ends_s[kind]:
                    lit = bool(getattr(unit.device, "lit", False))  # a caliper has no light
                    state = f"{kind} armed {unit.armed}, lit {lit}"
                    require(not (unit.armed or lit), "dark within lease + 10 ms", state)

    def _find_delivered(self) -> list[bytes]:
        """Return the whole lines that reached controllers since the last host began."""
        found: list[bytes] = []
        for entry in self._world.transcript:
            _, way, text = entry.split(" ", 2)
            line = ast.literal_eval(text)
            if way == ">" and b"HELLO?" in line:
                found.clear()
            if (
                way == ">"
                and line.startswith(b"@")
                and line.count(b"\n") == 1
                and line[-1:] == b"\n"
            ):
                found.append(line)
        return found

    def _check_light(self, eyes: Eyes) -> None:
        world = self._world
        found = find_limit_violations(
            world.rig,
            pops=world.pops[len(self._pops_before) :],
            switched=world.switched[self._first_light :],
            earlier_pops=self._pops_before,
            eyes=eyes,
        )
        for violation in found:
            require(False, "limits of dose and flicker hold", violation)

    def _check_disk(self) -> None:
        """Check that a session is sound, or states why not."""
        if not (self._folder / "session.json").exists():
            kept = self._storage.lies or not self._ledger.frames  # unused ones are removed
            require(kept, "no frame is lost", "no session is left")
            return
        try:
            report = verify(self._folder)
        except SessionError as error:
            require(self._storage.lies, "a session verifies", error)
            return
        require(report.ok or self._storage.lies, "a session verifies", report.problems)

    def _check_frames(self) -> None:
        """Check that each frame is the acknowledged one, under the light of its step."""
        if not (self._folder / "session.json").exists():
            return
        try:
            session = Session.open(self._folder)
            for deviation in self._find_deviations(session):
                require(False, "no frame is filed under a wrong light", deviation)
        except (SessionError, RawError) as error:
            require(self._storage.lies, "each frame is readable", error)
            return
        if session.complete:
            self._outcome.content_hash = session.content_hash

    def _find_deviations(self, session: Session) -> Iterator[str]:
        found: set[tuple[str, str, int]] = set()
        for record in session.frames():
            key = (record.step_id, record.camera, record.attempt)
            found.add(key)
            frame = session.read(record)
            if digest := self._ledger.frames.get(key):
                blob = (self._folder / record.file).read_bytes()
                same = xxhash.xxh3_128_hexdigest(blob) == digest
                require(same, "no acknowledged frame is altered", record.step_id)
            serial = self._witness.rig.view(record.camera).serial
            same = record.actual["serial"] == serial
            require(same, "no frame of another camera", record.step_id)
            deviation = self._witness.find_deviation(
                record.step, frame.cfa, record.actual, self._world.faults.weak_leds
            )
            if deviation:
                yield f"{record.step_id}: {deviation}"
        self._outcome.shots = len(found)
        omitted = session.omitted_steps()
        if session.closed:
            have = {step for step, _, _ in found} | set(omitted)
            missing = [step.id for step in session.plan.steps if step.id not in have]
            require(not missing, "a complete session has all frames", missing)
        latest = {(step, camera): 0 for step, camera, _ in self._ledger.frames}
        for step, camera, attempt in self._ledger.frames:
            latest[step, camera] = max(latest[step, camera], attempt)
        lost = [
            (step, camera)
            for (step, camera), attempt in latest.items()
            if step not in omitted
            and not any((step, camera, later) in found for later in (attempt, attempt + 1))
        ]
        require(not lost or self._storage.lies, "no frame is lost", lost)
