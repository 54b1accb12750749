"""Stokes images of the gradient sphere: values by the pictures, names by the published layout."""

import json
import re
from datetime import date

import numpy as np
import OpenEXR
import pytest

from capture import raw
from capture.plan.gradient import gradient_plan
from capture.rig import load_rig
from capture.session import ConsentError, Session, SubjectRecord
from skinrig.cli import main
from skinrig.exporting.export import export
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sessions.spectral import format_file_stem

RIG = load_rig("gradient").resized(16)
DAY = date(2030, 1, 1)
BLACK, WHITE = 64, 4095


def light(step, shape):
    """Return what a picture shows of full scale: diffuse light, and a gloss the films cross out."""
    rows = np.arange(shape[0])[:, None] / shape[0]
    pattern = {"x": 0.5, "dark": 0.0}.get(str(step.index["pattern"]), 1.0)
    gloss = 0.3 * rows if step.index["polarizer"] == "parallel" else 0.0
    return pattern * (np.full(shape, 0.2) + gloss)


def made(tmp_path, patterns=("full", "x"), only=("parallel", "crossed")):
    plan = gradient_plan(RIG, angles=[0.0], steps=(0, 1), patterns=patterns, darks=1)
    view = RIG.views[0]
    shape = (view.height_px, view.width_px)
    with Session.create(
        tmp_path / "s",
        plan=plan,
        rig=RIG,
        devices={},
        source="measured",
        subject=SubjectRecord("P042", ("research",), DAY),
    ) as session:
        for step, camera in session.pending_frames():
            lit = step.kind == "gradient" and step.index["polarizer"] in only
            shown = light(step, shape) if lit else np.zeros(shape)
            codes = np.rint(BLACK + (WHITE - BLACK) * shown + 5.0).astype(np.uint16)  # 5 of dark
            blob = raw.encode_dng(
                codes,
                pattern="MONO",
                black=BLACK,
                white=WHITE,
                noise_profile=(1e-4, 1e-6),
                step_id=step.id,
                session_id=session.id,
            )
            session.commit(
                step.id, camera, blob, settings=step.settings, t_host_s=1.0, actual={}, attempt=1
            )
        session.close()
    return tmp_path / "s"


def read(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header()), {n: c.pixels.copy() for n, c in file.channels().items()}


def test_both_polarizations_are_recovered_from_s0_and_s1(tmp_path):
    session = made(tmp_path)
    export(session, tmp_path / "out", to="stokes", use="research", today=DAY)
    told = json.loads((tmp_path / "out/stokes.json").read_text())
    assert len(told["files"]) == 4  # two states, two patterns
    for step in Session.open(session).plan.steps:
        if step.kind != "gradient" or step.index["polarizer"] != "parallel":
            continue
        state = f"a000_{'n0' if step.index['caliper'] == 0 else 'p1'}"
        header, found = read(
            tmp_path / f"out/{format_file_stem(state, str(step.index['pattern']))}.exr"
        )
        s0, s1 = found["S0.535nm"], found["S1.535nm"]
        code = 1.0 / (WHITE - BLACK)
        np.testing.assert_allclose((s0 + s1) / 2, light(step, s0.shape), atol=0.51 * code)
        crossed = light(step, s0.shape).min()  # row 0 has no gloss
        np.testing.assert_allclose((s0 - s1) / 2, crossed, atol=0.51 * code)
        assert np.ptp(s1) > 0.1 * np.ptp(light(step, s0.shape)) > 0.0
        assert (header["spectralLayoutVersion"], header["emissiveUnits"]) == ("1.0", "1")


def test_channels_are_named_as_in_published_layout(tmp_path):
    fichet = pytest.importorskip("colour.io.fichet2021")
    export(made(tmp_path), tmp_path / "out", to="stokes", use="research", today=DAY)
    _, found = read(tmp_path / "out/stokes_a000_n0_full.exr")
    assert sorted(found) == ["S0.535nm", "S1.535nm"]
    for name in found:
        kind, dot, band = name.partition(".")
        assert re.match(rf"^{fichet.PATTERN_FICHET2021}$", band), (kind, dot)


def test_document_reports_axis_and_unmeasured_components(tmp_path):
    done = export(
        made(tmp_path, patterns=("full", "dark")),
        tmp_path / "out",
        to="stokes",
        use="research",
        today=DAY,
        delivery=ExportSettings(only=("a000_n0",), with_errors=True),
    )
    told = json.loads((tmp_path / "out/stokes.json").read_text())
    assert told["reference_axis_deg"] == RIG.views[0].analyzer_axis_deg == 90.0
    assert "S1 is -1 of" in told["image_frame"]
    assert "S2 and S3 were not measured" in told["what"]
    assert told["consent"][0]["pseudonym"] == "P042"
    (entry,) = told["files"].values()
    gloss = np.mean(0.3 * np.arange(RIG.views[0].height_px) / RIG.views[0].height_px)
    assert entry["degree_of_polarization"] == pytest.approx(gloss / (0.4 + gloss), abs=2e-3)
    assert (tmp_path / "out/stokes_a000_n0_full.stderr.exr").is_file()
    assert (tmp_path / "out/stokes_a000_n0.valid.exr").is_file()
    assert done.left_out == ()


def test_use_beyond_consent_and_other_inputs_are_refused(tmp_path, capsys):
    session = made(tmp_path)
    with pytest.raises(ConsentError, match="has not agreed"):
        export(session, tmp_path / "out", to="stokes", use="film", today=DAY)
    with pytest.raises(ExportError, match="got 'a090_p3', expected one of a000_n0, a000_p1"):
        export(
            session,
            tmp_path / "out",
            to="stokes",
            use="research",
            today=DAY,
            delivery=ExportSettings(only=("a090_p3",)),
        )
    assert not (tmp_path / "out").exists()
    argv = ["export", str(session), "--to", "stokes", "--out", str(tmp_path / "out")]
    assert main(argv) == 2
    assert "--use: got none" in capsys.readouterr().err
    assert main([*argv, "--use", "research", "--only", "a000_n0"]) == 0
    assert "next: read stokes.json" in capsys.readouterr().out


def test_session_of_other_rig_is_redirected(tmp_path):
    from capture.plan import flash_plan

    rig = load_rig("flash").resized(16)
    with Session.create(
        tmp_path / "f",
        plan=flash_plan(rig, darks=1),
        rig=rig,
        devices={},
        subject=SubjectRecord("P042", ("research",), DAY),
        source="measured",
    ) as session:
        view = rig.views[0]
        for step, camera in session.pending_frames():
            blob = raw.encode_dng(
                np.full((view.height_px, view.width_px), 600, np.uint16),
                pattern="RGGB",
                black=512,
                white=16383,
                step_id=step.id,
                session_id=session.id,
            )
            session.commit(
                step.id, camera, blob, settings=step.settings, t_host_s=1.0, actual={}, attempt=1
            )
        session.close()
    with pytest.raises(ExportError, match="--to spectral"):
        export(tmp_path / "f", tmp_path / "out", to="stokes", use="research", today=DAY)
