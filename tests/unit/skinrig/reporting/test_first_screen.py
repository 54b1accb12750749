"""First screen of a report: verdict, images with unit, and the words of all texts."""

import html as markup
import json
import re

import numpy as np
import pytest

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from reconstruction.pipeline.probe.stages import CHANNEL_NAMES, PROFILE_FILE
from skinrig.reporting import first_screen, page, report, verdict
from skinrig.reporting.sections.chromophore import draw_panels

SHAPE = (40, 50)
BANNED = (
    *"told tells says stands lies beside anew mend picture pictures gloss knows lobes".split(),
    *"furrow judged laid".split(),
    *("by itself", "set nothing", "hangs on", "left out"),
)
"""Words and phrases that no text of a report may have."""


def measured(values, unit="1", error=0.01):
    valid = np.ones(SHAPE, bool)
    valid[:, :5] = False
    return SkinMap(values, unit, np.full(np.shape(values), error), valid)


def flat_normals(rng):
    tilted = np.concatenate([0.1 * rng.random((*SHAPE, 2)), np.ones((*SHAPE, 1))], axis=2)
    return tilted / np.linalg.norm(tilted, axis=2, keepdims=True)


def map_of(name, rng):
    if name.startswith("normals"):
        return measured(flat_normals(rng), error=0.01)
    if name in ("image", "r_d", "translucency", "albedo"):
        return measured(0.2 + 0.1 * rng.random((*SHAPE, 3)), MAP_UNITS.get(name, "1"))
    return measured(0.02 + 0.1 * rng.random(SHAPE), MAP_UNITS.get(name, "um"))


RIGS = {
    "flash": ("image", "melanin", "hemoglobin"),
    "dome": ("r_d", "normals_refined"),
    "gradient": ("crossed_a000_n0", "normals_a000_n0", "height_a000_n0"),
    "moving": ("melanin", "hemoglobin", "hemoglobin_anger"),
    "microstructure": ("microrelief_forehead",),
    "stereo": ("normals", "albedo"),
}


def appearance_of(names, rng, **more):
    return SkinAppearance({name: map_of(name, rng) for name in names}, "simulated", **more)


def panels_of(appearances, truths=None):
    blocks = list(first_screen.draw_first_screen(appearances, truths or {}))
    return (blocks[0].data["panels"] if blocks else []), page.render_fragment(blocks)


@pytest.mark.parametrize("rig", RIGS)
def test_first_screen_has_no_empty_frame(rig, rng):
    panels, html = panels_of({rig: appearance_of(RIGS[rig], rng)})
    assert len(panels) == min(len(RIGS[rig]), len({one.title for one in panels}))
    assert panels
    for one in panels:
        assert len(one.images) == 2  # the estimate and its uncertainty
        assert all(image.alt and image.address.startswith("data:image/") for image in one.images)
        assert all(image.size[0] > 0 for image in one.images)
        assert one.scale or one.legend or all(image.scale for image in one.images)
    assert html.count("<img") == 2 * len(panels)
    assert first_screen.GRAY_MEANS in html


def test_probe_alone_shows_its_radial_profile():
    channel = {"reflectance_per_mm2": [1.0, 0.1], "stderr": [0.1, 0.01], "valid": [True, True]}
    entry = {
        "name": "cheek_r0_a000.0",
        "site": "cheek",
        "repeat": 0,
        "angle_deg": 0.0,
        "channels": dict.fromkeys(CHANNEL_NAMES, channel),
    }
    document = {"radius_mm": [1.0, 2.0], "measurements": [entry]}
    files = {PROFILE_FILE: json.dumps(document).encode()}
    panels, html = panels_of({"probe": SkinAppearance({}, "simulated", files=files)})
    assert [one.title for one in panels] == ["radial profile"]
    assert "<svg" in html
    assert "<img" not in html


def test_light_stack_shows_normals_and_albedo(rng):
    blocks = list(draw_panels(appearance_of(RIGS["stereo"], rng), None))
    assert [one.text for one in blocks if isinstance(one, page.Heading)] == ["albedo", "normals"]
    titles = [[i.title for i in one.images] for one in blocks if isinstance(one, page.Images)]
    assert titles == [["estimate", "standard uncertainty"]] * 2


def test_first_screen_without_maps_has_no_strip(rng):
    nothing = SkinMap(np.zeros(SHAPE), MAP_UNITS["melanin"], None, np.zeros(SHAPE, bool))
    assert panels_of({"empty": SkinAppearance({"melanin": nothing}, "simulated")})[1].strip() == ""


def test_estimate_and_ground_truth_share_one_color_bar(rng):
    flash = appearance_of(("melanin",), rng)
    truth = SkinAppearance(
        {"melanin": SkinMap(np.full(SHAPE, 0.3), MAP_UNITS["melanin"])}, "simulated"
    )
    (panel,), html = panels_of({"flash": flash}, {"flash": truth})
    assert [image.title for image in panel.images] == ["estimate", "ground truth"]
    assert panel.scale.high == "0.3"  # of the ground truth, above all estimates
    assert html.count('class="bar ') == 1
    assert "volume fraction</span>" in html


