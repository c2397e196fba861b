"""bench/results holds the newest measurement of each kind, an index, and no path of the machine that made them."""

from __future__ import annotations

import re
from collections import Counter

from tests.support.rig.rig import REPOSITORY

RESULTS = REPOSITORY / "bench" / "results"
_DAY = re.compile(r"-\d{4}-\d\d-\d\d")
_OF_A_MACHINE = re.compile(
    r"""(?:^|[\s"'(=])/(?:dev/shm|home|mnt|opt|root|srv|tmp|Users|usr|var|work)/""", re.MULTILINE
)


def names() -> set[str]:
    """The results without their suffixes: a page and its numbers are one result."""
    return {path.stem for path in RESULTS.iterdir() if path.name != "README.md"}


def test_every_result_has_its_line_in_the_index() -> None:
    lines = re.findall(r"(?m)^- \[(\S+)\]\((\S+)\): \S.+$", (RESULTS / "README.md").read_text(encoding="utf-8"))
    assert sorted(name for name, _ in lines) == sorted(names())
    assert [file for _, file in lines if not (RESULTS / file).is_file()] == []


def test_of_each_kind_the_newest_is_there_alone() -> None:
    kinds = Counter(_DAY.sub("", name) for name in names())
    assert {kind: count for kind, count in kinds.items() if count > 1} == {}


def test_no_result_names_a_path_of_the_machine_that_made_it() -> None:
    texts = {path.name: path.read_text(encoding="utf-8") for path in RESULTS.iterdir() if path.suffix != ".png"}
    assert {name for name, text in texts.items() if _OF_A_MACHINE.search(text)} == set()
