"""The page of the events: every kind of event that a chain can hold, and its fields."""

from __future__ import annotations

from typing import Any, get_args

from docs.generate.fields import docstring, field_table, record_sections, records_below
from service.core.records.base import ArtefactRef
from service.core.records.events import Event, Payload

_HEAD = """\
Made from the code by `make reference`.

All that happens in a run is appended to its chain as events; what happens outside of runs is in the site's chain.
Both are in the database of the data folder, and in `events.jsonl` and `site_events.jsonl` of a bundle. An event is
never changed: a correction is another event. `orthocapture audit show latest --data runs` reads a chain.
"""


def events_text() -> str:
    """A Markdown page."""
    lines = [
        "# Events",
        "",
        *_HEAD,
        "## Event",
        "",
        docstring(Event),
        "",
        *field_table(Event, without=("payload",)),
        "",
    ]
    lines += ["`payload` is one of the following; its `kind` says which.", ""]
    payloads: list[type[Any]] = list(get_args(get_args(Payload)[0]))
    below: dict[str, type[Any]] = {ArtefactRef.__name__: ArtefactRef}
    for payload in payloads:
        kind = payload.model_fields["kind"].default
        lines += [f"## {kind}", "", docstring(payload), "", *field_table(payload, without=("kind",)), ""]
        records_below(payload, below)
    lines += ["## Records within events", ""]
    lines += record_sections(below)
    return "\n".join(lines)
