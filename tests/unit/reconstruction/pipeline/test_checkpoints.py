"""An interrupted run continues with the stage and tile that it lacks, and ends with the same."""

import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from reconstruction import tiles
from reconstruction.pipeline import checkpoints as module
from reconstruction.pipeline.checkpoints import BusyError, Checkpoints, RunRecord, compute_tiles
from reconstruction.pipeline.graph import PipelineStage, run_stages
from reconstruction.pipeline.product_file import read_product

N_TILES = 4


class Unstorable:
    """A product that the files do not take."""

    def __init__(self, value):
        self.value = value


@dataclass
class Run:
    """A run of three stages that counts what it computes, and is interrupted at one of these."""

    out: Path
    options: dict = field(default_factory=lambda: {"gain": 2.0})
    stop_at: str = ""
    error: type[BaseException] = KeyboardInterrupt
    max_cost: float = 1e9
    computed: list = field(default_factory=list)
    record: RunRecord = field(default_factory=lambda: RunRecord(["given"], {}, {}))
    kept: Checkpoints | None = None
    workers: int = 1

    def compute(self, name):
        if name == self.stop_at:
            raise self.error(name)
        self.computed.append(name)

    def frames(self):
        self.compute("frames")
        self.record.assumed.append("the light is even")
        return {"image": Unstorable(np.arange(4.0))}

    def fit(self, image):
        def fit_tile(number):
            self.compute(f"tile {number}")
            return self.options["gain"] * image.value[number]

        given = range(N_TILES), fit_tile, lambda *_: None
        found = np.array(list(compute_tiles(self.kept, "fit", *given, workers=self.workers)))
        self.record.noted["mean"] = float(found.mean())
        self.record.hashes["scan"] = "abc"
        return {"fitted": found, "count": len(found)}

    def draw(self, fitted):
        self.compute("draw")
        return {"map": fitted + 1}

    def run(self):
        """Return the outcome with the record of the run."""
        graph = [
            PipelineStage("frames", (), ("image",), self.frames),
            PipelineStage("fit", ("image",), ("fitted", "count"), self.fit),
            PipelineStage("draw", ("fitted",), ("map",), self.draw),
        ]
        with Checkpoints.of_output(self.out, self.options, self.record) as self.kept:
            self.kept.max_cost = self.max_cost
            outcome = run_stages(graph, ["map", "count"], checkpoints=self.kept)
        products = {name: np.asarray(value).tolist() for name, value in outcome.products.items()}
        return products, outcome.ran, self.record


def interrupt(out, at, **options):
    run = Run(out, stop_at=at, **options)
    with pytest.raises(run.error):
        run.run()
    return run


EVERYTHING = ["frames", *(f"tile {n}" for n in range(N_TILES)), "draw"]


@pytest.mark.parametrize("at", EVERYTHING)
def test_run_interrupted_anywhere_resumes_to_same_result(tmp_path, at):
    whole = Run(tmp_path / "whole")
    expected = whole.run()
    assert whole.computed == EVERYTHING
    first = interrupt(tmp_path / "out", at)
    again = Run(tmp_path / "out")
    assert again.run() == expected
    repeated = set(first.computed) & set(again.computed)
    # frames are unstorable, thus computed again where a later stage needs them
    assert repeated == ({"frames"} if at.startswith("tile") else set())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("at", EVERYTHING)
def test_interrupted_threads_repeat_at_most_one_tile_each(tmp_path, at, monkeypatch):
    monkeypatch.setattr(tiles, "threading_layer", lambda: "omp")
    monkeypatch.setattr(tiles, "get_num_threads", lambda: 2)
    monkeypatch.setattr(tiles, "set_num_threads", lambda _: None)
    expected = Run(tmp_path / "whole").run()
    first = interrupt(tmp_path / "out", at, workers=2)
    again = Run(tmp_path / "out", workers=2)
    assert again.run() == expected
    repeated = set(first.computed) & set(again.computed) - {"frames"}
    assert len(repeated) <= 1  # the other worker's is the interrupted one
    assert list(tmp_path.iterdir()) == []


def test_run_killed_twice_computes_no_tile_twice(tmp_path):
    first, second = interrupt(tmp_path / "out", "tile 2"), interrupt(tmp_path / "out", "tile 3")
    last = Run(tmp_path / "out")
    last.run()
    tiles = [n for run in (first, second, last) for n in run.computed if n.startswith("tile")]
    assert tiles == EVERYTHING[1:-1]


def test_run_with_changed_option_takes_up_nothing(tmp_path):
    interrupt(tmp_path / "out", "draw")
    changed = Run(tmp_path / "out", options={"gain": 3.0})
    products, _, _ = changed.run()
    assert changed.computed == EVERYTHING
    assert products["map"] == [1.0, 4.0, 7.0, 10.0]


def test_run_of_changed_code_takes_up_nothing(tmp_path, monkeypatch):
    interrupt(tmp_path / "out", "draw")
    monkeypatch.setattr(module, "code_digest", lambda: "later")
    changed = Run(tmp_path / "out")
    changed.run()
    assert changed.computed == EVERYTHING


