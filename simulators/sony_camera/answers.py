"""Answers of a body that a driver does not expect: a property that is absent, fixed, without choices, and so on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from simulators.serve import SimulatorError
from simulators.sony_camera.properties import TEXT, U8, U32, BodyTable, CameraProperty, Enabled

HOWS = ("absent", "read_only", "empty_list", "value", "wrong_type", "late")


def with_answers(table: BodyTable, answers: str) -> BodyTable:
    """The table with some properties changed, by a JSON list of {"code": "5007", "how": "value", "value": 65534}.

    `how` is one of HOWS; `late` takes the seconds until a value that was set is stated. Raises SimulatorError.
    """
    properties = list(table.properties)
    try:
        for answer in json.loads(answers):
            code = int(answer["code"], 16)
            changed = [_changed(one, answer) if one.code == code else one for one in properties]
            properties = [one for one in changed if one is not None]
    except (ValueError, KeyError, TypeError) as error:
        raise SimulatorError(f"these are no answers of a body: {answers}") from error
    return replace(table, properties=tuple(properties))


def _changed(entry: CameraProperty, answer: dict[str, Any]) -> CameraProperty | None:
    if answer["how"] == "absent":
        return None
    changes: dict[str, Callable[[], dict[str, Any]]] = {
        "read_only": lambda: {"enabled": Enabled.DISPLAY_ONLY},
        "empty_list": lambda: {"choices": (), "limits": None},
        "value": lambda: {"value": str(answer["value"]) if entry.datatype == TEXT else int(answer["value"])},
        "late": lambda: {"late_s": float(answer["value"])},
        "wrong_type": lambda: _other_type(entry),
    }
    return replace(entry, **changes[answer["how"]]())


def _other_type(entry: CameraProperty) -> dict[str, Any]:
    plain: dict[str, Any] = {"choices": None, "limits": None}
    if entry.datatype == TEXT:
        return {**plain, "datatype": U8, "value": 0}
    if entry.datatype == U32:
        return {**plain, "datatype": TEXT, "value": str(entry.value)}
    return {**plain, "datatype": U32, "value": abs(int(entry.value))}
