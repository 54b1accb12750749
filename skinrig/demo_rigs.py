"""Run the demo of each rig: simulate, capture, calibrate, reconstruct and measure.

Each rig runs in its own process, which compiles the kernels it imports. Modules that only some
rigs need are therefore imported in functions; the command's own process needs none of them.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from model.skin import SkinAppearance
from skinrig.capturing.light_safety import light_rows
from skinrig.simulating.orders import SimulationResult
from skinrig.simulating.simulation import simulate_session

RIGS = ("flash", "dome", "gradient", "probe")
HEAD_PART = "head"
PHOTOGRAPHS_PART = "photographs"
PERSON_PART = "person"
FACE_PART = "face"
"""Parts of the demo after the rigs that they need."""
DEMO_SUBJECT = "III"
"""Skin type of the one person in front of flash rig, dome and probe."""
FLASH_STATES = ("neutral", "anger")
"""Expressions of the face, to which a hemoglobin rig is fitted."""
FLASH_MOVING_FOLDER = f"appearance-flash-moving-{DEMO_SUBJECT}"
"""Folder of the blood of the moving face."""
FLASH_CALIBRATIONS = {"flat": "sensor", "white": "white", "chart": "color", "malus": "polarization"}
"""Calibration by target, in the order of computation."""
FLASH_WANT = (
    *("melanin", "hemoglobin", "shading", "residual", "diffuse", "image", "specular_image"),
    *("tsumura_melanin", "tsumura_hemoglobin"),
)
DOME_WANT = (
    *("half_vector_normals", "normals", "normals_refined", "r_d", "lobe_residual", "samples"),
    *(f"basis_weight_{lobe}" for lobe in range(4)),
)
DOME_HOLD_OUT = "lights=16,23"
"""Numbers of held-out lights; renderings are compared with their photographs."""
DOME_OMITTED_EFFECTS = ("subsurface",)
"""Lateral scattering takes half a minute and blurs by less than a pixel of 2 mm."""
N_COMPARED_PHOTOGRAPHS = 3
"""Number of held-out photographs compared with renderings."""
DOME_WIDTH_PX = 320
"""Default image width of the dome's cameras."""

PROBE_MEDIUM = "homogeneous:0.08,1.2"
"""Homogeneous medium with known sigma_tr, 0.55 per mm; for layers it is a definition only."""
MEDIUM_WANT = ("profiles", "subsurface")
PROBE_WANT = (*MEDIUM_WANT, "translucency")
GRADIENT_SITE = "forehead"
DOUBLE_FOLDER = "double"
"""Folder of the person's fused maps."""
FACE_FOLDER = "finished-face"
"""Folder of the person's face, lit and moving."""
FUSED_SUBJECTS = {
    "flash": DEMO_SUBJECT,
    "dome": DEMO_SUBJECT,
    "gradient": GRADIENT_SITE,
    "probe": DEMO_SUBJECT,
}
"""Names of the fused maps' sessions by rig."""
GRADIENT_WANT = ("normals", "height", "crossed", "strain", "histograms", "kernels")


@dataclass(slots=True)
class DemoResults:
    """Errors and tables of the demo's parts."""

    errors: list[list[Any]] = field(default_factory=list)
    """Subject, map, error, unit, coverage in %, masked fraction in %."""
    tables: list[dict[str, Any]] = field(default_factory=list)
    made: Any = None
    """What a part that needs this one takes over: the fitted head, or the fused person."""

    def add(
        self, name: str, quantity: str, error: float, unit: str, coverage: float, masked: float
    ) -> None:
        """Add the error of a map; coverage and masked are fractions of 1."""
        self.errors.append([name, quantity, error, unit, 100 * coverage, 100 * masked])

    def add_table(self, title: str, head: list[str], rows: Iterable[Iterable[Any]]) -> None:
        """Add a table."""
        self.tables.append({"title": title, "head": head, "rows": [list(row) for row in rows]})

    def add_light(self, title: str, capture: SimulationResult) -> None:
        """Add a table of the light that a capture took."""
        self.add_table(title, ["quantity", "value"], light_rows(capture.light))

    def add_omissions(self, rig: str, capture: SimulationResult) -> None:
        """Add a table of effects that a capture's simulator omitted."""
        title = f"Effects omitted by the simulator of the {rig}"
        self.add_table(title, ["effect", "reason"], capture.left_out)


