"""The page of the job kinds: what each computes, what it is given and what it gives."""

from __future__ import annotations

from docs.generate.fields import docstring, field_table
from service.jobs import job_kinds
from service.jobs.kind import JobRecord

_HEAD = """\
Made from the code by `make reference`.

A job is one computation of a worker. Each kind is declared in one file of `service/jobs`, or in a plug-in (entry
points `orthocapture.jobs`). What a job took from an earlier one stands in its arguments as a reference,
`{"$from": {"job": "…", "field": "result/camera"}}`; what it took from all earlier ones of a kind as `{"$each": …}`.
"""


def jobs_text() -> str:
    """A Markdown page of all kinds, those of installed plug-ins included."""
    lines = ["# Job kinds", "", _HEAD]
    for kind in job_kinds().values():
        replayed = "A replay computes it" if kind.replayed else "A replay computes it if asked to"
        drawn = "the provenance drawing leaves it out" if kind.aside else "the provenance drawing shows it"
        words = f"{kind.words[:1].upper()}{kind.words[1:]}"
        lines += [f"## {kind.name}", "", f"{words}. {replayed}; {drawn}.", ""]
        for title, model in (("Arguments", kind.arguments), ("Answer", kind.answer)):
            lines += [f"**{title}**", "", *_record(model), ""]
    return "\n".join(lines).rstrip() + "\n"


def _record(model: type[JobRecord]) -> list[str]:
    said, _, _ = docstring(model).partition("\n\nAttributes:")
    return [said, "", *field_table(model)] if model.model_fields else [said]
