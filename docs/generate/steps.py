"""The page of the step kinds: what each does, its params, and the measures that gates can be set on."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping

from pydantic import BaseModel

from docs.generate.fields import docstring, field_table, records_below
from docs.generate.measure_words import MEANINGS
from service.core.protocol.models import Protocol, Step
from service.steps import step_kinds
from service.steps.measures import Measure, measures_of

_HEAD = """\
Made from the code by `make reference`.

A step of a protocol has a `kind`. Its `params` are the keys of that kind; its gates name measures of that kind:

```yaml
gates:
  - {measure: rms_px, max: 0.5, unit: px, why: a sharp board gives half of it, accept_by: supervisor}
```

A gate compares the measured number with `min` and `max`, in the unit of the measure. Where a measure states its
uncertainty, both bounds of the number must be within the limits, each held with 99 %; where one is and the other is
not, the gate is not decided and the step does not pass. `orthocapture protocol check protocols/exvivo_spine.yaml`
refuses a measure that a kind does not have, another unit, and limits that cannot be meant (column *limits*).

`NAME` stands for the source of the camera poses: `robot`, `robot_corrected`, `triangulated`, `colmap`, `glomap`,
`hybrid`, `spheres`; with `reduced`, the resolution too.
"""


def steps_text(protocols: Mapping[str, Protocol]) -> str:
    """A Markdown page; `protocols` by name are where an example of each kind is found."""
    lines = ["# Step kinds", "", _HEAD]
    below: dict[str, type[BaseModel]] = {}
    for name, kind in step_kinds().items():
        module = sys.modules[kind.execute.__module__]
        example = next(found for found in _examples(protocols, name))
        lines += [f"## {name}", "", docstring(module), "", f"Example: step `{example[1].id}` of `{example[0]}`.", ""]
        lines += ["### Params", "", docstring(kind.params), "", *field_table(kind.params), ""]
        lines += ["### Measures", "", *_measures(*example, protocols), ""]
        lines += ["### Result", "", docstring(kind.result), "", *field_table(kind.result), ""]
        records_below(kind.params, below)
    lines += ["## Records of the params", ""]
    for name, model in below.items():
        lines += [f"### {name}", "", docstring(model), "", *field_table(model), ""]
    return _unique_headings("\n".join(lines))


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


def measures_of_kind(file: str, step: Step, protocols: Mapping[str, Protocol]) -> dict[str, Measure]:
    """The measures of a step's kind, those of a source of camera poses under the name NAME_…."""
    known = measures_of(step, {s.id: s for s in protocols[file].steps})
    assert known is not None, step.kind
    out: dict[str, Measure] = {}
    for name, measure in known.items():
        general = next((key for key in MEANINGS if key.startswith("NAME_") and name.endswith(key[4:])), name)
        out.setdefault(name if name in MEANINGS else general, measure)
    return out


def all_measures(protocols: Mapping[str, Protocol]) -> set[str]:
    """The names of all measures of all kinds."""
    examples = [next(_examples(protocols, name)) for name in step_kinds()]
    return {name for file, step in examples for name in measures_of_kind(file, step, protocols)}


def _measures(file: str, step: Step, protocols: Mapping[str, Protocol]) -> Iterator[str]:
    yield "| measure | unit | limits | meaning |"
    yield "|---|---|---|---|"
    for name, measure in measures_of_kind(file, step, protocols).items():
        yield f"| `{name}` | {measure.unit} | {measure.least:g} to {measure.most:g} | {MEANINGS[name]} |"