StepTimer = Callable[[str], AbstractContextManager[None]]


@dataclass(frozen=True, slots=True)
class RigDemo:
    """Part of the demo, such as one rig."""

    out: Path
    seed: int
    share: StepTimer
    """Times a step."""
    width_px: int | None
    before: Mapping[str, DemoResults]
    """Results of the parts that this one needs, by name."""
    found: DemoResults = field(default_factory=DemoResults)

    def simulate(self, rig: str, name: str, **options: Any) -> SimulationResult:
        """Simulate a capture into ``session-RIG-NAME``."""
        return simulate_session(rig, self.out / f"session-{rig}-{name}", seed=self.seed, **options)

    def calibrate(self, rig: str, kind: str, *targets: str, **options: Any) -> None:
        """Calibrate a rig from sessions of targets."""
        from skinrig.calibrating.calibrate import calibrate

        sessions = [self.out / f"session-{rig}-{target}" for target in targets]
        calibrate(kind, sessions, self.out / f"calibration-{rig}", **options)

    def reconstruct(
        self,
        rig: str,
        capture: SimulationResult,
        want: tuple[str, ...],
        hold_out: str | None = None,
    ) -> tuple[str, Path, SkinAppearance, SkinAppearance]:
        """Reconstruct a capture; return the maps' name and folder, the maps and ground truth."""
        from reconstruction.pipeline import recipes as pipeline
        from reconstruction.pipeline.inputs import DomeOptions

        folder = self.out / capture.session.name.replace("session", "appearance")
        pipeline.reconstruct(
            capture.session,
            want=want,
            out=folder,
            calibration=self.out / f"calibration-{rig}",
            truth=capture.truth_name,
            dome=DomeOptions(hold_out=hold_out),
        )
        truth = store.read(self.out / capture.truth_name)
        return folder.name.removeprefix("appearance-"), folder, store.read(folder), truth


def choose_width(rig: str, width_px: int | None) -> int | None:
    """Return the image width of a rig's demo, px; None: that of its small scale.

    Examples
    --------
    >>> choose_width("dome", None), choose_width("gradient", 640), choose_width("flash", 640)
    (320, 256, 640)
    """
    if rig == "dome":
        return DOME_WIDTH_PX if width_px is None else min(width_px, DOME_WIDTH_PX)
    if rig == "probe" or width_px is None:
        return None
    return max(128, min(width_px, 256)) if rig == "gradient" else width_px


def _flash(run: RigDemo) -> None:
    """Run the flash rig on targets and a face, up to melanin, blood volume and its changes."""
    from skinrig.evaluating import flash
    from skinrig.fitting.facial_color import fit_facial_color

    found, width = run.found, run.width_px
    with run.share("flash: capture the calibration targets"):
        for target in FLASH_CALIBRATIONS:
            run.simulate("flash", target, target=target, width_px=width)
    with run.share("flash: calibrate"):
        for target, kind in FLASH_CALIBRATIONS.items():
            run.calibrate("flash", kind, target)
    with run.share("flash: capture a face"):
        capture = run.simulate(
            "flash", DEMO_SUBJECT, subject=DEMO_SUBJECT, width_px=width, states=FLASH_STATES
        )
    with run.share("flash: reconstruct melanin and blood"):
        name, _, maps, truth = run.reconstruct("flash", capture, FLASH_WANT)
        for row in flash.compare(maps, truth, rng=np.random.default_rng(0)):
            if row.band is None and row.against == "blurred":
                error = 100 * row.median_relative
                found.add(name, row.name, error, "%", row.coverage.fraction, row.masked)
    with run.share("flash: fit the blood of a moving face"):
        moving = run.out / FLASH_MOVING_FOLDER
        calibration = run.out / "calibration-flash"
        fit_facial_color([capture.session], out=moving, calibration=calibration)
        _evaluate_states(moving, found)
    found.add_table(
        "Blur by lateral scattering in the skin, 10 to 90 % of an edge, mm",
        ["subject", "red", "green", "blue"],
        [[capture.session.name, *(round(mm, 3) for mm in capture.blur_mm)]],
    )
    found.add_omissions("flash rig", capture)


