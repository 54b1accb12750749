"""The dome's stages on photographs of an ellipsoid, which is written out here.

An ellipsoid has its normals in closed form. Its photographs are drawn pixel by pixel from the
reflection equation, with shot and read noise, and read from a session as any others.
"""

import dataclasses
import io
from datetime import UTC, date, datetime
from functools import cache

import numpy as np
import pytest
import trimesh

from capture import raw
from capture.calibration import geometry
from capture.calibration import store as calibration_store
from capture.calibration.geometry import CameraPose
from capture.calibration.lights import LightTable
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from model import store
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.graph import StageError
from reconstruction.pipeline.hold_out import HoldOutError
from reconstruction.pipeline.inputs import DomeOptions, InputsError
from skinrig.simulating.dome import small_dome

AXES_MM = np.array([58.0, 85.0, 66.0])
CENTER_MM = np.array([0.0, 5.0, -16.0])
R_D = np.array([0.5, 0.35, 0.25])
ETA = 1.4
SHINE, WIDTH_RAD = 0.25, 0.3
"""Greatest surface reflection, 1/sr, and how far from the mirror direction it has fallen to 1/e."""
SPAN = 4095 - 168
TODAY = date(2026, 11, 21)
WANT = ("half_vector_normals", "normals", "r_d", "samples")


def turn(degrees):
    """A rotation about an axis that is none of the frame's."""
    angle = np.radians(degrees)
    x, y, z = np.array([0.6, 0.64, 0.48])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


SCAN_TURN, SCAN_SHIFT_MM = turn(2.0), np.array([2.0, -3.0, 1.5])
"""Take the scan to where the ellipsoid is."""


@dataclasses.dataclass(frozen=True)
class Shoot:
    """How the ellipsoid is photographed."""

    lights: int = 40
    views: int = 4
    width_px: int = 200
    exposure_s: float = 0.02
    reflectance: tuple[float, ...] = tuple(R_D)
    shine: float = SHINE
    dead: tuple[int, ...] = ()
    """Lights that give none, by their places in the rig."""
    dead_known: bool = True
    """Whether the calibration found the dead ones."""
    inside: bool = False
    """Whether the calibration puts the first camera into the subject."""
    swapped: tuple[int, int] | None = None
    moved_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the subject in the second half of the images."""
    places: str = "all around"
    scan: bool = True


def dome(shoot):
    """Return the rig and what its lights give, in full scales per second times mm^2."""
    rig = small_dome(load_rig("dome"), views=shoot.views, width_px=shoot.width_px)
    if shoot.places == "behind":
        names = [light.name for light in rig.lights if light.position_mm[2] < -350.0]
        rig = rig.subset(lights=names[: shoot.lights])
    elif shoot.places == "in a plane":
        by_height = sorted(rig.lights, key=lambda light: abs(light.position_mm[1]))
        names = {light.name for light in by_height if light.position_mm[2] > -200.0}
        order = [light.name for light in by_height if light.name in names]
        rig = rig.subset(lights=order[: shoot.lights])
        flat = tuple(
            dataclasses.replace(
                light, position_mm=(light.position_mm[0], 0.0, light.position_mm[2])
            )
            for light in rig.lights
        )
        rig = dataclasses.replace(rig, lights=flat)
    else:
        rig = small_dome(rig, lights=shoot.lights)
    rng = np.random.default_rng(17)
    strength = 700.0**2 * np.exp(0.05 * rng.standard_normal((len(rig.lights), 1)))
    return rig, strength * np.array([30.0, 40.0, 35.0])


def entering(cosine):
    """Share that a smooth boundary lets through: Fresnel's equations for unpolarized light."""
    cosine = np.clip(cosine, 1e-6, 1.0)
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / ETA**2)
    s = (cosine - ETA * inside) / (cosine + ETA * inside)
    p = (ETA * cosine - inside) / (ETA * cosine + inside)
    return 1.0 - (s * s + p * p) / 2.0


