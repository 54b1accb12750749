import pytest

from reconstruction.pipeline.graph import PipelineStage, StageError, order_stages, run_stages


def graph(calls, gain=2):
    def note(name, result):
        def work(**inputs):
            calls.append(name)
            return result(**inputs)

        return work

    return [
        PipelineStage("read", (), ("frames",), note("read", lambda: {"frames": 3})),
        PipelineStage(
            "scale",
            ("frames",),
            ("radiance",),
            note("scale", lambda frames: {"radiance": gain * frames}),
            {"gain": gain},
        ),
        PipelineStage(
            "invert",
            ("radiance",),
            ("map", "error"),
            note("invert", lambda radiance: {"map": radiance + 1, "error": 0.1}),
        ),
        PipelineStage(
            "other", ("frames",), ("unwanted",), note("other", lambda frames: {"unwanted": 0})
        ),
    ]


def test_only_ancestors_of_requested_products_run():
    calls = []
    outcome = run_stages(graph(calls), ["map"])
    assert calls == ["read", "scale", "invert"]
    assert outcome.products == {"map": 7}
    assert outcome.omitted == (("other", "no wanted product depends on it"),)


def test_asking_for_nothing_new_does_no_work():
    calls, cache = [], {}
    run_stages(graph(calls), ["map"], cache=cache)
    calls.clear()
    outcome = run_stages(graph(calls), ["map"], cache=cache)
    assert calls == []
    assert outcome.reused == ("invert",)
    assert outcome.products == {"map": 7}


def test_changed_parameter_reruns_only_its_dependents():
    calls, cache = [], {}
    run_stages(graph(calls), ["map"], cache=cache)
    calls.clear()
    outcome = run_stages(graph(calls, gain=5), ["map"], cache=cache)
    assert calls == ["scale", "invert"]
    assert outcome.reused == ("read",)
    assert outcome.products == {"map": 16}


def test_unknown_map_error_lists_available_maps():
    with pytest.raises(StageError, match=r"'melanine'.*expected one of .*map"):
        run_stages(graph([]), ["melanine"])


def test_stages_that_need_each_other_are_refused():
    stages = [PipelineStage("a", ("y",), ("x",), dict), PipelineStage("b", ("x",), ("y",), dict)]
    with pytest.raises(StageError, match="a -> b -> a"):
        order_stages(stages, ["x"])


def test_two_makers_of_same_product_are_refused():
    stages = [PipelineStage("a", (), ("x",), dict), PipelineStage("b", (), ("x",), dict)]
    with pytest.raises(StageError, match="made by"):
        order_stages(stages, ["x"])


def test_stage_making_wrong_product_is_detected():
    with pytest.raises(StageError, match="made"):
        run_stages([PipelineStage("a", (), ("x",), lambda: {"z": 1})], ["x"])


class Folder(dict):
    """Keeps maps and files alone, as a finished folder does, not what stages hand each other."""

    def __init__(self, *kept):
        super().__init__()
        self.kept = kept

    def __setitem__(self, key, products):
        kept = {name: value for name, value in products.items() if name in self.kept}
        if kept:
            super().__setitem__(key, kept)


def surface_graph(calls):
    """Stages that make a map and hand something on, and one whose map comes with a file."""

    def note(name, result):
        def work(**inputs):
            calls.append(name)
            return result(**inputs)

        return work

    return [
        PipelineStage("samples", (), ("samples",), note("samples", lambda: {"samples": 4})),
        PipelineStage(
            "normals",
            ("samples",),
            ("point_normals", "normals"),
            note("normals", lambda samples: {"point_normals": samples, "normals": -samples}),
        ),
        PipelineStage(
            "lobes",
            ("samples", "point_normals"),
            ("weight", "basis.npz"),
            note(
                "lobes",
                lambda samples, point_normals: {
                    "weight": samples * point_normals,
                    "basis.npz": b"table",
                },
            ),
        ),
    ]


def test_stage_with_kept_map_but_lost_product_reruns():
    calls, folder = [], Folder("normals", "weight", "basis.npz")
    first = run_stages(surface_graph(calls), ["normals"], cache=folder)
    assert first.ran == ("samples", "normals")
    calls.clear()
    outcome = run_stages(surface_graph(calls), ["normals", "weight"], cache=folder)
    # the lobes need what the normals hand on, and nobody kept that
    assert calls == ["samples", "normals", "lobes"]
    assert outcome.products == {"normals": -4, "weight": 16}
    assert outcome.ran == ("samples", "normals", "lobes")
    assert outcome.reused == ()
    assert outcome.omitted == ()


def test_kept_map_is_not_remade_for_independent_stage():
    calls, folder = [], Folder("normals", "weight", "basis.npz")
    run_stages(surface_graph(calls), ["weight"], cache=folder)
    calls.clear()
    outcome = run_stages(surface_graph(calls), ["normals", "weight"], cache=folder)
    assert calls == []
    assert set(outcome.reused) == {"normals", "lobes"}
    assert outcome.omitted == (("samples", "the stages that depend on it were reused"),)


def test_files_accompany_maps_of_their_stage():
    calls, folder = [], Folder("normals", "weight", "basis.npz")
    made = run_stages(surface_graph(calls), ["weight", "basis.npz"], cache=folder).products
    again = run_stages(surface_graph(calls), ["basis.npz"], cache=folder)
    assert made["basis.npz"] == again.products["basis.npz"] == b"table"
    assert again.ran == ()
    assert calls == ["samples", "normals", "lobes"]


def test_partly_reusable_stage_is_made_whole():
    """A folder that lost one of two maps of a stage has neither made from other inputs."""
    calls, folder = [], Folder("weight")
    run_stages(surface_graph(calls), ["weight"], cache=folder)
    calls.clear()
    outcome = run_stages(surface_graph(calls), ["weight", "basis.npz"], cache=folder)
    assert calls == ["samples", "normals", "lobes"]
    assert outcome.products == {"weight": 16, "basis.npz": b"table"}
    assert outcome.reused == ()


def test_known_refusal_is_raised_before_computation():
    ran = []
    costly = PipelineStage("costly", (), ("x",), lambda: ran.append(1) or {"x": 1})
    refused = PipelineStage("scaled", ("x",), ("y",), lambda x: {"y": x}, refused="y: has no scale")
    with pytest.raises(StageError, match="has no scale"):
        run_stages([costly, refused], ["x", "y"])
    assert ran == []
    assert run_stages([costly, refused], ["x"]).products == {"x": 1}