def _evaluate_states(appearance: Path, found: DemoResults) -> None:
    from skinrig.appearances.dynamic import FACIAL_COLOR, describe_parts
    from skinrig.applying.expression import read_hemoglobin_rig
    from skinrig.evaluating import facial_color

    maps = store.read(appearance)
    named = describe_parts(maps)[FACIAL_COLOR]["truth"]
    truths = {state: store.read(appearance.parent / folder) for state, folder in named.items()}
    rng = np.random.default_rng(0)
    states, _ = facial_color.compare(maps, read_hemoglobin_rig(maps), truths, rng=rng)
    name = appearance.name.removeprefix("appearance-")
    for row in states:
        if row.method in (facial_color.PREDICTION_METHODS[1], facial_color.PREDICTION_METHODS[3]):
            what = f"blood of {row.state}, {row.method}"
            found.add(name, what, 100 * row.median_relative, "%", row.coverage, 0.0)


def _dome(run: RigDemo) -> None:
    """Run the dome on targets and a face, up to normals, albedo and basis BRDFs."""
    from skinrig.evaluating import reflection
    from skinrig.evaluating import surface as surface_evaluation

    found = run.found
    width = choose_width("dome", run.width_px)
    with run.share("dome: capture the calibration targets"):
        for target in ("charuco", "mirror", "white"):
            run.simulate("dome", target, target=target, width_px=width)
    with run.share("dome: calibrate cameras and lights"):
        run.calibrate("dome", "geometry", "charuco")
        run.calibrate("dome", "lights", "mirror", "white")
    with run.share("dome: scan and capture a face"):
        capture = run.simulate(
            "dome",
            DEMO_SUBJECT,
            subject=DEMO_SUBJECT,
            leave_out=DOME_OMITTED_EFFECTS,
            width_px=width,
        )
    with run.share("dome: reconstruct normals, albedo and basis BRDFs"):
        name, _, maps, truth = run.reconstruct("dome", capture, DOME_WANT, DOME_HOLD_OUT)
        for row in surface_evaluation.compare(maps, truth, rng=np.random.default_rng(0)):
            found.add(
                name, row.name, row.limit_check[1], row.unit, row.coverage.fraction, row.masked
            )
        held_out = reflection.compare(maps, truth, rng=np.random.default_rng(0))
        if held_out is not None:
            error = 100 * held_out.median
            found.add(name, "reflection, held out", error, "%", float("nan"), 0.0)
    found.add_light("Light of the dome's capture", capture)
    found.add_omissions("dome", capture)


def _photographs(run: RigDemo) -> None:
    """Render the dome's held-out photographs from its maps."""
    from skinrig.rendering.photographs.errors import FULL_MODEL
    from skinrig.rendering.photographs.evaluation import EvaluationSettings, evaluate_folders

    with run.share("dome: render held-out photographs"):
        compared = evaluate_folders(
            run.out / f"appearance-dome-{DEMO_SUBJECT}",
            run.out / f"session-dome-{DEMO_SUBJECT}",
            run.out / f"pictures-dome-{DEMO_SUBJECT}",
            EvaluationSettings(count=N_COMPARED_PHOTOGRAPHS, seed=run.seed),
            calibration=run.out / "calibration-dome",
        )
    models = {FULL_MODEL: compared[FULL_MODEL], **compared["ablation"]}
    run.found.add_table(
        "Luminance of held-out photographs, on lit pixels",
        ["model", "median error, %", "all skin, %"],
        ([name, 100 * row["median"], 100 * row["total_error"]] for name, row in models.items()),
    )