@cache
def trace(view, center_mm):
    """Return which pixels show the ellipsoid, points, normals and ways of their rays."""
    center_mm = np.array(center_mm)
    right, up, back = (np.array(axis) for axis in view.axes)
    column, row = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
    x = (column - (view.width_px - 1) / 2) / view.focal_px
    y = (row - (view.height_px - 1) / 2) / view.focal_px
    way = x[..., None] * right - y[..., None] * up - back
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    start = (np.array(view.position_mm) - center_mm) / AXES_MM
    slope = way / AXES_MM
    a, b, c = np.sum(slope**2, -1), slope @ start, start @ start - 1.0
    root = b * b - a * c
    hit = root > 0
    along = (-b - np.sqrt(np.where(hit, root, 0.0))) / a
    point = np.array(view.position_mm) + along[..., None] * way
    normal = (point - center_mm) / AXES_MM**2
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return hit, point, normal, way


def photograph(view, light, intensity, shoot, center_mm):
    """Return fractions of full scale per second, (H, W, 3)."""
    hit, point, normal, way = trace(view, tuple(center_mm.tolist()))
    to_light = np.array(light.position_mm) - point
    distance = np.linalg.norm(to_light, axis=-1)
    to_light /= distance[..., None]
    cos_light = np.sum(normal * to_light, -1)
    cos_view = -np.sum(normal * way, -1)
    half = to_light - way
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    off = np.arccos(np.clip(np.sum(normal * half, -1), -1.0, 1.0))
    f = (entering(cos_light) * entering(cos_view))[..., None] * np.array(shoot.reflectance) / np.pi
    f = f + (shoot.shine * np.exp(-((off / WIDTH_RAD) ** 2)))[..., None]
    lit = np.where(hit & (cos_light > 0), cos_light / distance**2, 0.0)
    return np.pi * f * intensity * lit[..., None]


