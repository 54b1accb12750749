"""Evaluate rim, crown and eyes that are added to scans of simulated heads.

    python tools/judge_unmeasured_head.py [--first SEED] [--people N]

Each head is scanned by the simulated scanner with 12,000 triangles, cropped and repaired; its holes
are closed. Printed per head: the rim's length over that of its smoothed curve, before, at the
trimmed rim, and of the completed head; measured vertices left; errors of the added surface across
the true one; errors of the eyes' centers. A head takes about 8 s of processor time.
"""

from __future__ import annotations

import argparse

import numpy as np

from reconstruction.scan.closest_points import ScanSurface
from reconstruction.scan.hole_patches import close_scan
from reconstruction.scan.mesh import FACE_BOX_MM
from reconstruction.scan.repair import TriangleMesh, crop, repair_mesh
from rigsim.face_parts.eyelids import build_eyelids
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.scanner.pods import ScannerSettings, scan_face
from rigsim.subject.head import build_head
from skinrig.unmeasured.completion import complete_head
from skinrig.unmeasured.head_fit import fit_head
from skinrig.unmeasured.lids import cut_lids
from skinrig.unmeasured.rim import find_rim, measure_raggedness


def scan_head(seed: int) -> tuple[Mesh, Mesh]:
    """Return a scan with closed holes and the true head, both in the rig frame."""
    head = build_head(np.random.default_rng([seed, 0]))
    found = scan_face(
        head, rng=np.random.default_rng([seed, 7]), scanner=ScannerSettings(triangles=12_000)
    )
    vertices = found.vertices_mm @ found.to_dome[:3, :3].T + found.to_dome[:3, 3]
    face = crop(TriangleMesh(vertices, found.faces.astype(np.int64)), box_mm=FACE_BOX_MM)
    closed = close_scan(repair_mesh(face, max_hole_mm=0.0)[0]).mesh
    flat = np.zeros((len(closed.vertices_mm), 2))
    return build_mesh(closed.vertices_mm, closed.faces, flat), head


def judge(seed: int) -> str:
    """Return the figures of one head as a row of a Markdown table."""
    scan, head = scan_head(seed)
    fitted = fit_head(scan)
    done = complete_head(scan, fitted)
    points = np.concatenate([done.measured_mm, done.filled_mm])
    faces = np.concatenate([done.trimmed.faces, done.faces + len(done.measured_mm)])
    scanned = scan.vertices_mm.astype(np.float64)
    loops = (
        scanned[find_rim(scanned, scan.faces)],
        done.measured_mm[done.trimmed.rim],
        points[find_rim(points, faces)],
    )
    kept = done.trimmed.vertices
    moved_mm = np.abs(done.measured_mm[: len(kept)] - scanned[kept]).max()
    new = done.filled_mm[done.rim_count :]
    surface = TriangleMesh(head.vertices_mm.astype(np.float64), head.faces.astype(np.int64))
    found = ScanSurface(surface).find_closest(new)
    across = np.abs(np.einsum("nk,nk->n", new - found.points_mm, found.normals))
    inside = ~found.on_border
    stated = done.stderr_mm[done.rim_count :]
    lids = zip(cut_lids(scan, fitted)[1], build_eyelids(head), strict=True)
    eyes = [float(np.linalg.norm(one.center_mm - true.center_mm)) for one, true in lids]
    cells = (
        str(seed),
        "; ".join(f"{measure_raggedness(loop):.3f}" for loop in loops),
        f"{len(kept)} of {len(scanned)}, moved {moved_mm:g} mm",
        f"{np.sqrt(np.mean(across[inside] ** 2)):.2f}; {np.median(across[inside]):.2f}; "
        f"{np.median(stated[inside]):.2f} mm; {100 * np.mean((across < stated)[inside]):.0f} %",
        "; ".join(f"{error:.2f}" for error in eyes) + " mm",
    )
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the figures of some heads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=6203, help="first seed")
    parser.add_argument("--people", type=int, default=3, help="number of heads")
    given = parser.parse_args()
    print("| seed | rim: scan; trimmed; completed | vertices left | added surface | eyes |")
    for seed in range(given.first, given.first + given.people):
        print(judge(seed), flush=True)


if __name__ == "__main__":
    main()
