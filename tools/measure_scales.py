"""Run one rig from its targets to a report and an export at three scales, and tabulate them.

Each step is a command of its own, whose seconds, processor seconds, peak memory and written bytes
are recorded. A step that is recorded is not run again; one that was interrupted continues. Full
scale is that of the papers: dome of 16 cameras, 150 lights and 1300 x 1030 pixels with its scan,
flash rig of 3024 x 2016 pixels with 7 expressions and a sequence, gradient rig of 2048 x 2048
pixels with 4 angles of the caliper, probe with 3 sites and 16 directions. Half has half the width.

    python tools/measure_scales.py run dome --scale full --out full-dome
    python tools/measure_scales.py table small-dome half-dome full-dome
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RECORD_NAME = "scale.json"
SKIN_TYPE = "III"
EXPRESSIONS = ("neutral", "anger", "disgust", "fear", "sadness", "smile", "surprise")
GRADIENT_ANGLES = "0,45,90,135"
WIDTHS_PX: Mapping[str, Mapping[str, int]] = {
    "flash": {"small": 768, "half": 1512, "full": 3024},
    "dome": {"small": 320, "half": 650, "full": 1300},
    "gradient": {"small": 512, "half": 1024, "full": 2048},
}
MAPS: Mapping[str, str] = {
    "flash": "melanin,hemoglobin,shading,residual,diffuse,image,specular_image",
    "dome": "half_vector_normals,normals,normals_refined,r_d,lobe_residual,samples,"
    + ",".join(f"basis_weight_{lobe}" for lobe in range(4)),
    "gradient": "normals,height,crossed,strain,histograms,kernels",
    "probe": "profiles,subsurface,translucency",
}
TARGETS: Mapping[str, Sequence[str]] = {
    "flash": ("flat", "white", "chart", "malus"),
    "dome": ("charuco", "mirror", "white"),
    "gradient": ("ball",),
    "probe": ("phantom",),
}
CALIBRATIONS: Mapping[str, Sequence[tuple[str, Sequence[str]]]] = {
    "flash": (
        ("sensor", ("flat",)),
        ("white", ("white",)),
        ("color", ("chart",)),
        ("polarization", ("malus",)),
    ),
    "dome": (("geometry", ("charuco",)), ("lights", ("mirror", "white"))),
    "gradient": (("lights", ("ball",)), ("polarization", ("ball",))),
    "probe": (("fiber", ("phantom",)),),
}
Step = tuple[str, list[str]]


def list_steps(rig: str, scale: str, seed: int) -> Iterator[Step]:
    """Yield name and arguments of each step, with paths relative to the output."""
    full = scale == "full"
    whole = full or (rig in ("dome", "probe") and scale == "half")
    size = ["--scale", "full" if whole else "small"]
    width = [] if rig == "probe" else ["--width", str(WIDTHS_PX[rig][scale])]
    simulate = ["simulate", rig, "--seed", str(seed), *size]
    for target in TARGETS[rig]:
        ball = ["--width", str(WIDTHS_PX[rig]["full"])] if rig == "gradient" else width
        out = ["--out", f"session-{rig}-{target}"]
        yield f"target {target}", [*simulate, "--target", target, *ball, *out]
    for kind, sessions in CALIBRATIONS[rig]:
        names = [f"session-{rig}-{target}" for target in sessions]
        yield f"calibrate {kind}", ["calibrate", kind, *names, "--out", "calibration"]
    subject = ["--site", "forehead"] if rig == "gradient" else ["--subject", SKIN_TYPE]
    if rig == "flash":
        subject += [word for state in EXPRESSIONS for word in ("--state", state)]
    if rig == "gradient":
        subject += ["--angles", GRADIENT_ANGLES]
    if rig == "probe" and full:
        subject += ["--all-brackets"]
    yield "capture", [*simulate, *subject, *width, "--out", "session-skin"]
    if rig == "flash":
        moving = ["--sequence", "smile", "--subject", SKIN_TYPE]
        yield "capture sequence", [*simulate, *moving, *width, "--out", "session-sequence"]
    yield "verify", ["verify", "session-skin"]
    calibrated = ["--calibration", "calibration"]
    maps = ["--maps", MAPS[rig], *calibrated, "--out", "appearance-skin"]
    yield "reconstruct", ["reconstruct", "session-skin", *maps]
    if rig == "flash":
        fit = ["fit", "facial-color", "session-skin", *calibrated, "--out", "appearance-moving"]
        yield "fit expressions", fit
        curves = ["--maps", "perfusion_curves", *calibrated, "--out", "appearance-sequence"]
        yield "reconstruct sequence", ["reconstruct", "session-sequence", *curves]
    if rig == "gradient":
        fit = ["fit", "microstructure", "appearance-skin", "--out", "appearance-moving"]
        yield "fit microstructure", fit
    yield "report", ["report", ".", "--out", "report.html"]
    yield "export", ["export", "appearance-skin", "--to", "maps", "--out", "export-maps"]


def measure_command(words: Sequence[str], folder: Path, log: Path) -> dict[str, float]:
    """Run a program in a folder; return its exit code, seconds, peak memory and written bytes."""
    begun_s = time.perf_counter()
    with log.open("wb") as lines:
        process = subprocess.Popen(words, cwd=folder, stdout=lines, stderr=subprocess.STDOUT)
        try:
            _, status, used = os.wait4(process.pid, 0)
        except BaseException:
            process.terminate()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    return {
        "exit": process.returncode,
        "seconds": time.perf_counter() - begun_s,
        "processor_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss * 1024e-6,
        "read_mb": used.ru_inblock * 512e-6,
        "written_mb": used.ru_oublock * 512e-6,
    }


def measure_folder_mb(folder: Path) -> float:
    """Return the bytes of a folder's files, MB."""
    return sum(one.stat().st_size for one in folder.rglob("*") if one.is_file()) * 1e-6


