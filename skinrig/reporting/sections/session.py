"""The report's section on sessions: what was captured, when, on what."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path

from skinrig.reporting import page


@dataclass(frozen=True, slots=True)
class SessionFacts:
    """What a session says of itself."""

    rig: str
    day: date
    source: str
    seed: int | None
    frames: int
    megabytes: float

    @property
    def cells(self) -> tuple[object, ...]:
        """What a row of the table says of it."""
        seed = "" if self.seed is None else self.seed
        return self.rig, self.day.isoformat(), self.source, seed, self.frames, self.megabytes


def facts_of(folders: Sequence[Path]) -> dict[str, SessionFacts]:
    """Return what sessions say of themselves, by folder name."""
    found = {}
    for folder in folders:
        document = json.loads((folder / "session.json").read_text(encoding="utf-8"))
        frames = list((folder / "frames").glob("*"))
        found[folder.name] = SessionFacts(
            rig=str(document["plan"]["rig"]),
            day=datetime.fromisoformat(document["created_at"]).date(),
            source=str(document["source"]),
            seed=document.get("seed"),
            frames=len(frames),
            megabytes=sum(frame.stat().st_size for frame in frames) / 1e6,
        )
    return found


def section(sessions: Mapping[str, SessionFacts]) -> Iterator[page.Block]:
    """Yield the table of sessions; empty without any."""
    if not sessions:
        return
    yield page.Heading("Sessions", level=2)
    yield page.table(
        ("session", "rig", "captured", "source", "seed", "frames", "MB"),
        [(name, *one.cells) for name, one in sessions.items()],
        caption="Frames on disk; `skinrig verify` checks every one of them",
    )
