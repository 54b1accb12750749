"""skinrig from Python: each function does what its command does, and notebooks display it."""

import html
import json
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from inspect import signature

import numpy as np
import pytest

import skinrig
from capture.session import Session
from skinrig.errors import UnusableError, UsageError
from skinrig.python_api.functions import FIT_KINDS
from skinrig.python_api.progress import show_progress
from skinrig.reporting.folders import ReportError

# imported by the tests: all processes read this file
pytestmark = pytest.mark.skipif(
    not all(map(find_spec, ("xarray", "tqdm"))), reason="no xarray or tqdm"
)


def render_dome(lights=9, size=24, seed=3):
    """Return images of a matte hemisphere under distant lights, and its normals."""
    import xarray

    random = np.random.default_rng(seed)
    y, x = np.mgrid[1 : -1 : size * 1j, -1 : 1 : size * 1j]
    inside = x**2 + y**2 < 0.8
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0.0))
    normals = np.stack([x, y, z], axis=-1)
    angle = 2 * np.pi * np.arange(lights) / lights
    slope = 0.5 + 0.15 * random.standard_normal(lights)
    toward = np.stack([slope * np.cos(angle), slope * np.sin(angle), np.ones(lights)], axis=1)
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    values = 0.4 * np.maximum(np.einsum("yxc,lc->lyx", normals, toward), 0.0) * inside
    places = {f"direction_{axis}": ("light", toward[:, n]) for n, axis in enumerate("xyz")}
    return xarray.DataArray(values, dims=("light", "y", "x"), coords=places), normals, inside


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """A session of an array of images, with its true normals and mask."""
    images, normals, inside = render_dome()
    folder = tmp_path_factory.mktemp("stack")
    session = skinrig.load_session(
        images, folder / "session", subject="statue", consent=["research"]
    )
    return session, normals, inside


def displayed(result):
    """Return the document that a notebook shows."""
    return html.unescape(result._repr_html_().split('srcdoc="')[1].rsplit('"', 1)[0])


def test_array_of_images_reconstructs_normals(stack, tmp_path):
    session, normals, inside = stack
    maps = skinrig.reconstruct(session, "normals,albedo", tmp_path / "maps", progress=False)
    found = maps.to_xarray()
    assert found.normals.dims == ("y", "x", "channel")
    assert found.normals.attrs["units"] == "1"
    good = found.normals_valid.values & inside
    cosine = np.clip((found.normals.values * normals).sum(axis=-1)[good], -1, 1)
    assert good.sum() > 0.8 * inside.sum()
    assert np.degrees(np.arccos(cosine)).mean() < 1.0
    flipped = np.clip((found.normals.values * normals * [1, -1, 1]).sum(axis=-1)[good], -1, 1)
    assert np.degrees(np.arccos(flipped)).mean() > 20.0
    assert np.isnan(found.normals.values[~found.normals_valid.values]).all()
    shown = displayed(maps)
    assert "data:image" in shown
    assert "surface normals" in shown


def test_session_frames_equal_given_images(stack):
    session, _, _ = stack
    images, _, _ = render_dome()
    frames = session.to_xarray()
    assert frames.sizes["light"] == 9
    assert frames.taken.all()
    codes = frames.image.values.reshape(9, *frames.image.shape[-2:]).astype(float)
    scale = codes.max() / images.values.max()
    rows = codes if codes.shape[1:] == images.shape[1:] else codes[:, ::2, ::2]
    assert np.abs(rows / scale - images.values).max() < 2e-4
    assert "frames" in displayed(session)


def test_diagnosis_of_swapped_lights_displayed(tmp_path):
    images, _, _ = render_dome(lights=12, size=48)
    swapped = images.assign_coords(
        {
            name: ("light", images[name].values[[0, 1, 8, *range(3, 8), 2, *range(9, 12)]])
            for name in ("direction_x", "direction_y", "direction_z")
        }
    )
    found = skinrig.diagnose(skinrig.load_session(swapped, tmp_path / "swapped"))
    assert {3, 9} <= {number + 1 for one in found.found.findings for number in one.frames}
    assert found.found.findings[0].remedy in displayed(found)
    sound = skinrig.diagnose(skinrig.load_session(images, tmp_path / "sound"))
    assert "No fault" in displayed(sound)