def _gradient(run: RigDemo) -> None:
    """Run the gradient sphere on a glass ball and stretched skin, up to kernels."""
    from skinrig.evaluating import microrelief
    from skinrig.fitting.microstructure import fit_microstructure
    from skinrig.reporting.map_names import state_title

    found = run.found
    with run.share("gradient: capture a ball of black glass"):
        run.simulate("gradient", "ball", target="ball")
    with run.share("gradient: calibrate lights and polarizers"):
        surveys: dict[str, Any] = {}
        for kind in ("lights", "polarization"):
            run.calibrate("gradient", kind, "ball", surveys=surveys)
    with run.share("gradient: stretch and capture a patch of skin"):
        width = choose_width("gradient", run.width_px)
        capture = run.simulate("gradient", GRADIENT_SITE, site=GRADIENT_SITE, width_px=width)
    with run.share("gradient: reconstruct normals, heights and kernels"):
        name, folder, maps, truth = run.reconstruct("gradient", capture, GRADIENT_WANT)
        moving = run.out / f"appearance-gradient-moving-{GRADIENT_SITE}"
        fit_microstructure([folder], out=moving, paper_table=True)
        for row in microrelief.compare(maps, truth, rng=np.random.default_rng(0)):
            if row.state.endswith("_n0"):
                found.add(name, "normals, neutral", row.mean_deg, "deg", row.coverage, row.masked)
                error, held = 100 * row.height_relative, row.height_coverage
                found.add(name, "height, neutral", error, "%", held, row.masked)
        strain = microrelief.compare_stretch(maps, truth)
        if strain:
            worst = max(strain, key=lambda row: abs(row.error))
            what, error = f"stretch, {state_title(worst.state)}", 100 * abs(worst.error)
            found.add(name, what, error, "%", float("nan"), 0.0)
    found.add_light("Light of one scan in the gradient sphere", capture)
    found.add_omissions("gradient sphere", capture)


def _probe(run: RigDemo) -> None:
    """Run the fiber probe on a phantom, a medium and three sites of a face."""
    from skinrig.evaluating import subsurface

    with run.share("probe: capture a phantom"):
        run.simulate("probe", "phantom", target="phantom")
    with run.share("probe: calibrate its fibers"):
        run.calibrate("probe", "fiber", "phantom")
    with run.share("probe: capture a medium and three sites of a face"):
        captures = [
            run.simulate("probe", "medium", subject=PROBE_MEDIUM, sites=("cheek",)),
            run.simulate("probe", DEMO_SUBJECT, subject=DEMO_SUBJECT),
        ]
    with run.share("probe: reconstruct sigma_tr and diffuse mean free path"):
        # a medium is the same everywhere: a map over a face would show the face's places alone
        for capture, want in zip(captures, (MEDIUM_WANT, PROBE_WANT), strict=True):
            name, _, maps, truth = run.reconstruct("probe", capture, want)
            fits = subsurface.compare_fits(maps, truth)
            for row in subsurface.summarize_methods(fits):
                lost = np.mean([not fit.valid for fit in fits if fit.method == row.method])
                what, error = f"sigma_tr, {row.method}", 100 * row.median
                run.found.add(name, what, error, "%", row.coverage, float(lost))
    run.found.add_omissions("fiber probe", captures[-1])


def _fit_head(run: RigDemo) -> None:
    """Fit the mean head to the dome's mesh, which the fused person has, too."""
    from skinrig.fusing.unmeasured import find_unmeasured

    with run.share("dome: fit the mean head"):
        dome = store.read(run.out / f"appearance-dome-{DEMO_SUBJECT}")
        run.found.made = find_unmeasured(dome)


