"""Report section on sessions: rig, date, source and frames."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Any

from skinrig.reporting import page
from skinrig.reporting.folders import ReportError
from skinrig.simulating.effect_omission import is_omittable


@dataclass(frozen=True, slots=True)
class SessionFacts:
    """Facts that a session records."""

    rig: str
    day: date
    source: str
    renderer: str
    """Renderer of simulated images; empty for measured ones."""
    seed: int | None
    frames: int
    megabytes: float

    @property
    def cells(self) -> tuple[object, ...]:
        """Row of the table."""
        seed = "" if self.seed is None else self.seed
        source = f"{self.source} ({self.renderer})" if self.renderer else self.source
        return self.rig, self.day.isoformat(), source, seed, self.frames, self.megabytes


def read_session_facts(folders: Sequence[Path]) -> dict[str, SessionFacts]:
    """Return the facts that sessions record, by folder name.

    Raises
    ------
    skinrig.reporting.folders.ReportError
        If a session's document is not JSON.
    """
    found = {}
    for folder in folders:
        try:
            document = json.loads((folder / SESSION_FILE).read_bytes())
        except ValueError as error:
            raise ReportError(
                f"{folder / SESSION_FILE}: is not JSON ({error}); restore it from a copy"
            ) from error
        frames = list((folder / "frames").glob("*"))
        renderer = document.get("extra", {}).get("renderer", {})
        found[folder.name] = SessionFacts(
            rig=str(document["plan"]["rig"]),
            day=datetime.fromisoformat(document["created_at"]).date(),
            source=str(document["source"]),
            renderer=str(renderer.get("name", "")) if isinstance(renderer, dict) else "",
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
    yield page.build_table(
        ("session", "rig", "captured", "source", "seed", "frames", "MB"),
        [(name, *one.cells) for name, one in sessions.items()],
        caption="Frames on disk; skinrig verify checks each of them",
    )


VERDICT_WORDS = {
    "asked": "omitted by option",
    "negligible": "omitted, negligible",
    "unmodeled": "not modeled",
    "absent": "absent",
    "built": "simulated",
}
"""In the order in which verdicts are listed, see `rigsim.needs.effects.VERDICT_MEANINGS`."""

SESSION_FILE = "session.json"


_EFFECT_KEYS = {"name", "verdict", "reason"}


def read_effects(session: Path) -> list[Mapping[str, Any]]:
    """Return the effects that a session's manifest holds; none where it was measured.

    Parameters
    ----------
    session
        SESSION/ folder.
    """
    manifest = session / SESSION_FILE
    if not manifest.is_file():
        return []
    document = json.loads(manifest.read_text(encoding="utf-8"))
    found = document.get("extra", {}).get("effects", [])
    return [entry for entry in found if isinstance(entry, dict) and _EFFECT_KEYS <= entry.keys()]


def list_omissions(sessions: Sequence[Path]) -> Iterator[page.Block]:
    """Yield the effects of simulated scenes; empty where no session records them.

    Parameters
    ----------
    sessions
        SESSION/ folders. Sessions with equal scenes share a table.

    Yields
    ------
    Block
        The same for the same sessions in any order.
    """
    alike: dict[str, list[str]] = {}
    for session in sorted(sessions):
        found = read_effects(session)
        if found:
            alike.setdefault(json.dumps(found, sort_keys=True), []).append(session.name)
    if not alike:
        return
    yield page.Heading("Effects in simulated scenes", level=2)
    yield page.build_view("omissions")
    order = list(VERDICT_WORDS.values())
    for text, names in alike.items():
        effects = json.loads(text)
        rows = [_effect_row(effect) for effect in effects]
        rows.sort(key=lambda row: (*order, row[1]).index(row[1]))
        out = sum(not effect["verdict"] == "built" for effect in effects)
        title = f"{', '.join(names)}: {len(effects) - out} of {len(effects)} effects simulated"
        head = ("effect", "treatment", "reason", "change over noise", "option name")
        yield page.build_table(head, rows, caption=title)


def _effect_row(effect: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    over, switch = effect.get("over_noise"), str(effect.get("switch", ""))
    return (
        str(effect["name"]),
        VERDICT_WORDS.get(str(effect["verdict"]), str(effect["verdict"])),
        str(effect["reason"]),
        "" if over is None else f"{over:.3g}",
        switch if is_omittable(switch) else "",
    )
