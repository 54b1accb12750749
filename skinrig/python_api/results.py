"""Results of the Python functions: folders with pictures and verdicts for notebooks."""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import xarray

    from capture.session import FrameRecord, Session
    from model.skin import SkinAppearance
    from reconstruction.pipeline.diagnosed_images import DiagnosedImages
    from skinrig.calibrating.calibrate import SavedCalibration
    from skinrig.exporting.sealing import ExportResult
    from skinrig.planning.plans import PlanChoice
    from skinrig.reporting.page import Block, Image

MAX_PICTURES: Final = 4
"""Frames that the display of a session draws."""
FRAME_HEIGHT_PX: Final = 480
LIVE_HEIGHT_PX: Final = 720


@dataclass(frozen=True)
class NotebookResult:
    """A result with a page of blocks that a notebook displays.

    Attributes
    ----------
    path
        Folder or file of the result.
    """

    path: Path

    def _repr_html_(self) -> str:
        return embed_blocks(str(self.path), self.blocks())

    def blocks(self) -> Iterable[Block]:
        """Return the blocks of the displayed page."""
        raise NotImplementedError


def embed_page(document: str, height_px: int = FRAME_HEIGHT_PX) -> str:
    """Return a frame for notebooks that contains a whole HTML document."""
    return (
        f'<iframe sandbox="allow-scripts" style="width:100%;height:{height_px}px;border:0" '
        f'srcdoc="{html.escape(document, quote=True)}"></iframe>'
    )


def embed_blocks(title: str, blocks: Iterable[Block]) -> str:
    """Return a frame for notebooks that contains blocks in the style of a report."""
    from skinrig.reporting.page import render_page

    return embed_page(render_page(title, list(blocks), []))


