"""The stand-alone verifier's own JSON: canonical as RFC 8785 says, and no other text is read."""

from __future__ import annotations

import pytest
import rfc8785
from hypothesis import example, given, settings
from hypothesis import strategies as st

from service.audit.verify import bundle_verifier

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