def test_code_digest_changes_with_any_source(tmp_path, monkeypatch):
    (tmp_path / "one" / "data").mkdir(parents=True)
    monkeypatch.setattr(module.resources, "files", lambda package: tmp_path / package)
    found = set()
    for name, text in (("a.py", "1"), ("a.py", "2"), ("data/table.csv", "2"), ("b.py", "")):
        (tmp_path / "one" / name).write_text(text)
        found.add(module.code_digest.__wrapped__(("one",)))
    assert len(found) == 4


def test_damaged_checkpoint_is_computed_again(tmp_path):
    expected = Run(tmp_path / "whole").run()
    interrupt(tmp_path / "out", "draw")
    for path in (tmp_path / ".out.work").glob("*.npz"):
        path.write_bytes(path.read_bytes()[:-30])
    again = Run(tmp_path / "out")
    assert again.run() == expected
    assert again.computed == EVERYTHING


def test_products_above_cost_limit_are_computed_again(tmp_path):
    expected = Run(tmp_path / "whole").run()
    interrupt(tmp_path / "out", "draw", max_cost=0.0)
    again = Run(tmp_path / "out")
    assert again.run() == expected  # assumptions and notes are not doubled
    assert again.computed == EVERYTHING


def test_work_folder_is_private_and_free_of_pickle(tmp_path):
    interrupt(tmp_path / "new" / "out", "draw")
    folder = tmp_path / "new" / ".out.work"
    assert folder.stat().st_mode & 0o077 == 0
    files = list(folder.glob("*.npz"))
    assert len(files) == N_TILES + 3  # tiles, products of one stage, records of two
    for path in files:
        read_product(path)


@pytest.mark.parametrize(
    ("error", "kept"), [(KeyboardInterrupt, True), (MemoryError, True), (ValueError, False)]
)
def test_run_refused_leaves_nothing_behind(tmp_path, error, kept):
    """An error of the input returns with the same input; one of the machine need not."""
    interrupt(tmp_path / "new" / "out", "draw", error=error)
    assert (tmp_path / "new" / ".out.work").is_dir() == kept
    assert (tmp_path / "new").exists() == kept


def test_unfinished_maps_of_killed_run_are_removed(tmp_path):
    interrupt(tmp_path / "out", "draw")
    kept = tmp_path / ".out.old.part"
    for folder in (tmp_path / f".out.{'0a' * 16}.part", kept):
        folder.mkdir()
    Run(tmp_path / "out").run()
    assert list(tmp_path.iterdir()) == [kept]


def test_work_folder_in_use_is_refused(tmp_path):
    interrupt(tmp_path / "out", "draw")
    with Checkpoints.of_output(tmp_path / "out", {}, RunRecord([], {}, {})):
        with pytest.raises(BusyError, match="another skinrig process"):
            Run(tmp_path / "out").run()
        assert (tmp_path / ".out.work").is_dir()


def test_foreign_files_of_work_folder_are_kept(tmp_path):
    interrupt(tmp_path / "out", "draw")
    note = tmp_path / ".out.work" / "mine.txt"
    note.write_text("keep")
    interrupt(tmp_path / "out", "draw", options={"gain": 5.0})
    assert note.read_text() == "keep"
    assert len(list(note.parent.glob("*.npz"))) == N_TILES + 3
    shutil.rmtree(note.parent)


def test_second_run_is_refused_before_first_store(tmp_path):
    class Second(Run):
        def frames(self):
            with pytest.raises(BusyError, match="another skinrig process"):
                Run(self.out).run()
            return super().frames()

    expected = Run(tmp_path / "whole").run()
    assert Second(tmp_path / "out").run() == expected


def test_lock_removed_while_opened_is_replaced(tmp_path, monkeypatch):
    """A process that opened the lock of a finishing run must not lock the removed file."""
    first = Checkpoints(tmp_path / "work", "", RunRecord([], {}, {}))
    first._open()
    opened, opens = [], module.os.open

    def open_late(*arguments):
        opened.append(opens(*arguments))
        if len(opened) == 1:
            first.remove()
            first._close()
        return opened[-1]

    monkeypatch.setattr(module.os, "open", open_late)
    second = Checkpoints(tmp_path / "work", "", RunRecord([], {}, {}))
    second._open()
    third = Checkpoints(tmp_path / "work", "", RunRecord([], {}, {}))
    with pytest.raises(BusyError):
        third._open()
    second.remove()
    second._close()
    assert len(opened) == 3
    assert list(tmp_path.iterdir()) == []


def test_code_digest_changes_with_library_version(monkeypatch):
    found = set()
    for version in ("1", "2"):
        monkeypatch.setattr(module, "list_library_versions", lambda: {"trimesh": version})  # noqa: B023
        found.add(module.code_digest.__wrapped__(()))
    assert len(found) == 2
