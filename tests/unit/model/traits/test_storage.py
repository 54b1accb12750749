import dataclasses
import io
import json
from importlib import resources

import numpy as np
import pytest

from model.traits import storage as trait_storage
from model.traits.feasible_sets import HistogramSet, NonNegativeSet
from model.traits.space import TraitSpace
from model.traits.storage import TraitFileError, TraitLibrary


@pytest.fixture(scope="module")
def library():
    rng = np.random.default_rng(12345)
    label = np.arange(24) < 9
    base = rng.random((24, 5, 256)) ** 4 * (1.0 + label[:, None, None] * rng.random((5, 256)))
    albedo = (base / base.sum(axis=-1, keepdims=True)).reshape(24, -1)
    surface = rng.random((24, 4)) + 0.5 * label[:, None]
    metric = np.eye(4) + 0.3
    age = rng.uniform(20.0, 60.0, 24)
    return TraitLibrary(
        {
            "albedo": TraitSpace.fit(albedo, {"tan": label}, continuous={"age": age}),
            "surface": TraitSpace.fit(
                surface,
                {"lotion": label, "rare": np.arange(24) == 20},
                metric=metric,
                space="nmf",
                basis=np.eye(4),
                names=tuple("abcd"),
                seed=3,
            ),
        },
        "simulated",
        parameters={"people": 24},
        files={"texture.npz": b"edges"},
    )


def test_library_round_trips_through_storage(library):
    back = trait_storage.from_bytes(library.to_bytes(precision="float64"))
    assert back.source == "simulated"
    assert back.parameters == {"people": 24}
    assert back.files == {"texture.npz": b"edges"}
    assert back.names == ("age", "lotion", "rare", "tan")
    for name, space in library.spaces.items():
        got = back.spaces[name]
        for field in dataclasses.fields(space):
            if field.name == "traits":
                continue
            a, b = getattr(got, field.name), getattr(space, field.name)
            if isinstance(b, np.ndarray):
                np.testing.assert_array_equal(a, b)
            elif field.name != "storage_error":
                assert a == b
        for trait in space.traits.values():
            for field in dataclasses.fields(trait):
                a, b = getattr(got.trait(trait.name), field.name), getattr(trait, field.name)
                if isinstance(b, np.ndarray):
                    np.testing.assert_array_equal(a, b)
                else:
                    assert a == b
    assert back.spaces["albedo"].storage_error == {"tan": 0.0, "age": 0.0}


@pytest.mark.parametrize(
    ("precision", "bound"), [("float32", 1e-6), ("float16", 1e-2), ("int8", 2e-2)]
)
def test_fewer_bits_change_vectors_by_the_stated_error(library, precision, bound):
    stored = library.to_bytes(precision=precision)
    back = trait_storage.from_bytes(stored).spaces["albedo"]
    for name, trait in library.spaces["albedo"].traits.items():
        gap = np.linalg.norm(back.trait(name).vector - trait.vector)
        told = back.storage_error[name]
        assert gap / np.linalg.norm(trait.vector) == pytest.approx(told, rel=1e-6, abs=1e-12)
        assert told < bound
    assert len(stored) < len(library.to_bytes(precision="float64"))


def test_low_bit_edits_stay_feasible_amount_0_identity(library):
    back = trait_storage.from_bytes(library.to_bytes(precision="int8")).spaces["albedo"]
    source = library.spaces["albedo"].center
    edited = back.edit(source, {"tan": 0.8})
    assert HistogramSet().contains(edited)
    np.testing.assert_array_equal(back.edit(source, {"tan": 0.0}), source)
    assert HistogramSet().contains(back.mean_with("tan"))
    mixed = back.edit(source, {"tan": 1.0}, mode="convex")
    np.testing.assert_allclose(mixed, back.mean_with("tan"), atol=1e-12)


def test_short_samples_are_stored_exactly(library):
    back = trait_storage.from_bytes(library.to_bytes(precision="int8")).spaces["surface"]
    lotion = library.spaces["surface"].trait("lotion")
    np.testing.assert_array_equal(back.trait("lotion").vector, lotion.vector)
    assert back.feasible == NonNegativeSet()
    assert np.isinf(back.trait("rare").confidence.relative_noise) == np.isinf(
        library.spaces["surface"].trait("rare").confidence.relative_noise
    )


def test_files_are_saved_and_loaded(library, tmp_path):
    library.save(tmp_path / "traits")
    assert trait_storage.load(tmp_path / "traits").names == library.names


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(TraitFileError, match=r"nothing\.npz: cannot be read: No such file"):
        trait_storage.load(tmp_path / "nothing.npz")


@pytest.mark.parametrize("damage", ["text", "cut", "other npz", "version", "lost array"])
def test_damaged_files_are_refused(library, damage, tmp_path):
    good = library.to_bytes()
    with np.load(io.BytesIO(good)) as stored:
        arrays = dict(stored)
    document = json.loads(arrays["document"].tobytes())
    if damage == "version":
        document["schema"] = "skinrig.traits/9"
    if damage == "lost array":
        del arrays["albedo/vectors"]
    arrays["document"] = np.frombuffer(json.dumps(document).encode(), np.uint8)
    stream = io.BytesIO()
    np.savez(stream, **({"a": np.zeros(3)} if damage == "other npz" else arrays))
    content = {"text": b"no npz", "cut": good[: len(good) // 2]}.get(damage, stream.getvalue())
    (tmp_path / "space.npz").write_bytes(content)
    with pytest.raises(TraitFileError, match=r"space\.npz: "):
        trait_storage.load(tmp_path / "space.npz")


def test_packaged_traits_are_simulated_and_report_truth_error():
    library = trait_storage.load_packaged_traits()
    assert library.source == "simulated"
    worn = {"cold", "hot", "sweat", "lotion", "makeup", "powder"}
    assert worn <= set(library.spaces["surface"].traits)
    assert {"tan", "beard", "freckles", "age", "male", "asian"} <= set(
        library.spaces["albedo"].traits
    )
    told = library.parameters["cosine_to_truth"]
    assert worn <= set(told["surface"])
    assert told["surface"]["lotion"] > 0.95
    assert min(told["albedo"][name] for name in ("tan", "beard", "hot", "cold", "makeup")) > 0.9
    size = len(resources.files("model").joinpath("data", trait_storage.PACKAGED_FILE).read_bytes())
    assert size <= 1_500_000
    for space in library.spaces.values():
        assert max(space.storage_error.values()) < 0.03


def test_packaged_lotion_sharpens_skin_and_is_removable():
    space = trait_storage.load_packaged_traits().spaces["surface"]
    bare = space.center - 0.5 * space.trait("lotion").vector
    bare = space.feasible.project(bare, space.metric)
    oiled = space.edit_with_outcome(bare, {"lotion": 0.6})
    sharp = np.array([n in ("ggx 0.14 eta 1.4", "ggx 0.18 eta 1.4") for n in space.names])
    kin = space.metric[sharp].sum(axis=0)
    assert oiled.sample @ kin > 1.05 * (bare @ kin)
    back = space.edit(oiled.sample, {"lotion": -0.6})
    gap = np.sqrt((back - bare) @ space.metric @ (back - bare))
    assert gap <= oiled.return_bound + 1e-9
    assert oiled.clipped_fraction < 0.1
