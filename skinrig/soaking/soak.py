"""Let simulated rigs run for days under seeded faults, and replay any failure by its seed and day.

Each day has a world per rig, with faults of its own; everything in a day depends on the seed and on
the number of the day alone.
"""

import hashlib
import logging
import shutil
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rigsim.world import World
from skinrig.soaking.fault_draw import draw_rig_faults
from skinrig.soaking.soaked_session import InvariantViolated, SessionOutcome, SoakedSession
from skinrig.soaking.witnesses import WITNESS_RIGS, WitnessRig

SHOTS_PER_DAY = 200
"""Frames after which a day has no further session."""
HOURS_PER_DAY = 24.0
MAX_SESSIONS_PER_DAY = 60
IDLE_S = 600.0
"""Mean time between two sessions of a rig, s."""


@dataclass(slots=True)
class SoakResult:
    """Result of a soak.

    Attributes
    ----------
    seed, days, shots, sessions, runs, power_cuts
        Seed, and numbers of what was simulated.
    codes, faults
        Number of hosts by exit code, and of faults by kind.
    digest
        Hash of all bytes on all lines with their times, and of all complete sessions.
    processor_s
        Processor time, s.
    failure
        First violation and how to replay it; empty for none.
    """

    seed: int
    days: int = 0
    shots: int = 0
    sessions: int = 0
    runs: int = 0
    power_cuts: int = 0
    codes: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    digest: str = ""
    processor_s: float = 0.0
    failure: str = ""

    def add(self, outcome: SessionOutcome) -> None:
        """Add a session."""
        self.sessions += 1
        for name in ("shots", "runs", "power_cuts"):
            setattr(self, name, getattr(self, name) + getattr(outcome, name))
        self.codes += outcome.codes
        self.faults += outcome.faults


def run_soak(
    seed: int,
    *,
    hours: float,
    first_day: int = 0,
    shots_per_day: int = SHOTS_PER_DAY,
    budget_s: float = np.inf,
    progress: Callable[[str], None] = lambda line: None,
) -> SoakResult:
    """Simulate rigs under faults; stop at the first violation.

    Parameters
    ----------
    seed
        Determines all faults, >= 0.
    hours
        Simulated time, h; whole days are simulated.
    first_day
        Number of the first day, >= 0.
    shots_per_day
        Frames after which a day has no further session.
    budget_s
        Processor time after which no further day begins, s.
    progress
        Called with a line per day.

    Examples
    --------
    >>> run_soak(1, hours=0.0).failure
    ''
    """
    result, digest = SoakResult(seed), hashlib.sha256()
    begun_s = time.process_time()
    days = int(np.ceil(hours / HOURS_PER_DAY))
    with _quiet_logging():
        for day in range(first_day, first_day + days):
            if time.process_time() - begun_s > budget_s:
                break
            try:
                _soak_day(result, seed, day, digest, shots_per_day)
            except Exception as error:  # a crash needs its seed and day, too
                expected = isinstance(error, InvariantViolated)
                violation = str(error) if expected else f"{type(error).__name__}: {error}"
                replay = f"skinrig soak --seed {seed} --first-day {day} --hours 24"
                result.failure = f"day {day}, session {result.sessions}: {violation}; {replay}"
            result.days += 1
            result.processor_s = time.process_time() - begun_s
            progress(f"day {day}: {result.shots} shots, {result.processor_s:.0f} s")
            if result.failure:
                break
    result.digest = digest.hexdigest()
    return result


def _soak_day(result: SoakResult, seed: int, day: int, digest: Any, shots_per_day: int) -> None:
    rng = np.random.default_rng([seed, day])
    worlds: dict[str, tuple[World, str]] = {}
    names = sorted(WITNESS_RIGS)
    shots, time_s = 0, 0.0
    try:
        for number in range(MAX_SESSIONS_PER_DAY):
            if shots >= shots_per_day:
                break
            witness = WITNESS_RIGS[str(rng.choice(names))]
            if witness.name not in worlds:
                worlds[witness.name] = _make_world(witness, seed, day)
            world, name = worlds[witness.name]
            time_s += float(rng.exponential(IDLE_S))
            world.clock.sleep(max(0.0, time_s - world.now))
            outcome = _soak_session(witness, world, name, day=day, number=number, rng=rng)
            time_s = max(time_s, world.now)
            result.add(outcome)
            shots += outcome.shots
            digest.update(outcome.content_hash.encode())
    finally:
        for world, _ in worlds.values():
            digest.update(world.transcript_sha256.encode())
            world.unregister()


def _soak_session(
    witness: WitnessRig, world: World, name: str, *, day: int, number: int, rng: np.random.Generator
) -> SessionOutcome:
    root = Path(tempfile.mkdtemp(prefix="skinrig-soak-"))
    try:
        label = f"d{day}s{number}"
        soaked = SoakedSession(witness, world, name, root, label=label, day=day, rng=rng)
        return soaked.run()
    finally:
        shutil.rmtree(root)


def _make_world(witness: WitnessRig, seed: int, day: int) -> tuple[World, str]:
    own = np.random.default_rng([seed, day, zlib.crc32(witness.name.encode())])
    faults = draw_rig_faults(own, len(witness.rig.lights))
    world = World(witness.rig, seed=int(own.integers(2**31)), scene=witness, faults=faults)
    return world, world.register(f"soak-{seed}-{day}-{witness.name}-{id(world):x}")


@contextmanager
def _quiet_logging() -> Iterator[None]:
    """Silence the warnings of hosts: faults are the rule here."""
    logger = logging.getLogger("capture")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