@dataclass(frozen=True)
class SessionFolder(NotebookResult):
    """A session on disk.

    Attributes
    ----------
    path
        SESSION/ folder.
    truth
        Folder of the ground truth of a simulated session; None without.
    """

    truth: Path | None = None

    @property
    def session(self) -> Session:
        """The session, opened for reading."""
        from capture.session import Session

        return Session.open(self.path)

    def to_xarray(self, kind: str | None = None) -> xarray.Dataset:
        """Return the frames of one kind of step with named dimensions, see `read_frames`.

        Parameters
        ----------
        kind
            Kind of step, such as "olat"; None: that of most frames.
        """
        from skinrig.python_api.xarrays import read_frames

        return read_frames(self.session, kind)

    def blocks(self) -> Iterator[Block]:
        """Yield pictures of some frames, and a table of facts."""
        from skinrig.reporting import page

        session = self.session
        records = [one for one in session.frames() if one.kind != "dark"] or session.frames()
        step = max(1, len(records) // MAX_PICTURES)
        yield page.Images([draw_frame(session, one) for one in records[::step][:MAX_PICTURES]])
        taken, pending = len(session.frames()), len(session.pending_frames())
        facts = {
            "rig": session.rig.name,
            "subject": session.subject.pseudonym,
            "source": session.source,
            "frames": taken,
            "frames of the plan not captured": pending,
            "kinds of steps": ", ".join(dict.fromkeys(step.kind for step in session.plan.steps)),
            "closed": "yes" if session.closed else "no",
        }
        yield page.build_facts_table(facts, caption=str(self.path))


def draw_frame(session: Session, record: FrameRecord) -> Image:
    """Return a picture of a frame, white balanced, its 99.5th percentile white."""
    import numpy as np

    from capture import raw
    from skinrig.reporting.map_images import draw_color_image

    frame = session.read(record)
    if frame.pattern == "MONO":
        linear = np.repeat((frame.cfa.astype(np.float32) - frame.black[0])[..., None], 3, axis=2)
    else:
        linear = raw.linear_rgb(frame, gain=1.0, read_noise=1.0).rgb
        linear = linear / np.array(frame.neutral or (1.0, 1.0, 1.0), np.float32)
    white = max(float(np.percentile(linear, 99.5)), 1e-9)
    index = ", ".join(f"{key} {value}" for key, value in record.index.items())
    return draw_color_image(
        f"{record.kind} {index}, {record.camera}", linear / white, lossy=True, of="frame"
    )


@dataclass(frozen=True)
class CalibrationFolder(NotebookResult):
    """A calibration on disk.

    Attributes
    ----------
    path
        CALIBRATION/ folder.
    saved
        Values with standard errors, findings and drift.
    """

    saved: SavedCalibration

    def blocks(self) -> Iterator[Block]:
        """Yield the calibrated quantities, findings and drift."""
        from skinrig.reporting import page

        yield page.build_table(("quantity", "value"), self.saved.summary, caption=str(self.path))
        yield page.Bullets([*self.saved.findings, *map(str, self.saved.drift)])


@dataclass(frozen=True)
class MapsFolder(NotebookResult):
    """Maps on disk: an appearance.

    Attributes
    ----------
    path
        APPEARANCE/ folder.
    truth
        Folder of the ground truth of a simulated session; None without.
    notes
        What was assumed, and what was omitted with the reason.
    """

    truth: Path | None = None
    notes: tuple[str, ...] = field(default=())

    @property
    def appearance(self) -> SkinAppearance:
        """The maps by name, each with unit, standard error and valid mask."""
        from model import store

        return store.read(self.path)

    def to_xarray(self) -> xarray.Dataset:
        """Return the maps with named dimensions, see `maps_to_dataset`."""
        from skinrig.python_api.xarrays import maps_to_dataset

        return maps_to_dataset(self.appearance)

    def blocks(self) -> Iterator[Block]:
        """Yield the verdict, the maps that matter most, and the notes."""
        from model import store
        from skinrig.reporting import first_screen, page
        from skinrig.reporting.folders import discover
        from skinrig.reporting.report import evaluate_checks
        from skinrig.reporting.verdict import format_headline, list_least_certain

        appearance = self.appearance
        truth = None if self.truth is None else store.read(self.truth)
        checks: list[page.Check] = []
        evaluate_checks(discover([self.path, *([self.truth] if self.truth else [])]), checks)
        lines = [format_headline(checks)] if checks else list_least_certain("", appearance)
        for line in lines:
            yield page.Paragraph(line)
        yield from first_screen.draw_first_screen(
            {self.path.name: appearance}, {self.path.name: truth}
        )
        yield page.build_table(
            ("map", "unit", "valid pixels"),
            [
                (name, one.unit, f"{100 * one.mask.mean():.0f} %")
                for name, one in appearance.maps.items()
            ],
            caption=str(self.path),
        )
        yield page.Bullets(self.notes)


@dataclass(frozen=True)
class DiagnosedSession(NotebookResult):
    """What the images of a session show about themselves and their light list.

    Attributes
    ----------
    path
        SESSION/ folder.
    found
        Findings with images, evidence and remedy; names of the images; of a light list also the
        order of the images and their directions.
    """

    found: DiagnosedImages

    def blocks(self) -> Iterator[Block]:
        """Yield the findings."""
        from skinrig.reporting import page

        if not self.found.findings:
            yield page.Paragraph(f"No fault was found in {len(self.found.names)} images.")
            return
        rows = [
            (
                one.fault,
                self.found.name_images(one),
                page.format_number(one.ratio_to_limit),
                one.evidence,
                one.remedy,
            )
            for one in self.found.findings
        ]
        head = ("fault", "images", "over its limit", "evidence", "remedy")
        yield page.build_table(head, rows, caption=str(self.path))


@dataclass(frozen=True)
class ChosenPlan(NotebookResult):
    """A plan with its forecast.

    Attributes
    ----------
    path
        Plan file, JSON, for `skinrig capture --plan`.
    choice
        Forecast errors, duration, omissions with reasons.
    """

    choice: PlanChoice

    def blocks(self) -> Iterator[Block]:
        """Yield the forecast and what the plan omits."""
        from skinrig.planning.plans import format_choice
        from skinrig.reporting import page

        yield page.Bullets(format_choice(self.choice))


@dataclass(frozen=True)
class HtmlPage(NotebookResult):
    """A page on disk that a browser opens.

    Attributes
    ----------
    path
        HTML file.
    verdict
        One sentence on the checks of a report; empty for other pages.
    """

    verdict: str = ""

    def _repr_html_(self) -> str:
        return embed_page(self.path.read_text(encoding="utf-8"), LIVE_HEIGHT_PX)


@dataclass(frozen=True)
class FittedModel(NotebookResult):
    """A fitted model on disk.

    Attributes
    ----------
    path
        Folder or file of the model.
    kind
        Kind of the fit, such as "wrinkles".
    fit
        The fit's own result.
    """

    kind: str
    fit: Any

    def blocks(self) -> Iterator[Block]:
        """Yield the kind and the place of the model."""
        from skinrig.reporting import page

        yield page.build_facts_table({"model": self.kind, "path": self.path}, caption="fitted")


@dataclass(frozen=True)
class ExportedFolder(NotebookResult):
    """An exported folder.

    Attributes
    ----------
    path
        Folder.
    result
        Number of files, manifest, omissions with reasons.
    """

    result: ExportResult

    def blocks(self) -> Iterator[Block]:
        """Yield the number of files, the manifest and the omissions."""
        from skinrig.reporting import page

        facts = {"files": self.result.files, "manifest": self.result.manifest}
        yield page.build_facts_table(facts, caption=str(self.path))
        yield page.Bullets([f"omitted: {what}: {why}" for what, why in self.result.left_out])