def test_first_screen_states_filled_part_of_map(rng):
    normals = map_of("normals_refined", rng)
    of_texel = np.ones(SHAPE)
    rows, columns = np.nonzero(normals.mask)
    filled = len(rows) // 4
    of_texel[rows[:filled], columns[:filled]] = 0.0
    maps = {
        "normals_refined": normals,
        "normals_refined_measured": SkinMap(of_texel, "1", None, normals.mask),
    }
    (panel,), html = panels_of({"double": SkinAppearance(maps, "simulated")})
    share = f"estimate, {100.0 * filled / len(rows):.1f} % filled"
    assert panel.images[0].title == share
    assert share in html


def test_collection_takes_each_quantity_from_the_best_set(rng):
    sets = {
        "a-without-truth": appearance_of(("melanin",), rng),
        "dome": appearance_of(("normals_refined",), rng),
        "flash": appearance_of(("image", "melanin", "hemoglobin"), rng),
    }
    truths = {"flash": SkinAppearance({"melanin": map_of("melanin", rng)}, "simulated")}
    panels, _ = panels_of(sets, truths)
    assert [(one.title, one.source) for one in panels] == [
        ("captured image", "flash"),
        ("melanosome volume fraction", "flash"),
        ("blood volume fraction", "flash"),
        ("surface normals", "dome"),
    ]


def test_captured_image_keeps_its_own_white_balance(rng):
    radiance = 0.1 + 0.2 * rng.random((*SHAPE, 3))
    captured = SkinAppearance({"image": SkinMap(radiance * [1.2, 0.6, 0.8], "1")}, "simulated")
    truth = SkinAppearance({"diffuse_radiance": SkinMap(radiance, "1")}, "simulated")
    (panel,), _ = panels_of({"flash": captured}, {"flash": truth})
    assert [image.title for image in panel.images] == ["captured", "ground truth"]
    assert panel.images[0].address == panel.images[1].address


@pytest.mark.parametrize("words", [1, 5, 9, 10, 40])
@pytest.mark.parametrize("got", [0.5, 2.0])
def test_verdict_has_at_most_25_words(words, got):
    name = " ".join(["word"] * words)
    checks = [page.Check(name, got, 1.0, "<=", "%"), page.Check("other", 0.1, 1.0, "<=")] * 17
    sentence = verdict.format_headline(checks)
    assert len(sentence.split()) <= 25
    assert (name in sentence) == (words <= verdict.MAX_NAME_WORDS)
    assert sentence.count(".") == 1


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """Return the report of each rig and of two runs."""
    folder, rng = tmp_path_factory.mktemp("words"), np.random.default_rng(12345)
    texts = {}
    for rig in ("flash", "stereo"):
        for run in ("one", "two"):
            made = appearance_of(
                RIGS[rig], rng, parameters={"truth": "truth"}, left_out=(("tsumura", "not wanted"),)
            )
            store.write(folder / rig / run / "maps", made)
            maps = {
                f"{name}{suffix}": map_of(name, rng)
                for name in ("melanin", "hemoglobin")
                for suffix in ("", "_blurred")
            }
            if rig == "flash":
                truth = SkinAppearance(maps, "simulated", parameters={"kind": "truth"})
                store.write(folder / rig / run / "truth", truth)
        texts[rig] = report.build([folder / rig / "one"])
        texts[f"{rig}, compared"] = report.build_any(
            [folder / rig / run for run in ("one", "two")]
        ).html
    return texts


def texts_of(html):
    """Return all that a reader sees or hears of a page, folded texts among it."""
    body = html[html.index("<body") :]
    heard = " ".join(re.findall(r'(?:alt|aria-label)="([^"]*)"', body))
    body = re.sub(r"<(?:style|code)\b.*?</(?:style|code)>", " ", body, flags=re.DOTALL)
    text = markup.unescape(re.sub(r"<[^>]+>", " ", body) + " " + heard).casefold()
    return re.sub(r"\([a-z0-9_]+\)", "", text)  # names of files behind labels


@pytest.mark.long
@pytest.mark.parametrize("word", BANNED)
def test_report_texts_have_no_banned_word(reports, word):
    for name, html in reports.items():
        found = re.search(rf".{{0,60}}\b{word}\b.{{0,40}}", texts_of(html))
        assert found is None, f"{name}: {found[0]}"


@pytest.mark.long
def test_report_texts_write_ground_truth(reports):
    for html in reports.values():
        results = texts_of(html).split("provenance")[0]  # behind it: names of parameters
        assert not re.search(r"(?<!ground )\btruths?\b", results)


@pytest.mark.long
def test_report_sentences_have_at_most_25_words(reports):
    for html in reports.values():
        for text in re.findall(r"<(?:p|li|caption|h2|h3)\b[^>]*>(.*?)</", html, re.DOTALL):
            for sentence in re.split(r"[.;:] ", markup.unescape(re.sub(r"<[^>]+>", "", text))):
                assert len(re.findall(r"[\w'-]+", sentence)) <= 25, sentence


@pytest.mark.long
def test_first_images_come_before_the_first_section(reports):
    html = reports["flash"]
    assert html.index('class="verdict') < html.index("<img") < html.index("<h2")
