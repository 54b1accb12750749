"""Record of stages run, reused or skipped; a repeated run has no cost."""

import json

import numpy as np
import pytest

from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.graph import PipelineStage
from reconstruction.pipeline.inputs import InputsError


def graph(gain=2.0):
    return [
        PipelineStage("frames", (), ("light",), lambda: {"light": np.ones(3)}),
        PipelineStage(
            "separate",
            ("light",),
            ("diffuse",),
            lambda light: {"diffuse": gain * light},
            {"gain": gain},
        ),
        PipelineStage(
            "invert", ("diffuse",), ("melanin",), lambda diffuse: {"melanin": diffuse.sum()}
        ),
        PipelineStage("draw", ("diffuse",), ("image",), lambda diffuse: {"image": diffuse}),
    ]


def done(entries):
    return {entry["stage"]: entry["done"] for entry in entries}


def why(entries):
    return {entry["stage"]: entry["why"] for entry in entries}


def test_stage_unneeded_by_request_is_skipped():
    outcome = stages.run_stages(graph(), ["melanin"])
    entries = stages.record_run(graph(), outcome, {})
    assert done(entries) == {"frames": "run", "separate": "run", "invert": "run", "draw": "skipped"}
    assert why(entries)["draw"] == "no wanted product depends on it"
    assert why(entries)["invert"] == "it was not made before"
    assert [len(entry["inputs"]) for entry in entries] == [64, 64, 64, 0]


def test_repeated_run_is_reused_and_inputs_skipped():
    cache = {}
    first = stages.run_stages(graph(), ["melanin"], cache=cache)
    cache = {key: made for key, made in cache.items() if "melanin" in made}
    again = stages.run_stages(graph(), ["melanin"], cache=cache)
    entries = stages.record_run(graph(), again, first.keys)
    assert done(entries) == {
        "frames": "skipped",
        "separate": "skipped",
        "invert": "reused",
        "draw": "skipped",
    }
    assert why(entries)["frames"] == "the stages that depend on it were reused"
    assert why(entries)["invert"] == "its inputs are the same"


def test_changed_setting_reruns_dependents_and_reports_reason():
    cache = {}
    first = stages.run_stages(graph(), ["melanin"], cache=cache)
    again = stages.run_stages(graph(gain=3.0), ["melanin"], cache=cache)
    entries = stages.record_run(graph(gain=3.0), again, first.keys)
    assert done(entries)["separate"] == done(entries)["invert"] == "run"
    assert why(entries)["invert"] == "its inputs have changed"
    assert done(entries)["frames"] == "reused"


@pytest.mark.long
@pytest.mark.render
def test_repeated_request_reads_no_frame_and_writes_nothing(tmp_path, monkeypatch):
    from capture.session import Session
    from model import store
    from reconstruction.pipeline import recipes as pipeline
    from skinrig.simulating.simulation import simulate_session

    plain = ("lateral", "interreflections", "spectral", "optics", "relief_shadows")
    session = simulate_session(
        "flash", tmp_path / "session-flash", width_px=64, leave_out=plain
    ).session
    out = tmp_path / "appearance"

    def work_of(outcome):
        written = store.read(out).parameters["work"]
        return outcome, {entry["stage"]: entry["done"] for entry in written}

    first, written = work_of(pipeline.reconstruct(session, want=["melanin"], out=out))
    assert written == done(first.work)
    assert written["chromophores"] == "run"
    assert written["tsumura"] == "skipped"

    def standing():
        return {
            path.name: (path.stat().st_mtime_ns, path.stat().st_ino, path.read_bytes())
            for path in [*out.iterdir()]
        } | {".": out.stat().st_mtime_ns}

    before = standing()
    with monkeypatch.context() as patch:
        patch.setattr(Session, "read", lambda *_: pytest.fail("a frame was read"))
        again = pipeline.reconstruct(session, want=["melanin"], out=out)
    assert standing() == before
    assert again.ran == ()
    assert done(again.work)["chromophores"] == "reused"
    assert set(done(again.work).values()) == {"reused", "skipped"}
    assert json.dumps(again.work)

    _, more = work_of(pipeline.reconstruct(session, want=["tsumura_melanin"], out=out))
    assert more["tsumura"] == "run"
    assert standing() != before
    assert "melanin" in store.read(out).maps

    # a folder that lost a map, or holds another than was written, is neither used nor replaced
    (out / "melanin.exr").write_bytes(b"x" + (out / "melanin.exr").read_bytes()[1:])
    damaged = standing()
    with pytest.raises(InputsError, match=r"melanin\.exr: was changed .*remove .*to recompute"):
        pipeline.reconstruct(session, want=["melanin"], out=out)
    assert standing() == damaged
    (out / "melanin.exr").unlink()
    with pytest.raises(InputsError, match=r"melanin\.exr: is missing.*remove"):
        pipeline.reconstruct(session, want=["melanin"], out=out)
