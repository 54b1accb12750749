import importlib.util
import json
import types

import pytest

from rigsim.mitsuba import variant
from rigsim.world.serve import serve_world
from skinrig import doctor
from skinrig.cli import main


@pytest.fixture
def with_harvesters(monkeypatch):
    find = importlib.util.find_spec
    here = types.SimpleNamespace()
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: here if name == "harvesters" else find(name)
    )


def producers():
    return [
        finding
        for finding in doctor.check_installation(probe_renderer=False)
        if finding.what == "GenTL producers"
    ]


def test_producers_of_industrial_cameras_are_reported(with_harvesters, tmp_path, monkeypatch):
    (tmp_path / "maker.cti").touch()
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(tmp_path))
    (finding,) = producers()
    assert (finding.state, finding.fix) == ("maker.cti", "")


def test_missing_producers_report_variable_to_set(with_harvesters, monkeypatch):
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    (finding,) = producers()
    assert finding.state == "none"
    assert "GENICAM_GENTL64_PATH" in finding.fix


@pytest.mark.parametrize(("asked", "renderer"), [("scalar", "fast"), ("", "mitsuba")])
def test_renderer_of_sessions_is_reported(asked, renderer, monkeypatch):
    monkeypatch.setenv("SKINRIG_MITSUBA", asked)
    if asked == "" and not variant.choose_variant().is_vectorized:
        pytest.skip("no LLVM library of version 17 or newer")
    (finding,) = [one for one in doctor.check_installation() if one.what == "Mitsuba variant"]
    assert finding.state.endswith(f"renderer of sessions: {renderer}")
    assert ("apt-get install" in finding.fix) == (renderer == "fast")


@pytest.mark.long
def test_port_is_judged_instead_of_installation(capsys):
    with serve_world("flash", pty=True) as served:
        status = main(["doctor", "--port", served.addresses["flash"], "--json"])
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert status == 0
    assert {finding["what"] for finding in findings} >= {"identity", "clock", "lease", "refusals"}
    assert all(finding["fine"] for finding in findings)
