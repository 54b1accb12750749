"""Names, texts and manuals use the field's words; the dialect of earlier versions stays out."""

import ast
import io
import re
import tokenize
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import accumulate
from pathlib import Path

import pytest
from fixtures.product_code import PACKAGES, ROOT, modules, nodes_of, text_of, tree_of

HISTORY = ("CHANGELOG.md", "docs/decisions")
"""Quoted history keeps its words."""

WORDS = {
    "told, tells": re.compile(r"\b(tell|tells|told|telling)\b", re.IGNORECASE),
    "says, said": re.compile(r"\b(say|says|said|saying)\b", re.IGNORECASE),
    "stands": re.compile(r"\b(stands|stood)\b", re.IGNORECASE),
    "anew": re.compile(r"\banew\b", re.IGNORECASE),
    "mend": re.compile(r"\bmend(s|ed|ing)?\b", re.IGNORECASE),
    "beside": re.compile(r"\bbeside\b", re.IGNORECASE),
    "hangs on": re.compile(r"\bhangs? on\b", re.IGNORECASE),
    "set nothing": re.compile(r"\bset nothing\b", re.IGNORECASE),
    "is no": re.compile(
        r"\b(is|are|was|were) no (?!longer|more|less|larger|smaller|greater|worse|better)",
        re.IGNORECASE,
    ),
    "a light for per light": re.compile(
        r"\b(one|two|three|four|[0-9]+(?:\.[0-9]+)?|mm|um|px|seconds|pixels|texels|points|images|frames|shots"
        r"|lights|cameras|rays|samples|lines|files|folders|values|numbers|pairs|steps|exposures"
        r"|maps|rows|columns|colors|photographs|names|placements|directions|faces|lobes|sides)"
        r" an? (light|pixel|texel|side|image|picture|frame|shot|point|band|state|step|site|camera"
        r"|view|rig|stage|case|color|channel|session|face|person|subject|row|line|file|folder"
        r"|second|minute|direction|placement|exposure|fiber|angle|condition|region)\b",
        re.IGNORECASE,
    ),
}
"""A dialect's word or idiom, and where it begins and ends."""

STEMS = {
    "told, tells": ("tell", "told"),
    "says, said": ("say", "said"),
    "stands": ("stands", "stood"),
    "anew": ("anew",),
    "mend": ("mend",),
    "beside": ("beside",),
    "hangs on": ("hang",),
    "set nothing": ("set nothing",),
    "is no": (" no ",),
    "a light for per light": (" a ", " an "),
}
"""Letters without which a text has no match: few texts are left for the slower patterns."""

QUESTION = re.compile(
    r"""(?:#[^\n]*\n|\s)*[rR]?["']{1,3}\s*(What|How|Where|Whether|Which|Who|Why|When)\b"""
)
"""A module's docstring that begins as a question does."""
TEST_NAME = re.compile(r"^(?:async )?def test_(\w+)", re.MULTILINE)
FIELD_SYMBOLS = frozenset(
    "ETA ISO F0 SCHEMA CASES RIGS STAGES FORMATS BOXES KIND DRIVER RECIPE NEUTRAL FOREHEAD".split()
)
"""One-word constants that are symbols of the field, or what the house finds a part by."""
PARTICIPLES = frozenset(
    "told seen shown drawn known held kept built made laid lit given taken worn born sold spent"
    " meant lost found sought once twice alone together apart beside anew ahead away either neither"
    " both enough often always never".split()
)


def documents() -> list[Path]:
    """Return the manuals, history apart."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [
        path
        for path in found
        if path.exists() and not str(path.relative_to(ROOT)).startswith(HISTORY)
    ]


@cache
def identifier_words(name: str) -> str:
    """Return an identifier as separate words.

    >>> identifier_words("MAX_toldOf")
    'MAX told Of'
    """
    return " ".join(re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name))


def names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield each name that a module defines, with its line."""
    for node in nodes_of(tree, ast.FunctionDef, ast.ClassDef):
        yield node.lineno, node.name
    for node in nodes_of(tree, ast.arg):
        yield node.lineno, node.arg
    for node in nodes_of(tree, ast.Name):
        if isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id


