"""A mapping that grows by versions: each version stays unchanged, whatever is added later."""

from __future__ import annotations

import copy
import pickle

from hypothesis import given
from hypothesis import strategies as st

from service.core.run.effects import PersistentMap, put

KEYS = st.sampled_from(["a", "b", "c", "d"])


@given(st.lists(st.tuples(st.integers(0, 30), KEYS, st.integers()), max_size=30))
def test_every_version_is_the_dict_that_it_would_have_been(puts: list[tuple[int, str, int]]) -> None:
    versions: list[tuple[PersistentMap[int], dict[str, int]]] = [(PersistentMap({"a": 0}), {"a": 0})]
    for choice, key, value in puts:  # of any version, not only the newest
        grown, plain = versions[choice % len(versions)]
        versions.append((grown.put(key, value), {**plain, key: value}))
    for grown, plain in versions:
        assert grown == plain
        assert list(grown.items()) == list(plain.items())
        assert len(grown) == len(plain)
        assert [key in grown for key in "abcde"] == [key in plain for key in "abcde"]
        assert copy.deepcopy(grown) == pickle.loads(pickle.dumps(grown)) == plain


def test_a_line_of_versions_shares_its_items() -> None:
    grown: PersistentMap[int] = PersistentMap()
    for k in range(1000):
        grown = put(grown, str(k), k)
    first, store = PersistentMap[int]().put("x", 1), grown
    assert len(pickle.dumps(store)) < 50_000
    assert first != grown
    assert put({"x": 1}, "y", 2) == {"x": 1, "y": 2}
    assert repr(first) == "PersistentMap({'x': 1})"