def run(rig: str, scale: str, seed: int, out: Path) -> dict[str, Any]:
    """Run the steps that are not recorded yet, and return the record."""
    out.mkdir(parents=True, exist_ok=True)
    written = out / RECORD_NAME
    fresh: dict[str, Any] = {"rig": rig, "scale": scale, "seed": seed}
    fresh |= {"cores": os.cpu_count(), "steps": {}}
    record = json.loads(written.read_text("utf-8")) if written.exists() else fresh
    asked = (rig, scale, seed)
    if (record["rig"], record["scale"], record["seed"]) != asked:
        raise SystemExit(f"{out}: has a run of another rig, scale or seed; name another --out")
    logs = out.with_name(f"{out.name}-logs")
    logs.mkdir(exist_ok=True)
    for name, words in list_steps(rig, scale, seed):
        if name in record["steps"]:
            continue
        print(f"{rig}, {scale}: {name}", file=sys.stderr, flush=True)
        log = logs / f"{name.replace(' ', '-')}.txt"
        resumed = words[0] == "simulate" and (out / words[-1] / "session.json").exists()
        if resumed:
            words.append("--resume")
        found = measure_command([sys.executable, "-m", "skinrig", *words], out, log)
        if found["exit"]:
            raise SystemExit(f"{name}: exit code {found['exit']}, see {log}")
        # figures of a step that was interrupted are those of its last part
        found |= {"load": os.getloadavg()[0], "resumed": resumed}
        record["steps"][name] = found
        written.write_text(json.dumps(record, indent=1), "utf-8")
    record["disk_mb"] = measure_folder_mb(out)
    record["errors"] = judge(rig, out)
    record |= count_pixels(out)
    written.write_text(json.dumps(record, indent=1), "utf-8")
    return dict(record)


def count_pixels(out: Path) -> dict[str, float]:
    """Return the frames of the session and their megapixels."""
    from capture.session import Session
    from skinrig.resources.forecast import count_megapixels

    session = Session.open(out / "session-skin")
    sizes = count_megapixels(session.rig, session.plan)
    frames = sum(len(step.cameras) for step in session.plan.steps)
    return {"frames": frames, **sizes}


