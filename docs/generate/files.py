"""The pages of the two files that people write: a protocol and a rig."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from docs.generate.fields import docstring, field_table, record_sections, records_below
from drivers.plugin import DriverSpec
from service.core.protocol import ProtocolFields, StepFields
from service.rig import RigSection

_MADE = "Made from the code by `make reference`."
_NOT_WRITTEN = ("imported",)  # only the program writes it, for an import


def protocol_text() -> str:
    """Every key of a protocol file except the `params` of its steps, which depend on the kind of the step."""
    return _page(
        "The protocol file",
        "A lab procedure in YAML: the parts of the scene, the motion of the arm, and the steps in their order. "
        "`orthocapture protocol check exvivo_spine` reports every error of a file, by line and "
        "field; editors can check it with `protocol.schema.json` beside this page. The `params` of a step, and the "
        "measures for its gates, depend on its kind: [Step kinds](steps.md).",
        {"The file": ProtocolFields, "A step": StepFields},
        {"The file": ["And `steps`: a list of at least one step, see below.", ""]},
    )


def rig_text() -> str:
    """Every key of a rig file; the keys of a device depend on its driver."""
    return (
        _page(
            "The rig file",
            "Devices and stations of a site in YAML. `orthocapture doctor --rig rig.yaml` reports errors of the file "
            "and of the devices. How to write one: [Connecting your own hardware](../howto/your_hardware.md).",
            {"The file": RigSection},
            {},
        )
        + _devices()
    )


def _devices() -> str:
    """A table for each installed driver, followed by the records that its keys are made of."""
    lines = [
        "## Devices",
        "",
        "Each device under `devices` has a name, and below it `driver` and the keys of that driver. To write "
        "a driver of your own: [A new driver](../howto/new_driver.md).",
        "",
    ]
    for point in sorted(entry_points(group="orthocapture.drivers"), key=lambda point: point.name):
        spec: DriverSpec = point.load()
        if point.value.startswith("drivers."):
            lines += [f"### {point.name}", "", f"A device of kind {spec.kind}. {docstring(spec.config)}", ""]
            lines += [*field_table(spec.config), "", *record_sections(records_below(spec.config), "####")]
    return "\n".join(lines)


def _page(title: str, about: str, models: dict[str, type[Any]], more: dict[str, list[str]]) -> str:
    lines = [f"# {title}", "", _MADE, "", about, ""]
    below: dict[str, type[Any]] = {}
    for heading, model in models.items():
        lines += [f"## {heading}", "", docstring(model), "", *field_table(model, without=_NOT_WRITTEN), ""]
        lines += more.get(heading, [])
        records_below(model, below, without=_NOT_WRITTEN)
    lines += record_sections(below, "##")
    return "\n".join(lines)
