import pytest

from reconstruction.stages import Stage, StageError, order, run


class Memory(dict):
    def load(self, key):
        return self.get(key)

    def save(self, key, products):
        self[key] = dict(products)


def graph(calls, gain=2):
    def note(name, result):
        def work(**inputs):
            calls.append(name)
            return result(**inputs)

        return work

    return [
        Stage("read", (), ("frames",), note("read", lambda: {"frames": 3})),
        Stage(
            "scale", ("frames",), ("radiance",),
            note("scale", lambda frames: {"radiance": gain * frames}), {"gain": gain},
        ),
        Stage("invert", ("radiance",), ("map", "error"),
              note("invert", lambda radiance: {"map": radiance + 1, "error": 0.1})),
        Stage("other", ("frames",), ("unwanted",), note("other", lambda frames: {"unwanted": 0})),
    ]  # fmt: skip


def test_only_the_ancestors_of_what_is_wanted_run():
    calls = []
    outcome = run(graph(calls), ["map"])
    assert calls == ["read", "scale", "invert"]
    assert outcome.products == {"map": 7}
    assert outcome.left_out == (("other", "nothing wanted depends on it"),)


def test_asking_for_nothing_new_does_no_work():
    calls, cache = [], Memory()
    run(graph(calls), ["map"], cache=cache)
    calls.clear()
    outcome = run(graph(calls), ["map"], cache=cache)
    assert calls == []
    assert outcome.reused == ("invert",)
    assert outcome.products == {"map": 7}


def test_a_changed_parameter_runs_again_what_depends_on_it_and_no_more():
    calls, cache = [], Memory()
    run(graph(calls), ["map"], cache=cache)
    calls.clear()
    outcome = run(graph(calls, gain=5), ["map"], cache=cache)
    assert calls == ["scale", "invert"]
    assert outcome.reused == ("read",)
    assert outcome.products == {"map": 16}


def test_an_unknown_map_is_named_with_those_that_can_be_made():
    with pytest.raises(StageError, match=r"'melanine'.*expected one of .*map"):
        run(graph([]), ["melanine"])


def test_stages_that_need_each_other_are_refused():
    stages = [Stage("a", ("y",), ("x",), dict), Stage("b", ("x",), ("y",), dict)]
    with pytest.raises(StageError, match="a -> b -> a"):
        order(stages, ["x"])


def test_two_makers_of_one_product_are_refused():
    stages = [Stage("a", (), ("x",), dict), Stage("b", (), ("x",), dict)]
    with pytest.raises(StageError, match="made by"):
        order(stages, ["x"])


def test_a_stage_that_makes_something_else_is_found_out():
    with pytest.raises(StageError, match="made"):
        run([Stage("a", (), ("x",), lambda: {"z": 1})], ["x"])