def _fuse_person(run: RigDemo) -> None:
    """Fuse the maps of one person by all rigs, and compare them with the best single rig."""
    from skinrig.evaluating.fusion import compare_fused
    from skinrig.fusing.double import FusionInputs, fuse

    rigs = [rig for rig in RIGS if rig in run.before]
    folders = {rig: run.out / f"appearance-{rig}-{FUSED_SUBJECTS[rig]}" for rig in rigs}
    with run.share("fuse the rigs' maps of the person"):
        double = fuse(
            FusionInputs(tuple(folders.values())),
            out=run.out / DOUBLE_FOLDER,
            unmeasured=run.before[HEAD_PART].made,
        )
    with run.share("compare the fused maps with each rig's"):
        single = {rig: store.read(folders[rig]) for rig in ("flash", "dome")}
        truths = {
            rig: store.read(run.out / str(one.parameters["truth"])) for rig, one in single.items()
        }
        rows = compare_fused(double.appearance, single, truths, double.measured.placement)
    position = double.appearance.maps["position"].mask
    for row in rows:
        masked = 1.0 - float(double.appearance.maps[row.quantity.split()[0]].mask[position].mean())
        run.found.add(DOUBLE_FOLDER, row.quantity, 100 * row.fused, "%", row.fused_coverage, masked)
    run.found.add_table(
        "Fused person against the best single rig, median error of the logarithm",
        ["map", "fused, %", "single rig, %", "single rig"],
        ([r.quantity, 100 * r.fused, 100 * r.single, r.rig] for r in rows),
    )
    named = double.contradiction or "none"
    run.found.add_table("Rig that contradicts the others", ["rig"], [[named]])
    run.found.made = double


def _light_face(run: RigDemo) -> None:
    """Render the fused person's face, lit and moving, with errors of the maps that it shows."""
    from skinrig.fusing.finished_face import render_finished_face, write_finished_face

    double = run.before[PERSON_PART].made
    with run.share("light and move the finished face"):
        maps = run.out / DOUBLE_FOLDER, run.out / FLASH_MOVING_FOLDER
        moving = store.read(maps[1])
        face = render_finished_face(double, moving, expression=FLASH_STATES[1], seed=run.seed)
        write_finished_face(
            run.out / FACE_FOLDER,
            face,
            double,
            moving,
            errors=_list_errors_shown(row for one in run.before.values() for row in one.errors),
            folders=maps,
        )


def _list_errors_shown(errors: Iterable[list[Any]]) -> dict[str, str]:
    """Return the errors of what the finished face shows, in words, by quantity."""
    from skinrig.evaluating.facial_color import PREDICTION_METHODS

    by_name = {(row[0], row[1]): row[2] for row in errors}
    r_d = [e for (name, what), e in by_name.items() if (name, what[:4]) == (DOUBLE_FOLDER, "r_d ")]
    shown = {}
    if r_d:
        shown["diffuse reflectance"] = f"{min(r_d):.1f} to {max(r_d):.1f} %"
    for name, what, label, unit in (
        (f"dome-{DEMO_SUBJECT}", "normals_refined", "normals", "°"),
        (f"dome-{DEMO_SUBJECT}", "reflection, held out", "reflection in held-out light", " %"),
        (
            f"flash-moving-{DEMO_SUBJECT}",
            f"blood of {FLASH_STATES[1]}, {PREDICTION_METHODS[1]}",
            f"blood volume fraction of {FLASH_STATES[1]}",
            " %",
        ),
    ):
        if (name, what) in by_name:
            shown[label] = f"{by_name[name, what]:.1f}{unit}"
    return shown


RUN_BY_PART: Mapping[str, Callable[[RigDemo], None]] = {
    "flash": _flash,
    "dome": _dome,
    HEAD_PART: _fit_head,
    PHOTOGRAPHS_PART: _photographs,
    "gradient": _gradient,
    "probe": _probe,
    PERSON_PART: _fuse_person,
    FACE_PART: _light_face,
}
"""Function of each part of the demo, in the order of the report and of the start."""


def list_parts(rigs: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return the parts of a demo of some rigs, in the order of the report, with what each needs.

    Examples
    --------
    >>> list_parts(["dome", "flash"])["face"]
    ('flash', 'dome', 'person')
    """
    asked = tuple(rig for rig in RIGS if rig in rigs)
    needs: dict[str, tuple[str, ...]] = dict.fromkeys(asked, ())
    if "dome" in asked:
        needs[PHOTOGRAPHS_PART] = ("dome",)
    if {"flash", "dome"} <= set(asked):  # maps of one person that can be fused
        person = (*asked, HEAD_PART)
        needs |= {HEAD_PART: ("dome",), PERSON_PART: person, FACE_PART: (*asked, PERSON_PART)}
    return {part: needs[part] for part in RUN_BY_PART if part in needs}
