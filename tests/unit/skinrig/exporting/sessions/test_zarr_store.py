"""Sessions as Zarr: xarray reads each frame unchanged, and finds missing frames without data."""

import json
import tracemalloc
from importlib.util import find_spec

import numpy as np
import pytest

from capture import raw
from capture.plan import Plan, Step, flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from skinrig.cli import main
from skinrig.exporting.export import export
from skinrig.exporting.options import ExportError

# imported by the tests: all processes read this file
pytestmark = pytest.mark.skipif(
    not all(map(find_spec, ("xarray", "zarr"))), reason="no xarray or zarr"
)

FLASH = load_rig("flash").resized(16)
DOME = load_rig("dome").resized(20)


def write_session(
    folder, rig, plan, *, white=16383, left_out=(), omitted=(), attempts=1, shape=(10, 16)
):
    """Write a session with frames of seeded noise; return its folder."""
    random = np.random.default_rng(7)
    with Session.create(
        folder,
        plan=plan,
        rig=rig,
        devices={},
        subject=SubjectRecord("P042", ("research",), None),
        source="measured",
    ) as made:
        if omitted:
            made.omit_steps(omitted, reason="light failed", t_host_s=99.0)
        for step, camera in made.pending_frames():
            if step.id in left_out:
                continue
            for attempt in range(1, attempts + 1):
                cfa = random.integers(0, min(white, 65534), shape, np.uint16, endpoint=True)
                blob = raw.encode_dng(
                    cfa,
                    pattern="MONO" if len(plan.steps[0].cameras) > 1 else "RGGB",
                    black=512,
                    white=white,
                    step_id=step.id,
                    session_id=made.id,
                )
                made.commit(
                    *(step.id, camera, blob),
                    settings=step.settings,
                    t_host_s=100.0,
                    actual={"light": "flash", "open_s": 0.25},
                    attempt=attempt,
                )
        made.attach("notes.txt", b"a note", about={})
        made.close(missing_reason="stopped" if left_out else "")
    return folder


def plan_dome(lights=3, exposures=2):
    """Return a plan of one light at a time, in two exposures, and a dark frame."""
    cameras = tuple(view.name for view in DOME.views)[:2]
    steps = [
        Step(
            f"O{light}{exposure}",
            "olat",
            {"light": f"L{light:03}", "exposure": exposure},
            {"exposure_s": 0.01 * 4**exposure},
            cameras,
        )
        for light in range(lights)
        for exposure in range(exposures)
    ]
    dark = Step("D0", "dark", {"repeat": 0, "exposure": 0}, {"exposure_s": 0.01}, cameras)
    return Plan(DOME.name, (*steps, dark), {})


def open_group(out, kind, **more):
    """Open a group of an export, frames that were not taken as NaN."""
    import xarray

    return xarray.open_zarr(
        out / "session.zarr", group=kind, consolidated=False, chunks=None, **more
    )


def test_export_zarr_each_frame_unchanged(tmp_path):
    source = write_session(tmp_path / "s", DOME, plan_dome(), left_out=("O11",), attempts=2)
    done = export(source, tmp_path / "out", "zarr", use="research")
    assert ("notes.txt", done.left_out[0][1]) in done.left_out
    found, session = (
        open_group(tmp_path / "out", "olat", mask_and_scale=False),
        Session.open(source),
    )
    assert found.image.dims == ("exposure", "light", "camera", "y", "x")
    assert found.image.dtype == np.uint16
    for record in session.frames("olat"):
        where = {**record.index, "camera": record.camera}
        assert (found.image.sel(where).values == session.read(record).cfa).all()
        assert found.taken.sel(where)
        assert found.attempt.sel(where) == 2
        assert found.set_exposure_s.sel(where) == record.settings["exposure_s"]
        assert found.step_id.sel(where) == record.step_id
    assert found.set_exposure_s.attrs["units"] == found.actual_open_s.attrs["units"] == "s"
    missing = {"light": "L001", "exposure": 1}
    assert not found.taken.sel(missing).any()
    assert found.planned.sel(missing).all()
    assert found.taken.sum() == len(session.frames("olat")) == 10
    assert open_group(tmp_path / "out", "dark").sizes["repeat"] == 1


