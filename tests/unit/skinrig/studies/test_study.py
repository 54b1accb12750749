"""Studies: cases, records that spare work, failures as rows, coverage by skin type."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.study_judge import FAILING_SUBJECT, judge_by_drawing

from rigsim.sensor import make_sensor
from skinrig.console import Console
from skinrig.errors import MissingExtra, UnusableError
from skinrig.simulating.orders import order_for
from skinrig.studies import description, executors
from skinrig.studies.cases import CaseOrder, JudgedQuantity, run_case
from skinrig.studies.description import CaseGroup, StudyError, StudyFile, read_study, software_hash
from skinrig.studies.results import summarize
from skinrig.studies.study import run_study

TEXT = """
schema = "skinrig.study/1"
title = "Two rigs"

[[groups]]
rig = "flash"
subjects = ["I", "VI"]
seeds = "10..13"
sizes = [{width_px = 64}]

[[groups]]
rig = "probe"
subjects = ["homogeneous:0.1,1"]
seeds = "10..12"
"""


def group(**changes):
    usual = {"rig": "flash", "subjects": ("I", "VI"), "seeds": "10..13"}
    return CaseGroup(**usual | changes)


def study_of(*groups):
    return StudyFile(schema="skinrig.study/1", title="Some cases", groups=groups)


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(TEXT, encoding="utf-8")
    return path


def table(out):
    with (out / "study.csv").open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def results(out):
    return [(out / name).read_bytes() for name in ("study.csv", "study.json", "report.html")]


def test_seeds_go_round_subjects(written):
    cases = read_study(written).list_cases()
    shown = [(case.subject, case.seed) for case in cases if case.rig == "flash"]
    assert shown == [("I", 10), ("VI", 11), ("I", 12), ("VI", 13)]
    assert {case.skin for case in cases} == {"I", "VI", "medium"}


def test_every_seed_multiplies_subjects_and_ages():
    made = study_of(group(every_seed=True, calibration_age_days=(0, 30))).list_cases()
    assert len(made) == 2 * 4 * 2
    assert made[1].name == "flash I 10, 384 px, calibrated 30 days ago"


def test_key_depends_on_everything_that_matters():
    usual, *others = (
        study_of(group(**changes)).list_cases()[0]
        for changes in (
            {},
            {"subjects": ("II",)},
            {"seeds": "11"},
            {"calibration_age_days": (3,)},
            {"iso_factors": (4.0,)},
            {"leave_out": ("lateral",)},
        )
    )
    keys = {case.key("a") for case in (usual, *others)} | {usual.key("b")}
    assert len(keys) == 7
    assert usual.key("a") == study_of(group()).list_cases()[0].key("a")


def write_person(path, melanin):
    path.parent.mkdir(exist_ok=True)
    path.write_text(f'schema = "skinrig.subject/1"\nmelanin = {melanin}\n', encoding="utf-8")
    return study_of(group(subjects=(path.name,), seeds="1"))


def test_key_depends_on_content_of_subject_file(tmp_path, monkeypatch):
    keys = []
    for folder, melanin in (("a", 0.02), ("b", 0.03), ("c", 0.02)):
        study = write_person(tmp_path / folder / "ann.toml", melanin)
        monkeypatch.chdir(tmp_path / folder)
        (case,) = study.list_cases()
        assert case.subject == str(tmp_path / folder / "ann.toml")
        keys.append(case.key("a"))
    assert keys[0] == keys[2] != keys[1]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda path: path, ""),
        (lambda path: write_person(path, 0.03), "another content of"),
        (lambda path: path.unlink(), "ann.toml"),
    ],
)
def test_changed_subject_file_refuses_case(tmp_path, monkeypatch, change, word):
    """A worker in another folder reads the file by its absolute path, and compares its content."""
    study = write_person(tmp_path / "ann.toml", 0.02)
    monkeypatch.chdir(tmp_path)
    (case,) = study.list_cases()
    order = CaseOrder(
        *(case, case.key(software_hash()), tmp_path / "out", software_hash(), False),
        *(judge_by_drawing, False),
    )
    (tmp_path / "worker").mkdir()
    monkeypatch.chdir(tmp_path / "worker")
    change(tmp_path / "ann.toml")
    error = run_case(order).error
    assert (word in error) if word else not error


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"rig": "teapot"}, "rig"),
        ({"seeds": "9..3"}, "seeds"),
        ({"subjects": ()}, "subjects"),
        ({"subjects": ("XX",)}, "XX"),
        ({"subjects": ("homogeneous:1",), "rig": "probe"}, "homogeneous"),
        ({"subjects": ("P60..P01",), "rig": "dome"}, "P60..P01"),
        ({"subjects": ("P60..P01",), "rig": "dome", "every_seed": True}, "P60..P01"),
        ({"subjects": ("ita:1.2.3..9/4",)}, "1.2.3"),
        ({"subjects": ("P01",)}, "flash: subject: got 'P01'"),
        ({"subjects": ("P01",), "rig": "gradient"}, "gradient: subject: got 'P01'"),
        ({"subjects": ("P88",), "rig": "dome"}, "P88"),
        ({"subjects": ("homogeneous:0.1,1",)}, "homogeneous:0.1,1"),
        ({"subjects": ("homogeneous:0.1,1",), "rig": "dome"}, "homogeneous:0.1,1"),
        ({"calibration_age_days": (0, -1)}, "0 to 89 days"),
        ({"calibration_age_days": (90,)}, "0 to 89 days"),
        ({"calibration_age_days": (10**10,)}, "0 to 89 days"),
        ({"iso_factors": (1.0, 0.0)}, "0.25 to 64"),
        ({"iso_factors": (float("nan"),)}, "0.25 to 64"),
        ({"seeds": "0..999999999"}, "at most"),
        ({"site": "nose"}, "site"),
        ({"leave_out": ("gold",)}, "gold"),
    ],
)
def test_faulty_group_names_fault(changes, word):
    with pytest.raises(StudyError, match=word):
        study_of(group(**changes)).list_cases()


@pytest.mark.parametrize(
    ("rig", "subject"),
    [
        *(("flash", "palest"), ("dome", "P87"), ("dome", "ita:20"), ("gradient", "monk:3")),
        *(("probe", "P01"), ("probe", "anisotropic:0.1,1"), ("probe", "darkest")),
    ],
)
def test_subject_that_rig_takes_is_case(rig, subject):
    changes = {"rig": rig, "subjects": (subject,), "calibration_age_days": (89,)}
    assert len(study_of(group(**changes, seeds="7")).list_cases()) == 1


def test_second_run_does_no_work(written, tmp_path):
    study, out = read_study(written), tmp_path / "out"
    first = run_study(study, out, judge=judge_by_drawing)
    before = results(out)
    second = run_study(study, out, judge=None)
    assert (first.ran, second.ran, len(second.quantities)) == (7, 0, 7)
    assert results(out) == before


def test_missing_and_damaged_records_are_made_again(written, tmp_path):
    study, out = read_study(written), tmp_path / "out"
    run_study(study, out, judge=judge_by_drawing)
    before = results(out)
    removed, damaged = sorted((out / "cases").iterdir())[:2]
    removed.unlink()
    damaged.write_bytes(damaged.read_bytes()[:-40])
    assert run_study(study, out, judge=judge_by_drawing).ran == 2
    assert results(out) == before


def test_failed_case_is_row_and_runs_again(tmp_path, capsys):
    study = study_of(group(subjects=("I", FAILING_SUBJECT), seeds="1..4"))
    first = run_study(study, tmp_path, judge=judge_by_drawing, progress=Console(True).progress)
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    lines = [event["text"] for event in events]
    assert lines[0] == "cases: 0/4"
    assert lines[1] == "cases: 1/4, last flash I 1, 384 px"
    assert [event["left_s"] is None for event in events] == [True, False, False, False, False]
    failures = [row["failure"] for row in table(tmp_path) if row["failure"]]
    assert failures == ["subject: got darkest, expected light"] * 2
    assert len(first.quantities) == 2
    assert sum("expected light" in line for line in lines) == 2
    assert run_study(study, tmp_path, judge=judge_by_drawing).ran == 2
    assert "2 cases failed" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_sessions_are_deleted_unless_kept(written, tmp_path):
    study = read_study(written)
    for name, keep in (("a", False), ("b", True)):
        run_study(study, tmp_path / name, keep=keep, judge=judge_by_drawing)
        assert not (tmp_path / name / "work").exists()
    assert not (tmp_path / "a" / "sessions").exists()
    assert len(list((tmp_path / "b" / "sessions").glob("*/session"))) == 7


def test_coverage_verdict_follows_true_spread(tmp_path):
    groups = [
        group(rig=rig, subjects=(subject,), seeds="0..39")
        for rig, subject in (("flash", "III"), ("probe", "homogeneous:0.1,1"))
    ]
    run_study(study_of(*groups), tmp_path, judge=judge_by_drawing)
    found = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))["quantities"]
    right, wrong = (
        next(row for row in found if row["skin"] == skin)["coverage"] for skin in ("III", "medium")
    )
    assert {one["verdict"] for one in right.values()} == {"kept"}
    assert right["68"]["inside"] == pytest.approx(0.683, abs=0.02)
    assert {one["verdict"] for one in wrong.values()} == {"missed"}
    assert wrong["68"]["inside"] == pytest.approx(0.383, abs=0.02)


def test_coverage_is_divided_by_type_age_and_iso(tmp_path):
    """Every part pools its own cases; only cells have a type, an age and an ISO at once."""
    groups = [
        group(seeds="0..7"),
        group(seeds="8..13", calibration_age_days=(30,)),
        group(seeds="14..17", iso_factors=(4.0,)),
    ]
    run_study(study_of(*groups), tmp_path, judge=judge_by_drawing)
    document = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))
    counts = {
        (row["skin"], row["calibration_age_days"], row["iso_factor"]): row["cases"]
        for row in document["quantities"]
    }
    assert counts == {
        ("all", None, None): 18,
        ("I", None, None): 9,
        ("VI", None, None): 9,
        ("all", 0, None): 12,
        ("all", 30, None): 6,
        ("all", None, 1): 14,
        ("all", None, 4): 4,
    }
    cells = {
        (row["skin"], row["calibration_age_days"], row["iso_factor"]): row["cases"]
        for row in document["cells"]
    }
    assert sum(cells.values()) == 18
    assert cells["VI", 30, 1] == 3
    inside = {row["seed"]: float(row["inside_68"]) for row in table(tmp_path)}
    old = [inside[str(seed)] for seed in range(8, 14)]
    row = next(one for one in document["quantities"] if one["calibration_age_days"] == 30)
    assert row["coverage"]["68"]["inside"] == pytest.approx(sum(old) / 6, abs=1e-5)
    with (tmp_path / "summary.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(counts) + len(cells)
    assert float(rows[4]["inside_68"]) == pytest.approx(sum(old) / 6, abs=1e-3)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "30 days" in page
    assert "ISO x 4" in page


def test_repeated_people_count_once_in_bounds():
    """12 people under 6 conditions that agree determine no more than 12 people under one."""
    groups = (group(seeds="0..11", calibration_age_days=(0, 30, 60), iso_factors=(1.0, 4.0)),)
    repeated = {case.name: case for case in study_of(*groups).list_cases()}
    once = {case.name: case for case in study_of(group(seeds="0..11")).list_cases()}
    inside = np.random.default_rng(0).uniform(0.3, 0.9, 12)

    def bounds(cases):
        rows = {
            name: [JudgedQuantity("x", case.skin, 400, 1.0, 1.0, "%", inside[case.seed], 0.95)]
            for name, case in cases.items()
        }
        return summarize("Some cases", cases, rows, {})["quantities"][0]

    many, few = bounds(repeated), bounds(once)
    assert (many["cases"], few["cases"]) == (72, 12)
    for level in ("68", "95"):
        wide, narrow = (one["coverage"][level] for one in (many, few))
        assert wide["inside"] == pytest.approx(narrow["inside"])
        # more parts share the rate of false alarms, so that bounds are wider
        assert wide["high"] - wide["low"] >= narrow["high"] - narrow["low"]


@pytest.mark.parametrize("rig", ["flash", "dome", "gradient", "probe"])
def test_iso_of_case_reaches_its_sensor(rig):
    planner = __import__(f"skinrig.simulating.{rig}", fromlist=["plan_capture"])
    usual, noisy = (
        make_sensor(planner.plan_capture(order_for(rig, out="session", iso_factor=k))[0].views[0])
        for k in (1.0, 4.0)
    )
    (shot, floor), (more, higher) = usual.noise_profile(), noisy.noise_profile()
    assert more == pytest.approx(4.0 * shot)
    rounding = 1.0 / (12.0 * (usual.white - usual.black) ** 2)
    assert higher - rounding == pytest.approx(16.0 * (floor - rounding))


def test_second_writer_is_refused(written, tmp_path):
    study, out = read_study(written), tmp_path / "out"

    def run_inside(case, folder):
        run_study(study, out, judge=judge_by_drawing)
        yield from ()

    run = run_study(study, out, judge=run_inside)
    assert set(run.errors) == set(run.cases)
    assert all("another study is being written" in text for text in run.errors.values())


def test_worker_with_other_software_refuses_case(written, tmp_path, monkeypatch):
    monkeypatch.setattr(description, "software_hash", lambda: "other")
    run = run_study(read_study(written), tmp_path / "out", judge=judge_by_drawing)
    assert software_hash() != "other"
    assert set(run.errors) == set(run.cases)
    assert all(text.startswith("worker: got another inst") for text in run.errors.values())


@pytest.mark.parametrize("text", ["local", "local:0", "tcp://host", "processes", "local:x"])
def test_malformed_executor_is_refused(text):
    with pytest.raises(UnusableError, match="local:N"):
        executors.check_executor(text)


def test_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingExtra, match="cluster"), executors.open_executor("local:2"):
        pass


def test_task_that_ends_workers_is_described(monkeypatch):
    class KilledWorker(Exception):
        pass

    fake = SimpleNamespace(KilledWorker=KilledWorker)
    monkeypatch.setitem(__import__("sys").modules, "distributed", fake)
    assert "several worker processes" in executors.describe_lost_task(KilledWorker("x"))
    assert "failed (OSError" in executors.describe_lost_task(OSError("x"))
