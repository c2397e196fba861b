"""The page of the step kinds: what each does, its params, and the measures that gates can be set on."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any, get_args

from pydantic import BaseModel

from docs.generate.fields import docstring, field_table, record_sections, records_below
from service.computations import job_kinds
from service.core.measure_names import REGISTRATION_MEASURE_NAMES, measure_name
from service.core.protocol import Protocol, Step
from service.steps import step_kinds
from service.steps.context import StepKind
from service.steps.measures import Measure, RegistrationMeasures

_HEAD = """\
Made from the code by `make reference`.

A step of a protocol has a `kind`. Its `params` are the keys of that kind; its gates name measures of that kind:

```yaml
gates:
  - {measure: rms_px, max: 0.5, unit: px, why: a sharp board gives half of it, accept_by: supervisor}
```

A gate compares the measured number with `min` and `max`, in the unit of the measure. Where a measure states its
uncertainty, both bounds of the number must be within the limits, each held with 99 %; where one is and the other is
not, the gate is not decided and the step does not pass. `orthocapture protocol check exvivo_spine`
refuses a measure that a kind does not have, another unit, and limits that cannot be meant (column *limits*).

Params that name an earlier step say in their type what that step must do.

`NAME` stands for the source of the camera poses: `robot`, `robot_corrected`, `triangulated`, `colmap`, `glomap`,
`hybrid`, `spheres`; with `reduced`, the resolution too.
"""


def steps_text(protocols: Mapping[str, Protocol]) -> str:
    """A Markdown page; `protocols` by name are where an example of each kind is found."""
    lines = ["# Step kinds", "", _HEAD]
    below: dict[str, type[BaseModel]] = {}
    for name, kind in step_kinds().items():
        module = sys.modules[kind.execute.__module__]
        lines += [f"## {name}", "", docstring(module), ""]
        for file, step in list(_examples(protocols, name))[:1]:
            lines += [f"Example: step `{step.id}` of `{file}`.", ""]
        lines += ["### Params", "", docstring(kind.params), "", *field_table(kind.params), ""]
        lines += ["### Measures", "", *_measures(kind), ""]
        lines += ["### Result", "", docstring(kind.result), "", *_result_table(kind), ""]
        records_below(kind.params, below)
    lines += ["## Records of the params", ""]
    lines += record_sections(below)
    return _unique_headings("\n".join(lines))


def _result_table(kind: StepKind[Any]) -> list[str]:
    """The table of a result; the records in it are those of jobs, and described there.

    A job's whole answer is described under the name of its kind.
    """
    held = [get_args(field.annotation) or (field.annotation,) for field in kind.result.model_fields.values()]
    lines = [line.replace("](#", "](jobs.md#") for line in field_table(kind.result)]
    for name, job in job_kinds().items():
        if any(job.answer in records for records in held):
            place = f"](jobs.md#{job.answer.__name__.lower()})"
            lines = [line.replace(place, f"](jobs.md#{name})") for line in lines]
    return lines


def _unique_headings(text: str) -> str:
    """Headings that stand under every kind become bold words: their anchors would be the same."""
    for heading in ("Params", "Measures", "Result"):
        text = text.replace(f"\n### {heading}\n", f"\n**{heading}**\n")
    return text


def _examples(protocols: Mapping[str, Protocol], kind: str) -> Iterator[tuple[str, Step]]:
    for file, protocol in protocols.items():
        for step in protocol.steps:
            if step.kind == kind:
                yield file, step


def measures_of_kind(kind: StepKind[Any]) -> dict[str, Measure]:
    """The measures of a kind of step, those of a source of camera poses under the name NAME_…."""
    if issubclass(kind.measures, RegistrationMeasures):
        return kind.measures.declared_for(["NAME"])
    return kind.measures.declared()


def _measures(kind: StepKind[Any]) -> Iterator[str]:
    yield "| measure | name | unit | limits | meaning |"
    yield "|---|---|---|---|---|"
    for name, measure in measures_of_kind(kind).items():
        of_one = name.removeprefix("NAME_")
        shown = measure_name(name) if of_one == name else REGISTRATION_MEASURE_NAMES[of_one]
        yield f"| `{name}` | {shown} | {measure.unit} | {measure.least:g} to {measure.most:g} | {measure.meaning} |"
