"""The rows of a sweep that are tested this time, for those that do all of them in one process."""

from __future__ import annotations

import pytest


def rows_to_run(request: pytest.FixtureRequest, parameter: str) -> list[str]:
    """Return the values of this parameter of the tests that run in the file that asks, in their order.

    A draw (tests/plugins/draw.py), `-k` or a name on the command line may have left others out.
    """
    calls = [
        item.callspec.params
        for item in request.session.items
        if isinstance(item, pytest.Function) and item.path == request.path and hasattr(item, "callspec")
    ]
    return list(dict.fromkeys(str(call[parameter]) for call in calls if parameter in call))
