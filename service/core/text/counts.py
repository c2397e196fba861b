"""Counts in words: one deviation, two deviations."""

from __future__ import annotations


def counted(number: int, one: str, more: str = "") -> str:
    """A count in words: `1 deviation`, `2 deviations`, `no deviation`. `more` is an irregular plural."""
    return f"{number or 'no'} {one if number in (0, 1) else more or one + 's'}"
