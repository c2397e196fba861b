"""The stand-alone verifier's own JSON: canonical as RFC 8785 says, and no other text is read."""

from __future__ import annotations

import io
from typing import IO

import pytest
import rfc8785
from hypothesis import example, given, settings
from hypothesis import strategies as st

from service.audit import bundle_verifier

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53) + 1, 2**53 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner, max_size=4)
    ),
    max_leaves=10,
)


class Lines(bundle_verifier.Bundle):
    """Files of a bundle that are only in memory."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self._files = files
        self.sizes = {name: len(content) for name, content in files.items()}

    def open(self, name: str) -> IO[bytes]:
        return io.BytesIO(self._files[name])


@pytest.mark.slow
@given(VALUES)
@settings(deadline=None, max_examples=300)
@example({"\u20ac": 1, "\r": 2, "\ufb33": 3, "1": 4, "\U0001f600": 5, "\x80": 6, "\u00f6": 7})
@example('\x00\x1f\x7f\u2028/\\"\b\t\n\f\r')
def test_canonical_json_is_rfc_8785(value: object) -> None:
    text = bundle_verifier.canonical(value)
    assert text == rfc8785.dumps(value)  # pyright: ignore[reportArgumentType]  # any JSON value
    assert bundle_verifier.canonical(bundle_verifier.parse(text)) == text


@given(st.floats(allow_nan=False, allow_infinity=False))
@settings(deadline=None, max_examples=1000)
@example(1e21)
@example(123456789012345680000.0)
@example(9.999999999999999e22)
@example(1e-6)
@example(1.2e-7)
@example(5e-324)
@example(1.7976931348623157e308)
@example(-0.0)
@example(0.1 + 0.2)
@example(4.35)
def test_numbers_are_written_as_ecmascript_does(value: float) -> None:
    assert bundle_verifier.number(value).encode() == rfc8785.dumps(value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b'{"a":1,"a":2}', "twice"),
        (b"NaN", "not JSON"),
        (b"-Infinity", "not JSON"),
        (b"\xff", "utf-8"),
        (b"[" * 100_000, "too deeply"),
        (b"1" * 5000, "too long"),
    ],
)
def test_what_is_no_json_is_refused(text: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        bundle_verifier.parse(text)


@pytest.mark.parametrize(
    "line",
    [
        b'{ "job_id":"a"}', b'{"job_id": "a"}', b'{"job_id":"a"} ', b'{"job_id":"\\u0061"}',
        b'{"job_id":"a","n":1.0}', b'{"job_id":"a","n":-0}', b'{"job_id":"a","n":1e2}', b'{"z":1,"job_id":"a"}',
        b'["a"]', b'"a"', b"null",
    ],
)  # fmt: skip
def test_records_in_another_spelling_are_named_and_not_used(line: bytes) -> None:
    """Their hashes would be those of the canonical text, not of what stands there."""
    canonical = b'{"job_id":"b","n":1}'
    check, bundle = bundle_verifier.Check(), Lines({"jobs.jsonl": line + b"\n" + canonical + b"\n"})
    assert list(check.records(bundle, "jobs.jsonl", frozenset(bundle.sizes))) == [{"job_id": "b", "n": 1}]
    assert check.faults == [{"where": "jobs.jsonl, line 1", "what": "it is not canonical JSON: its text was altered"}]


@pytest.mark.parametrize("line", [b'{"job_id":1}', b'{"job":"a"}', b'{"job_id":null}', b'{"job_id":true}'])
def test_records_without_what_they_are_for_are_named_and_not_used(line: bytes) -> None:
    check, bundle = bundle_verifier.Check(), Lines({"jobs.jsonl": line + b"\n"})
    assert list(check.records(bundle, "jobs.jsonl", frozenset(bundle.sizes))) == []
    assert [fault["what"] for fault in check.faults] == ["its field job_id is missing or of another kind"]


def test_a_file_of_records_ends_with_a_line() -> None:
    check, bundle = bundle_verifier.Check(), Lines({"jobs.jsonl": b'{"job_id":"a"}\n{"job_id":"b"}'})
    assert list(check.records(bundle, "jobs.jsonl", frozenset(bundle.sizes))) == [{"job_id": "a"}]
    assert [fault["where"] for fault in check.faults] == ["jobs.jsonl"]