def develop(signal, view, exposure_s, rng):
    """Return DN of the sensor behind its color filters."""
    mosaic = np.empty(signal.shape[:2])
    for cell, letter in enumerate(view.cfa):
        part = slice(cell // 2, None, 2), slice(cell % 2, None, 2)
        mosaic[part] = signal[..., "RGB".index(letter)][part]
    electrons = rng.poisson(np.clip(mosaic * exposure_s, 0, 10) * view.full_well_e)
    dn = (electrons + rng.normal(0, view.read_noise_e, mosaic.shape)) / view.gain_e_per_dn
    return np.clip(np.rint(view.black_level + dn), 0, view.white_level).astype(np.uint16)


def scanned():
    """Return the half of the ellipsoid that the dome sees, in the scanner's frame, as PLY."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    kept = (ball.vertices[:, 2] > -0.2)[ball.faces].all(axis=1)
    used, faces = np.unique(ball.faces[kept], return_inverse=True)
    place = ball.vertices[used] * AXES_MM + CENTER_MM
    place = (place - SCAN_SHIFT_MM) @ SCAN_TURN
    return trimesh.Trimesh(place, faces.reshape(-1, 3), process=False).export(file_type="ply")


def capture(folder, shoot):
    """Write session and calibrations; return their folders."""
    rig, intensity = dome(shoot)
    rng = np.random.default_rng(23)
    names = tuple(view.name for view in rig.views)
    steps = tuple(
        Step(
            f"O{k}",
            "olat",
            {"light": light.name, "exposure": 0, "pass": 0},
            {"light": light.name, "exposure_s": shoot.exposure_s, "level": 1.0},
            names,
        )
        for k, light in enumerate(rig.lights)
    )
    answering = list(range(len(rig.lights)))
    if shoot.swapped is not None:
        a, b = shoot.swapped
        answering[a], answering[b] = b, a
    path = folder / "session-ellipsoid"
    with Session.create(
        path,
        plan=Plan("dome", steps),
        rig=rig,
        devices={},
        subject=SubjectRecord("ellipsoid", ("research",)),
        source="simulated",
        seed=0,
        now=lambda: datetime(2026, 11, 21, tzinfo=UTC),
    ) as session:
        if shoot.scan:
            session.attach("scan.ply", scanned(), about={"kind": "scanned mesh", "unit": "mm"})
        for k, step in enumerate(steps):
            at = answering[k]
            gone = at in shoot.dead
            center = CENTER_MM + np.array(shoot.moved_mm) * (k >= len(steps) // 2)
            for view in rig.views:
                signal = photograph(view, rig.lights[at], (not gone) * intensity[at], shoot, center)
                profile = raw.noise_profile(
                    view.gain_e_per_dn,
                    view.read_noise_e,
                    black=view.black_level,
                    white=view.white_level,
                )
                blob = raw.encode_dng(
                    develop(signal, view, shoot.exposure_s, rng),
                    pattern=view.cfa,
                    black=view.black_level,
                    white=view.white_level,
                    exposure_s=shoot.exposure_s,
                    noise_profile=profile,
                    camera_serial=view.serial,
                    step_id=step.id,
                    session_id=session.id,
                )
                session.commit(
                    step.id,
                    view.name,
                    blob,
                    settings=step.settings,
                    actual={},
                    t_box_s=0.1 * k,
                    t_host_s=0.1 * k,
                )
        session.close()
    calibration = folder / "calibration"
    calibration.mkdir()
    cameras = {view.name: CameraPose.nominal(view) for view in rig.views}
    if shoot.inside:
        first = cameras[names[0]]
        cameras[names[0]] = dataclasses.replace(
            first, translation_mm=-first.rotation @ (CENTER_MM + np.array([5.0, 0.0, 10.0]))
        )
    table = LightTable(
        np.array([light.position_mm for light in rig.lights]),
        intensity,
        np.zeros(len(rig.lights)),
        tuple(light.name for light in rig.lights),
        valid=np.array(
            [not (shoot.dead_known and k in shoot.dead) for k in range(len(rig.lights))]
        ),
    )
    made = [
        geometry.to_calibration(cameras, rig=rig.name, source="simulated", created=TODAY),
        table.to_calibration(rig=rig.name, source="simulated", created=TODAY),
    ]
    for calibrated in made:
        calibration_store.save(calibrated, calibration)
    return path, calibration


@dataclasses.dataclass(frozen=True)
class Found:
    """Maps of the ellipsoid and how far off they are."""

    maps: store.SkinAppearance
    outcome: object
    normals_deg: np.ndarray
    r_d: np.ndarray
    """Relative error, three channels."""
    share: float
    """Of the texels that are valid."""


def reconstruct(folder, shoot, *, want=WANT, calibrated=True):
    session, calibration = capture(folder, shoot)
    outcome = pipeline.reconstruct(
        session,
        want=want,
        out=folder / "appearance",
        calibration=calibration if calibrated else None,
    )
    return judge(store.read(folder / "appearance"), outcome, np.maximum(shoot.reflectance, 1e-9))


def judge(maps, outcome, reflectance=R_D):
    for skin_map in maps.maps.values():
        assert np.isfinite(skin_map.values).all()
        assert skin_map.stderr is None or np.isfinite(skin_map.stderr).all()
    place = maps.maps["position"]
    truth = (place.values - CENTER_MM) / AXES_MM**2
    truth /= np.maximum(np.linalg.norm(truth, axis=-1, keepdims=True), 1e-9)
    normals = maps.maps["normals"]
    cosine = np.sum(truth * normals.values, axis=-1)[normals.valid]
    albedo = np.zeros((0, 3))
    if "r_d" in maps.maps:
        r_d = maps.maps["r_d"]
        albedo = r_d.values[r_d.valid] / reflectance - 1.0
    share = np.count_nonzero(normals.valid) / np.count_nonzero(place.valid)
    return Found(maps, outcome, np.degrees(np.arccos(np.clip(cosine, -1, 1))), albedo, share)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ellipsoid")
    return folder, reconstruct(folder, Shoot())


def registration_error(maps):
    """Return degrees and mm that the scan was laid beside its place, and its standard errors."""
    record = maps.parameters["registration"]
    rotation = np.array(record["rotation"])
    left = rotation @ SCAN_TURN.T
    degrees = np.degrees(np.arccos(np.clip((np.trace(left) - 1) / 2, -1, 1)))
    middle = (CENTER_MM - SCAN_SHIFT_MM) @ SCAN_TURN
    shift = rotation @ middle + record["translation_mm"] - CENTER_MM
    return degrees, np.linalg.norm(shift), record


@pytest.mark.long
def test_ellipsoid_normals_match_its_equation(found):
    """No relief and no errors of calibration: what is left is noise, pixels and highlights."""
    result = found[1]
    assert result.share > 0.5
    assert np.median(result.normals_deg) < 0.25
    assert result.normals_deg.mean() < 0.6
    # it can fail: highlights bend the estimate that follows the brightest samples
    other = {**result.maps.maps, "normals": result.maps.maps["half_vector_normals"]}
    half = judge(dataclasses.replace(result.maps, maps=other), None)
    assert np.median(half.normals_deg) > 4 * np.median(result.normals_deg)


@pytest.mark.long
def test_albedo_is_absolute_and_excludes_highlight(found):
    result = found[1]
    assert np.abs(np.median(result.r_d, axis=0)).max() < 0.01
    assert np.median(np.abs(result.r_d), axis=0).max() < 0.02


@pytest.mark.long
def test_scan_is_registered_to_ellipsoid(found):
    """Turned about itself an ellipsoid looks nearly the same: its place is what is known well."""
    degrees, off_mm, record = registration_error(found[1].maps)
    stderr = np.array(record["stderr_rad_mm"])
    assert degrees < 3 * np.degrees(np.linalg.norm(stderr[:3]))
    assert off_mm < 0.7
    # as it was given it is off by more
    away = CENTER_MM - (CENTER_MM - SCAN_SHIFT_MM) @ SCAN_TURN
    assert np.linalg.norm(away) > 3.0


@pytest.mark.long
def test_existing_results_are_not_recomputed(found):
    folder, first = found
    assert first.outcome.assumed == ()
    document = folder / "appearance" / store.DOCUMENT_FILE
    written = document.stat().st_mtime_ns
    again = pipeline.reconstruct(
        folder / "session-ellipsoid",
        want=WANT,
        out=folder / "appearance",
        calibration=folder / "calibration",
    )
    assert again.ran == ()
    assert document.stat().st_mtime_ns == written
    assert store.read(folder / "appearance").files.keys() == {"mesh.obj"}


@pytest.mark.long
def test_held_out_frames_are_not_read(found, monkeypatch):
    folder, first = found
    read = []
    plain = Session.read

    def reading(self, record):
        read.append((record.index["light"], record.camera))
        return plain(self, record)

    monkeypatch.setattr(Session, "read", reading)
    names = {light for light, _ in _frames(folder)}, {view for _, view in _frames(folder)}
    lights, view = sorted(names[0])[:3], sorted(names[1])[-1]
    outcome = pipeline.reconstruct(
        folder / "session-ellipsoid",
        want=("normals",),
        out=folder / "held-out",
        calibration=folder / "calibration",
        dome=DomeOptions(hold_out=f"lights={','.join(lights)},views={view}"),
    )
    assert read
    assert not {light for light, _ in read} & set(lights)
    assert view not in {camera for _, camera in read}
    maps = store.read(folder / "held-out")
    assert maps.parameters["held_out"] == {"lights": lights, "views": [view]}
    assert "surface" not in outcome.reused
    assert np.median(judge(maps, outcome).normals_deg) < 2 * np.median(first.normals_deg)
    assert first.maps.parameters["held_out"] == {"lights": [], "views": []}
    # without it they are
    read.clear()
    pipeline.reconstruct(
        folder / "session-ellipsoid",
        want=("samples",),
        out=folder / "held-out",
        calibration=folder / "calibration",
    )
    assert set(lights) <= {light for light, _ in read}
    assert store.read(folder / "held-out").parameters["held_out"] == {"lights": [], "views": []}


def _frames(folder):
    records = Session.open(folder / "session-ellipsoid").frames("olat")
    return {(record.index["light"], record.camera) for record in records}


@pytest.mark.long
@pytest.mark.parametrize(
    ("hold_out", "named"),
    [
        ("lights=" + ",".join(map(str, range(31))), "leaves 9 of 40 lights"),
        ("views=0,1,2", "leaves 1 of 4 views"),
        ("lights=L999", "L999"),
    ],
)
def test_excessive_or_unmatched_hold_out_is_refused(found, hold_out, named):
    folder, _ = found
    with pytest.raises(HoldOutError, match=named):
        pipeline.reconstruct(
            folder / "session-ellipsoid",
            want=("normals",),
            out=folder / "never",
            dome=DomeOptions(hold_out=hold_out),
        )
    assert not (folder / "never").exists()


@pytest.mark.long
def test_requested_number_of_lobes_is_made(found):
    folder, _ = found
    pipeline.reconstruct(
        folder / "session-ellipsoid",
        want=("basis_weight_1",),
        out=folder / "two-lobes",
        calibration=folder / "calibration",
        dome=DomeOptions(rank=2),
    )
    maps = store.read(folder / "two-lobes")
    assert {name for name in maps.maps if name.startswith("basis_weight")} == {
        "basis_weight_0",
        "basis_weight_1",
    }
    with np.load(io.BytesIO(maps.files["brdf_basis.npz"])) as stored:
        assert stored["table"].shape[-1] == 2
        assert stored["mix_by_rank"].shape == (stored["ranks"].sum(), len(stored["materials"]))
        at = int(np.searchsorted(stored["ranks"], 2))
        first = stored["ranks"][:at].sum()
        np.testing.assert_array_equal(stored["mix_by_rank"][first : first + 2], stored["mix"])
        assert stored["error_by_rank"][-1] < 0.5 * stored["error_by_rank"][0]


@pytest.mark.long
@pytest.mark.parametrize(
    ("rank", "want", "named"),
    [(2, "basis_weight_2", "basis_weight_1"), (0, "normals", "rank: got 0")],
)
def test_lobes_beyond_those_asked_for_are_refused(found, rank, want, named):
    folder, _ = found
    with pytest.raises(InputsError, match=named):
        pipeline.reconstruct(
            folder / "session-ellipsoid",
            want=(want,),
            out=folder / "never",
            dome=DomeOptions(rank=rank),
        )


@pytest.mark.long
def test_missing_tracking_frames_record_untracked_head(found):
    assert found[1].maps.parameters["motion"] == {"tracking_frames": 0}


@pytest.mark.long
def test_albedo_without_calibrated_lights_raises_instructive_error(found):
    folder, _ = found
    with pytest.raises(StageError, match="skinrig calibrate lights"):
        pipeline.reconstruct(folder / "session-ellipsoid", want=["r_d"], out=folder / "without")
    assert not (folder / "without").exists()


FEW = Shoot(lights=10, views=2, width_px=60)


@pytest.mark.parametrize(
    ("shoot", "says"),
    [
        (
            dataclasses.replace(FEW, scan=False),
            "got no scan, expected one; add it with `skinrig import mesh",
        ),
        (dataclasses.replace(FEW, lights=1), "lights: got 1 that can be used, expected at least"),
        (dataclasses.replace(FEW, dead=(4,)), "lights: got 9 that can be used"),
        (dataclasses.replace(FEW, views=1), "views: got images of 1, expected at least 2"),
        (dataclasses.replace(FEW, places="in a plane"), "in one line or plane"),
        (dataclasses.replace(FEW, places="behind"), "no usable light in front of the face"),
        (dataclasses.replace(FEW, exposure_s=20.0), r"saturated in every exposure"),
        (
            dataclasses.replace(FEW, reflectance=(0.0, 0.0, 0.0), shine=0.0),
            r"not found in the images.* 0\.0 % are brighter than their noise",
        ),
    ],
    ids=[
        "no scan",
        "one light",
        "one dead of the least",
        "one view",
        "lights in a plane",
        "lights behind",
        "all saturated",
        "black",
    ],
)
def test_unreconstructable_session_is_refused_with_reason(shoot, says, tmp_path):
    with pytest.raises(ValueError, match=says):
        reconstruct(tmp_path, shoot, want=["normals"])
    assert not (tmp_path / "appearance").exists()


@dataclasses.dataclass(frozen=True)
class Limits:
    """What maps of a spoiled capture must keep to."""

    normals_deg: float
    r_d: float
    """Of the median, relative."""
    share: float


@pytest.mark.long
@pytest.mark.parametrize(
    ("shoot", "limits"),
    [
        # as on the usual ellipsoid: one light among forty tells nothing that others do not
        (Shoot(dead=(3,)), Limits(0.25, 0.01, 0.45)),
        (Shoot(dead=(3,), dead_known=False), Limits(0.25, 0.01, 0.5)),
        (Shoot(swapped=(2, 9)), Limits(0.25, 0.01, 0.5)),
        (Shoot(inside=True), Limits(0.25, 0.01, 0.35)),
        # what is white is seen with the least noise; its albedo is 1
        (Shoot(reflectance=(1.0, 1.0, 1.0), shine=0.0), Limits(0.25, 0.01, 0.5)),
        # a few electrons a pixel: the minimum of noise is what eq. (6) is corrected for
        (Shoot(reflectance=(0.002,) * 3, shine=0.0), Limits(1.2, 0.05, 0.5)),
        # bright parts of the images are lost, not all
        (Shoot(exposure_s=0.06), Limits(0.5, 0.03, 0.3)),
    ],
    ids=[
        "dead light left out",
        "dead light unnoticed",
        "two lights swapped",
        "camera inside the subject",
        "white",
        "nearly black",
        "partly saturated",
    ],
)
def test_spoiled_captures_give_valid_or_masked_maps(shoot, limits, tmp_path):
    result = reconstruct(tmp_path, shoot, want=["normals", "r_d"])
    assert np.median(result.normals_deg) < limits.normals_deg
    assert np.abs(np.median(result.r_d, axis=0)).max() < limits.r_d
    assert result.share > limits.share
    named = result.maps.parameters.get("lights_left_out")
    known = shoot.dead if shoot.dead_known else ()
    assert (named or []) == [dome(shoot)[0].lights[k].name for k in known]


@pytest.mark.long
def test_unnoticed_three_millimeter_motion_errs_more_than_rest(found, tmp_path):
    moved = reconstruct(tmp_path, Shoot(moved_mm=(3.0, 0.0, 0.0)), want=["normals", "r_d"])
    rest = found[1]
    # 3 mm over the ellipsoid's least radius of curvature, 52 mm, are 3.3 degrees
    assert 3 * np.median(rest.normals_deg) < np.median(moved.normals_deg) < 3.3
    assert np.abs(np.median(moved.r_d, axis=0)).max() < 0.03
    assert moved.share > 0.5
    # the residual of the registration tells it, though nothing corrects it
    residuals = [x.maps.parameters["registration"]["residual_deg"] for x in (moved, rest)]
    assert residuals[0] > 1.5 * residuals[1]
