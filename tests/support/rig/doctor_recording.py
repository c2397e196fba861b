"""Has `orthocapture doctor --record` write a recording of one device."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from drivers.recording import RecordedDevice, Recording
from service.cli.main import app


def recorded(file: Path, name: str, section: dict[str, object]) -> RecordedDevice:
    """Have the doctor write a recording of a rig of one device."""
    rig = file.with_suffix(".yaml")
    rig.write_text(json.dumps({"name": "a lab", "devices": {name: section}}))
    options = ["--rig", str(rig), "--data", str(file.parent / "data"), "--record", str(file), "--json"]
    result = CliRunner().invoke(app, ["doctor", *options], catch_exceptions=False)
    assert name in json.loads(result.stdout)["devices"]
    (device,) = Recording.model_validate_json(file.read_text(encoding="utf-8")).devices.values()
    return device
