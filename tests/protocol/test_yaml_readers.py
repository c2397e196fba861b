"""YAML is read by libyaml where PyYAML's own parser reads the same; that one has the last word on what is wrong."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from service.core.checked_yaml import YamlTree, parse_yaml
from service.core.errors import ProtocolError

PROTOCOLS = sorted((Path(__file__).parents[2] / "protocols").rglob("*.yaml"))
LIBRARY = "service.core.checked_yaml._library_loader"
# Texts on which the two parsers differ, or did in some version.
DIFFERENT = (
    *("|#\n", "a: >2#c\n", "{a: mm?}", "[b? c]", "!~ a", "a: !15", "[!<tag:x>, 1]", "a:\tb\n", "%YAML 1.3\n--- a"),
    *("a\r\nb", "a: \x85b", "\ufeffa: b", "a: \ud800", 'a: "\\UFFFFFFFF"', "a: b\x00", "a: &a [*a]", "*b", "a: *"),
)
PARTS = (
    *"ab10.:-,[]{}'\"#&*!|>?@`~=+\\ \n\n  ",
    *("- ", ": ", "? ", "a: ", "\n  ", "\n- ", "&a ", "*a", "!!str ", "|\n", "|-\n  x\n", ">+\n", "---\n", "...\n"),
    *("%", "é", "😀", "\u2028", "\t", "\r\n", "\\n", "\\x41", "\\u12", "null", "true", "'it''s'", '"a b"', "<<"),
    *("|2\n", "# c"),
)
TEXTS = 1000


def read(text: str) -> YamlTree | str:
    """What is in the text, or the words that say why not."""
    try:
        return parse_yaml(text, name="lab.yaml")
    except ProtocolError as error:
        return str(error)


def composed(seed: int) -> str:
    """A text of a few parts that mean something in YAML."""
    draw = random.Random(seed)
    return "".join(draw.choices(PARTS, k=draw.randint(1, 14)))


def test_both_readers_give_the_same_data_lines_problems_and_words(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = [*DIFFERENT, *map(composed, range(TEXTS)), *(path.read_text(encoding="utf-8") for path in PROTOCOLS)]
    found = [read(text) for text in texts]
    monkeypatch.setattr(LIBRARY, None)
    for text, as_read in zip(texts, found, strict=True):
        assert repr(read(text)) == repr(as_read), text
    assert sum(isinstance(as_read, YamlTree) for as_read in found) > TEXTS / 5


def test_our_protocols_are_read_by_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    class UsedError(Exception):
        """The library would have read it."""

    def used(text: str, name: str) -> None:
        raise UsedError(text, name)

    monkeypatch.setattr(LIBRARY, used)
    for path in PROTOCOLS:
        with pytest.raises(UsedError):
            parse_yaml(path.read_text(encoding="utf-8"), name=path.name)