def comments(text: str) -> Iterator[tuple[int, str]]:
    """Yield the comments of a module; none where no text after a # has a word of the list."""
    after_sign = (line[line.index("#") :] for line in text.splitlines() if "#" in line)
    if not any(hits(enumerate(after_sign))):
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield strings and comments of a module, line by line, and the words of its names."""
    for node in nodes_of(tree_of(path), ast.Constant):
        if isinstance(node.value, str):
            for offset, line in enumerate(node.value.splitlines()):
                yield node.lineno + offset, line
    yield from comments(text_of(path))
    for name, line in {name: line for line, name in names(tree_of(path))}.items():
        yield line, identifier_words(name)


def hits(lines: Iterable[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield the numbers of lines with a word of the list, and the word."""
    known = list(lines)
    text = "\n".join(line.replace("\n", " ") for _, line in known)
    starts = list(accumulate((len(line) + 1 for _, line in known), initial=0))
    lower = text.lower()
    for word, pattern in WORDS.items():
        if not any(stem in lower for stem in STEMS[word]):
            continue
        for found in pattern.finditer(text):
            number = known[bisect_right(starts, found.start()) - 1][0]
            around = text[max(found.start() - 30, 0) : found.end() + 30]
            yield number, f"{word}: {' '.join(around.split())}"


@pytest.mark.parametrize("package", PACKAGES)
def test_package_texts_and_names_hold_no_dialect(package):
    lines = [(path, hits(texts(path))) for path in modules(package)]
    lines += [
        (path, hits(enumerate(path.read_text("utf-8").splitlines(), 1)))
        for kind in ("html", "js", "toml")
        for path in sorted((ROOT / package).rglob(f"*.{kind}"))
    ]
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text}" for path, some in lines for line, text in some
    ]
    assert not found, "\n".join(found)


def test_manuals_hold_no_dialect():
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in documents()
        for line, text in hits(enumerate(path.read_text().splitlines(), 1))
    ]
    assert not found, "\n".join(found)


def test_test_names_are_short_and_plain():
    found = []
    for path in modules("tests"):
        names = TEST_NAME.findall(text_of(path))
        named = {number for number, _ in hits(enumerate(n.replace("_", " ") for n in names))}
        found += [
            f"{path.relative_to(ROOT)}: test_{name}"
            for number, name in enumerate(names)
            if number in named or name.count("_") > 7
        ]
    assert not found, "\n".join(found)


def test_module_docstrings_state_and_do_not_ask():
    found = [
        str(path.relative_to(ROOT))
        for path in modules(*PACKAGES, "tests", "tools")
        if QUESTION.match(text_of(path))
    ]
    assert not found, "\n".join(found)


def test_constants_have_more_than_one_word():
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {target.id}"
        for path in modules(*PACKAGES)
        for node in tree_of(path).body
        if isinstance(node, (ast.Assign, ast.AnnAssign))
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name)
        and re.fullmatch(r"[A-Z][A-Z0-9]+", target.id)
        and target.id not in FIELD_SYMBOLS
    ]
    assert not found, "\n".join(found)


def test_public_names_have_a_noun_or_verb():
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
        for path in modules(*PACKAGES)
        for node in tree_of(path).body
        if isinstance(node, (ast.FunctionDef, ast.ClassDef))
        and not node.name.startswith("_")
        and is_lone_adverb_or_participle(node.name)
    ]
    assert not found, "\n".join(found)


def is_lone_adverb_or_participle(name: str) -> bool:
    """Return whether a name is one word that is an adverb or a participle.

    >>> [is_lone_adverb_or_participle(name) for name in ("patiently", "told", "read", "seed")]
    [True, True, False, False]
    """
    word = name.lower()
    if "_" in name or identifier_words(name).count(" "):
        return False
    ending = re.fullmatch(r"\w{2,}(ly|[^e]ed)", word) is not None
    return word in PARTICIPLES or (
        ending and word not in {"assembly", "seed", "speed", "apply", "reply"}
    )


@pytest.mark.parametrize(
    "text",
    [
        "each picture tells how much there is",
        "what stands above it",
        "the folder is no session",
        "rays a pixel",
        "2.1 mm a pixel",
        "measured anew",
        "It Told and TELLS",
        "as the table says",
        "where it stood",
        "to mend it",
        "beside the map",
        "it hangs on the light",
        "seeds that set nothing",
    ],
)
def test_dialect_would_be_found(text):
    assert list(hits(iter([(1, text)])))


def test_question_as_docstring_would_be_found():
    assert QUESTION.match('# SPDX\n"""Where the light goes."""\n')
    assert not QUESTION.match('"""Whereabouts of lights. What else."""\n')


def test_long_test_name_would_be_found():
    names = TEST_NAME.findall("def test_a_b():\n    def test_inner(): ...\n\ndef test_c(x):\n")
    assert names == ["a_b", "c"]


@pytest.mark.parametrize(
    "text", ["this is no longer read", "switch on a light", "rays per pixel", "recommended"]
)
def test_plain_sentences_pass(text):
    assert not list(hits(iter([(1, text)])))
