"""The page of the job kinds: what each computes, what it is given and what it gives."""

from __future__ import annotations

from pydantic import BaseModel

from docs.generate.fields import docstring, field_table, record_sections, records_below
from service.computations import job_kinds
from service.computations.kind import JobRecord

_HEAD = """\
Made from the code by `make reference`.

A job is one computation of a worker. Each kind is declared in a folder of `service/computations`, or in a plug-in
(entry points `orthocapture.jobs`). What a job took from an earlier one stands in its arguments as a reference,
`{"$from": {"job": "…", "field": "result/camera"}}`; what it took from all earlier ones of a kind as `{"$each": …}`.
"""


def jobs_text() -> str:
    """A Markdown page of all kinds, those of installed plug-ins included."""
    lines = ["# Job kinds", "", _HEAD]
    below: dict[str, type[BaseModel]] = {}
    for kind in job_kinds().values():
        replayed = "A replay computes it" if kind.replayed else "A replay computes it if asked to"
        drawn = "the provenance drawing leaves it out" if kind.aside else "the provenance drawing shows it"
        words = f"{kind.words[:1].upper()}{kind.words[1:]}"
        lines += [f"## {kind.name}", "", f"{words}. {replayed}; {drawn}.", ""]
        for title, model in (("Arguments", kind.arguments), ("Answer", kind.answer)):
            lines += [f"**{title}**", "", *_record(model), ""]
            records_below(model, below)
    lines += ["## Records within arguments and answers", "", *record_sections(below)]
    return "\n".join(lines).rstrip() + "\n"


def _record(model: type[JobRecord]) -> list[str]:
    return [docstring(model), "", *field_table(model)] if model.model_fields else [docstring(model)]