def test_missing_frame_opened_is_nan(tmp_path):
    source = write_session(tmp_path / "s", DOME, plan_dome(), left_out=("O11",))
    export(source, tmp_path / "out", "zarr", use="research")
    found = open_group(tmp_path / "out", "olat")
    assert np.isnan(found.image).any(("y", "x")).equals(~found.taken)
    assert np.isnan(found.image.sel(light="L001", exposure=1)).all()


def test_white_level_at_limit_is_wide(tmp_path):
    source = write_session(tmp_path / "s", FLASH, flash_plan(FLASH, darks=2), white=65535)
    export(source, tmp_path / "out", "zarr", use="research")
    found = open_group(tmp_path / "out", "dark", mask_and_scale=False)
    assert found.image.dtype == np.int32
    assert found.image.attrs["_FillValue"] == -1
    assert found.image.attrs["color_filter_array"] == "RGGB"
    assert found.white_level.values.tolist() == [[65535.0], [65535.0]]
    assert found.black_level.sizes["cell"] == 4


def test_sparse_kind_has_one_dimension(tmp_path):
    cameras = tuple(view.name for view in DOME.views)[:1]
    steps = [
        Step(f"T{n}", "tracking", {"after": n, "pass": n}, {"exposure_s": 0.01}, cameras)
        for n in range(5)
    ]
    plan = Plan(DOME.name, tuple(steps), {})
    source = write_session(tmp_path / "s", DOME, plan)
    export(source, tmp_path / "out", "zarr", use="research")
    found = open_group(tmp_path / "out", "tracking")
    assert found.image.dims == ("step", "camera", "y", "x")
    assert found.after.values.tolist() == [0, 1, 2, 3, 4]
    assert found.after.dims == ("step",)


def test_frame_with_fill_value_is_refused(tmp_path, monkeypatch):
    source = write_session(tmp_path / "s", FLASH, flash_plan(FLASH, darks=2))
    read = Session.read

    def hot(self, record):
        frame = read(self, record)
        cfa = frame.cfa.copy()
        cfa[0, 0] = 65535
        return raw.RawFrame(cfa=cfa, pattern=frame.pattern, black=frame.black, white=frame.white)

    monkeypatch.setattr(Session, "read", hot)
    with pytest.raises(ExportError, match="got the value 65535"):
        export(source, tmp_path / "out", "zarr", use="research")
    assert not (tmp_path / "out").exists()


def test_omitted_steps_grouped_by_reason(tmp_path):
    source = write_session(tmp_path / "s", DOME, plan_dome(), omitted=("O00", "O21"))
    done = export(source, tmp_path / "out", "zarr", use="research")
    assert done.left_out[1:] == (("2 steps from O00 on", "light failed"),)
    found = open_group(tmp_path / "out", "olat")
    assert found.planned.all()
    assert found.taken.sum() == 2 * 4


def test_export_memory_independent_of_frames(tmp_path):
    peaks = []
    for index, lights in enumerate((2, 2, 6)):
        source = write_session(tmp_path / f"s{index}", DOME, plan_dome(lights), shape=(500, 400))
        if index:  # the first loads libraries
            tracemalloc.start()
        export(source, tmp_path / f"out{index}", "zarr", use="research")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # of 16 more frames, at most eight in memory: Zarr's thread writes one while others wait
    assert peaks[2] < peaks[1] + 8 * 500 * 400 * 2


def test_command_prints_how_to_open(tmp_path, capsys):
    source = write_session(tmp_path / "s", FLASH, flash_plan(FLASH, darks=2))
    arguments = ["export", source, "--to", "zarr", "--out", tmp_path / "out", "--use", "research"]
    assert main([str(part) for part in [*arguments, "--json"]]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["to"] == "zarr"
    assert "open_zarr" in document["next"]
