"""Protocol files: what is read, and that every fault is named with its line and field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from service.core.documents import lifecycle_text, schema_text
from service.core.errors import ProtocolError
from service.core.protocol import load_protocol, protocol_json_schema
from tests.support.record.core import KINDS, TOY, CaptureParams, ChecklistParams, load


def line_of(text: str, part: str, nth: int = 1) -> int:
    """The line number, from 1, of the nth occurrence of `part`."""
    hits = [number for number, line in enumerate(text.splitlines(), start=1) if part in line]
    return hits[nth - 1]


def test_a_protocol_is_read_with_its_hash_and_typed_params(tmp_path: Path) -> None:
    path = tmp_path / "toy.yaml"
    path.write_text(TOY, encoding="utf-8")
    loaded = load_protocol(path, KINDS)
    protocol = loaded.protocol
    assert loaded.source == TOY
    assert len(loaded.sha256) == 64
    assert protocol.step_ids == ("fix_it", "capture", "spray", "scan", "register")
    assert protocol.camera is not None
    assert protocol.camera.exposure_s == pytest.approx(1 / 15)
    assert protocol.step("capture").params_as(CaptureParams).views == 3
    assert protocol.step("capture").gates[1].max == 1.0
    assert protocol.step("fix_it").confirm
    with pytest.raises(ProtocolError, match="not ChecklistParams"):
        protocol.step("capture").params_as(ChecklistParams)


def test_the_hash_is_of_the_bytes() -> None:
    assert load(TOY).sha256 != load(TOY + "# a comment\n").sha256


def test_numbers_follow_yaml_1_2() -> None:
    text = TOY.replace("sharp, min: 0.2", "sharp, min: 2e-1").replace("title: Fix", "title: on")
    protocol = load(text).protocol
    assert protocol.step("capture").gates[1].min == 0.2
    assert protocol.step("fix_it").title == "on"


FAULTS: list[tuple[str, str, str, str, str]] = [
    # old text, new text, text that marks the line, field, message
    ("title: A toy", "titel: A toy", "titel", "titel", r"unknown field \(did you mean 'title'\?\)"),
    ("registration: 10", "registraton: 10", "spheres:", "spheres.registration", "missing field"),
    ("  kind: checklist\n    title: Fix", "  title: Fix", "id: fix_it", "steps[0].kind", "missing field"),
    ("iso: 100", "iso: hundred", "iso: hundred", "camera.iso", "valid integer"),
    ('version: "1.0"', "version: 1.0", "version", "version", r"valid string \(it is 1.0\); put it in quotes"),
    ("exposure_s: 1/15", "exposure_s: 1/0", "exposure_s", "camera.exposure_s", "1/15"),
    ("exposure_s: 1/15", "exposure_s: fast", "exposure_s", "camera.exposure_s", "fraction such as 1/15"),
    ("title: Scan", "title: Scan\n    title: Again", "title: Again", "steps[3].title", "duplicate key"),
    ("id: scan", "id: capture", "kind: checklist\n", "steps[3].id", r"duplicate step id 'capture'.*steps\[1\]"),
    ("id: scan", "id: Scan 1", "id: Scan 1", "steps[3].id", "pattern"),
    ("id: scan", "id: paused", "id: paused", "steps[3].id", "name of a state"),
    ("kind: spray", "kind: spary", "kind: spary", "steps[2].kind", "unknown kind 'spary'.*did you mean 'spray'"),
    ("requires: [capture]", "requires: [cature]", "cature", "steps[2].requires[0]", "no step 'cature'"),
    ("requires: [capture]", "requires: [scan]", "requires", "steps[2].requires[0]", "comes later"),
    ("requires: [capture]", "requires: [spray]", "requires", "steps[2].requires[0]", "cannot require itself"),
    ("    requires: [capture]\n", "", "irreversible", "steps[2].irreversible", "needs `requires`"),
    (
        "    irreversible: true\n    sign: true\n",
        "    irreversible: true\n",
        "irreversible",
        "steps[2].irreversible",
        "needs `sign: true`",
    ),
    ("irreversible: true", "irreversible: true\n    confirm: false", "confirm: false", "steps[2].confirm", "always"),
    ("min: 0.2, max: 1.0", "unit: px", "measure: sharp", "steps[1].gates[1]", "needs limits"),
    ("min: 0.2, max: 1.0", "min: 2, max: 1.0", "measure: sharp", "steps[1].gates[1].max", "min 2 is above max 1.0"),
    ("measure: sharp", "measure: views", "min: 0.2", "steps[1].gates[1].measure", "second gate on 'views'"),
    (
        "min: 0.2,",
        "unless_skipped: scan, min: 0.2,",
        "measure: sharp",
        "steps[1].gates[1].unless_skipped",
        "'scan' is not an earlier step that may be skipped",
    ),
    ("min: 0.2,", "min: .nan,", ".nan", "steps[1].gates[1].min", "valid number"),
    ("views: 3}", "views: 0}", "views: 0", "steps[1].params.views", "greater than or equal to 1"),
    ("views: 3}", "views: many}", "views: many", "steps[1].params.views", "valid integer"),
    ("views: 3}", "veiws: 3, views: 3}", "veiws", "steps[1].params.veiws", "did you mean 'views'"),
    ("params: {views: 3}", "params: {}", "params: {}", "steps[1].params.views", "missing field"),
    ("params: {views: 3}", "params: 3", "params: 3", "steps[1].params", "dictionary|object|mapping"),
    ("sign: true", "sign: maybe", "sign: maybe", "steps[1].sign", "valid boolean"),
    ("retries: 2", "retries: -1", "retries", "steps[1].recovery.retries", "greater than or equal to 0"),
]


@pytest.mark.parametrize(
    ("old", "new", "mark", "field", "message"), FAULTS, ids=[f"{f[3]}-{f[1][:20]}" for f in FAULTS]
)
def test_every_fault_names_line_and_field(old: str, new: str, mark: str, field: str, message: str) -> None:
    assert old in TOY
    text = TOY.replace(old, new, 1)
    if field == "steps[3].id" and "duplicate" in message:
        line = line_of(text, "id: capture", 2)
    else:
        line = line_of(text, mark.strip())
    with pytest.raises(ProtocolError, match=message) as caught:
        load(text)
    assert f"lab.yaml:{line} {field}" in str(caught.value)


def test_all_faults_are_reported_together_in_the_order_of_lines() -> None:
    text = TOY.replace("title: A toy", "titel: A toy").replace("kind: spray", "kind: x").replace("min: 3,", "min: a,")
    with pytest.raises(ProtocolError) as caught:
        load(text)
    shown = str(caught.value)
    lines = [line.split()[0] for line in shown.splitlines() if line.startswith("  lab.yaml")]
    numbers = [int(place.split(":")[1]) for place in lines]
    assert shown.startswith("4 things are wrong")
    assert numbers == sorted(numbers)
    for part in ("titel", "title: missing", "steps[1].gates[0].min", "steps[2].kind"):
        assert part in shown


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("id: toy\n  title: x: y\n", "lab.yaml:2"),
        ("id: toy\n\tversion: 1\n", "lab.yaml:2"),
        ("id: [a, b\n", "lab.yaml:2"),
        ("id: a\n---\nid: b\n", "lab.yaml:2"),
        ("- a\n- b\n", "lab.yaml:1"),
        ("", "lab.yaml:1"),
        ("id: a\x07\n", "lab.yaml:1"),
        ("id: a\nsteps: &a [*a]\n", "lab.yaml:2"),
        ("id: a\n3: b\n", "lab.yaml:2"),
        ("id: a\nsteps: []\n", "lab.yaml:2 steps"),
    ],
)
def test_what_is_no_protocol_is_refused_with_a_line(text: str, place: str) -> None:
    with pytest.raises(ProtocolError) as caught:
        load(text)
    assert place in str(caught.value)


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id: a\nsteps: " + "[" * 100_000, r"nested more than 50 deep \[lab.yaml:2\]"),
        ("id: a\nsteps: " + "{a: " * 2_000, r"nested more than 50 deep \[lab.yaml:2\]"),
        ("id: a\n" + BOMB, r"more than 200,000 values.* \[lab.yaml:2\]"),
    ],
    ids=["brackets", "braces", "aliases"],
)
def test_files_made_to_exhaust_the_reader_are_refused_at_once(text: str, message: str) -> None:
    with pytest.raises(ProtocolError, match=message):
        load(text)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ProtocolError, match="cannot read the protocol"):
        load_protocol(tmp_path / "absent.yaml", KINDS)
    latin = tmp_path / "latin.yaml"
    latin.write_bytes("id: a\ntitle: Wirbels\u00e4ule\n".encode("latin-1"))
    with pytest.raises(ProtocolError, match=r"not UTF-8 text \[.*latin.yaml:2\]"):
        load_protocol(latin, KINDS)


def test_the_schema_knows_the_params_of_every_kind() -> None:
    schema = protocol_json_schema(KINDS)
    steps: dict[str, Any] = schema["properties"]["steps"]
    assert steps["minItems"] == 1
    assert set(steps["items"]["discriminator"]["mapping"]) == set(KINDS)
    capture = schema["$defs"]["Step_capture"]
    assert "params" in capture["required"]  # views has no default
    assert "params" not in schema["$defs"]["Step_checklist"]["required"]
    assert capture["additionalProperties"] is False
    assert schema["$defs"]["CaptureParams"]["required"] == ["views"]
    exposure: dict[str, Any] = schema["$defs"]["CameraSection"]["properties"]["exposure_s"]
    assert {option["type"] for option in exposure["anyOf"]} == {"number", "string"}


def test_the_generated_documents() -> None:
    assert json.loads(schema_text(KINDS)) == protocol_json_schema(KINDS)
    page = lifecycle_text(load(TOY).protocol)
    assert "| spray | spray | Spray | yes |  | yes | capture |  |" in page
    assert "Board images used ≥ 3 views; Sharp ≥ 0.2 and ≤ 1" in page
    assert "```mermaid\nstateDiagram-v2" in page