def judge(rig: str, out: Path) -> list[list[Any]]:
    """Return map, error, unit and coverage of 68 % intervals, against the ground truth."""
    from model import store
    from skinrig.evaluating import flash, microrelief, subsurface, surface

    maps, truth = store.read(out / "appearance-skin"), store.read(out / "truth-skin")
    rng = np.random.default_rng(0)
    if rig == "flash":
        return [
            [one.name, 100 * one.median_relative, "%", one.coverage.fraction]
            for one in flash.compare(maps, truth, rng=rng)
            if one.band is None and one.against == "blurred"
        ]
    if rig == "dome":
        return [
            [one.name, one.limit_check[1], one.unit, one.coverage.fraction]
            for one in surface.compare(maps, truth, rng=rng)
        ]
    if rig == "gradient":
        found: list[list[Any]] = []
        for one in microrelief.compare(maps, truth, rng=rng):
            if one.state.endswith("_n0"):
                found.append([f"normals, {one.state}", one.mean_deg, "deg", one.coverage])
                relief = 100 * one.height_relative
                found.append([f"height, {one.state}", relief, "%", one.height_coverage])
        return found
    fits = subsurface.compare_fits(maps, truth)
    return [
        [f"sigma_tr, {one.method}", 100 * one.median, "%", one.coverage]
        for one in subsurface.summarize_methods(fits)
    ]


def tabulate(records: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a table of each rig in Markdown: steps by scale, with the exponent of growth.

    The exponent is that of processor seconds with the megapixels of all frames, from the two
    largest scales: 1 is linear.
    """
    for rig in dict.fromkeys(record["rig"] for record in records):
        group = sorted(
            (record for record in records if record["rig"] == rig),
            key=lambda record: record["frame_mp"],
        )
        yield f"### {rig}"
        yield ""
        columns = [f"{one['scale']}: s; processor s; MB" for one in group]
        yield "| step | " + " | ".join([*columns, "exponent"]) + " |"
        yield "| --- |" + " --- |" * (len(columns) + 1)
        for name in group[-1]["steps"]:
            cells = [
                f"{step['seconds']:.1f}; {step['processor_s']:.1f}; {step['peak_mb']:.0f}"
                + (" (last part)" if step.get("resumed") else "")
                if (step := one["steps"].get(name))
                else "-"
                for one in group
            ]
            yield f"| {name} | " + " | ".join([*cells, _exponent(group, name)]) + " |"
        totals = [
            f"{sum(s['seconds'] for s in one['steps'].values()):.0f}; "
            f"{sum(s['processor_s'] for s in one['steps'].values()):.0f}; "
            f"{max(s['peak_mb'] for s in one['steps'].values()):.0f}"
            for one in group
        ]
        yield "| total, most memory | " + " | ".join([*totals, ""]) + " |"
        disks = [f"{one['disk_mb'] * 1e-3:.2f} GB" for one in group]
        yield "| disk | " + " | ".join([*disks, ""]) + " |"
        sizes = [f"{one['frames']}; {one['frame_mp']:.0f} megapixels" for one in group]
        yield "| frames | " + " | ".join([*sizes, ""]) + " |"
        for at, (name, *_) in enumerate(group[-1]["errors"]):
            cells = [
                f"{row[1]:.2g} {row[2]}; {100 * row[3]:.0f} %"
                if at < len(one["errors"]) and (row := one["errors"][at])[0] == name
                else "-"
                for one in group
            ]
            yield f"| error of {name}; coverage | " + " | ".join([*cells, ""]) + " |"
        yield ""


def _exponent(group: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return the exponent of a step between the two largest scales; empty if there is one."""
    if len(group) < 2 or name not in group[-2]["steps"]:
        return ""
    small, large = group[-2:]
    grown = large["steps"][name]["processor_s"] / small["steps"][name]["processor_s"]
    pixels = large["frame_mp"] / small["frame_mp"]
    return f"{math.log(grown) / math.log(pixels):.2f}" if pixels > 1.0 else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    running = commands.add_parser("run")
    running.add_argument("rig", choices=tuple(TARGETS))
    running.add_argument("--scale", choices=("small", "half", "full"), default="full")
    running.add_argument("--seed", type=int, default=0)
    running.add_argument("--out", type=Path, required=True)
    table = commands.add_parser("table")
    table.add_argument("folders", type=Path, nargs="+")
    given = parser.parse_args()
    if given.command == "run":
        records = [run(given.rig, given.scale, given.seed, given.out)]
    else:
        records = [json.loads((one / RECORD_NAME).read_text("utf-8")) for one in given.folders]
    print("\n".join(tabulate(records)))


if __name__ == "__main__":
    main()