def test_export_and_report_refer_files(stack, tmp_path):
    session, _, _ = stack
    maps = skinrig.reconstruct(session, ["albedo"], tmp_path / "maps", progress=False)
    page = skinrig.report(maps, tmp_path / "report.html")
    assert page.path.stat().st_size > 10_000
    assert "<html" in displayed(page)
    sent = skinrig.export(session, "zarr", tmp_path / "sent", use="research")
    assert (sent.path / "session.zarr" / "zarr.json").is_file()
    assert "files" in displayed(sent)


@pytest.mark.long
def test_plan_writes_file_with_forecast(tmp_path):
    chosen = skinrig.plan("probe", "sigma_tr<=6%", out=tmp_path / "plan.json")
    assert json.loads(chosen.path.read_text())["rig"] == "probe"
    assert "sigma_tr" in displayed(chosen)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: one.rename(light="lamp"), "without light"),
        (lambda one: one.drop_vars("direction_y"), "without direction_y"),
        (lambda one: one - 1.0, "minimum -1"),
        (lambda one: one.where(one < one.max(), np.inf), "infinite values, expected finite"),
    ],
)
def test_unusable_array_is_refused(tmp_path, change, message):
    images, _, _ = render_dome()
    with pytest.raises(UsageError, match=message):
        skinrig.load_session(change(images), tmp_path / "session")
    assert not (tmp_path / "session").exists()


@pytest.mark.parametrize(
    ("subject", "consent", "scopes"),
    [
        ("none", None, ("any",)),
        ("P042", None, ()),
        ("P042", "research,teaching", ("research", "teaching")),
        ("P042", ["research"], ("research",)),
    ],
)
def test_consent_of_array_is_recorded(tmp_path, subject, consent, scopes):
    images, _, _ = render_dome()
    written = skinrig.load_session(images, tmp_path / "s", subject=subject, consent=consent)
    assert Session.open(written.path).subject.consent_scope == scopes


@pytest.mark.parametrize(
    ("function", "command"),
    [
        ("reconstruct", "reconstructing.reconstruct"),
        ("calibrate", "reconstructing.calibrate"),
        ("report", "showing.report"),
    ],
)
def test_function_has_options_of_its_command(function, command):
    module, name = command.split(".")
    asked = signature(getattr(import_module(f"skinrig.commands.{module}"), name)).parameters
    given = signature(getattr(skinrig, function)).parameters
    # of the command line alone: several sessions, on an executor, or only the names of their maps
    assert set(asked) - set(given) <= {"json", "sessions", "executor", "list_maps"}


def test_options_reach_the_work(stack, tmp_path):
    with pytest.raises(ValueError, match="rank"):
        skinrig.reconstruct(stack[0], "normals", tmp_path / "maps", progress=False, rank=5)
    maps = skinrig.reconstruct(stack[0], "normals", tmp_path / "maps", progress=False)
    with pytest.raises(ReportError, match="compare"):
        skinrig.report(maps, tmp_path / "page.html", compare=True)


def test_missing_or_superfluous_folder_is_refused(stack, tmp_path):
    images, _, _ = render_dome()
    with pytest.raises(UsageError, match="out: got none"):
        skinrig.load_session(images)
    with pytest.raises(UsageError, match="remove it"):
        skinrig.load_session(stack[0], tmp_path / "other")
    with pytest.raises(UnusableError, match="kind: got 'hair'"):
        skinrig.fit("hair", tmp_path, tmp_path / "model")


def test_progress_bar_follows_lines(capsys):
    with show_progress("simulate", wanted=True) as report:
        report("1/4 S000 subject")
        report("3/4 S002 subject")
    assert "3/4" in capsys.readouterr().err
    with show_progress("simulate", wanted=False) as nothing:
        assert nothing is None


def test_import_loads_no_numerical_library():
    code = "import sys, skinrig; print([m for m in ('numpy', 'numba', 'cv2') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("kind", FIT_KINDS)
def test_every_fit_kind_has_a_function(kind, tmp_path):
    with pytest.raises((ValueError, OSError, TypeError)) as found:
        skinrig.fit(kind, tmp_path / "missing", tmp_path / "model")
    assert found.type is not TypeError or "labels" in str(found.value)  # traits need a table


@pytest.mark.long
def test_view_writes_page_of_head(tmp_path):
    page = skinrig.view(out=tmp_path / "page.html", size=64)
    assert page.path.stat().st_size > 100_000
    assert "<html" in displayed(page)
