"""Fuzzing of every parser, in short: `make torture-fuzz`, its past findings, and that it finds known faults."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.errors import UnreadableFileError
from drivers.meshes.surface_file import read_surface_file
from service.compute.images.photographs import read_image
from service.core.errors import DataError
from tests.support.torture.fuzz.targets.table import GROUPS, targets_of
from tests.support.torture.fuzz.targets.target import fault_of
from tests.support.torture.fuzz.watch import Sweep

PARSERS = "tests.support.processes.faulty_parsers"
FOUND = Path(__file__).parents[1] / "data" / "fuzz"  # by target: inputs that once showed a fault
INPUTS = 24  # per target, times its pace


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.parametrize("group", GROUPS)
def test_every_parser_refuses_bad_input_as_people_can_understand(group: str, tmp_path: Path) -> None:
    inputs = {target.name: max(2, round(INPUTS * target.pace)) for target in targets_of(group)}
    outcomes = Sweep(group, "hypothesis", tmp_path).run(inputs, seconds=20.0)
    found = [f"{finding.target}: {finding.fault}" for outcome in outcomes.values() for finding in outcome.findings]
    assert found == []
    assert set(outcomes) == {target.name for target in targets_of(group)}
    assert all(outcome.inputs > 0 for outcome in outcomes.values())


@pytest.mark.parametrize("path", sorted(FOUND.glob("*/*")), ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_was_found_once_stays_mended(path: Path, tmp_path: Path) -> None:
    (target,) = [one for group in GROUPS for one in targets_of(group) if one.name == path.parent.name]
    raised: BaseException | None = None
    try:
        target.parse(path.read_bytes(), tmp_path)
    except Exception as error:  # noqa: BLE001 - any kind of error is judged
        raised = error
    assert raised is None or fault_of(target, raised) == "", repr(raised)


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("poses_csv", "image,x,y,z,qx,qy,qz,qw"),
        ("joints_csv", "image,q1,q2,q3,q4,q5,q6"),
        ("stations_csv", "image,station"),
    ],
)
def test_a_cell_longer_than_tables_have_is_told_with_its_line(name: str, head: str, tmp_path: Path) -> None:
    (target,) = [one for one in targets_of(GROUPS[0]) if one.name == name]
    with pytest.raises(DataError, match=r"not a valid CSV row .*csv:2\]"):
        target.parse(f"{head}\n{'a' * 200_000}\n".encode(), tmp_path)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_an_image_that_claims_a_gigapixel_is_refused_before_memory_is_set_aside(suffix: str, tmp_path: Path) -> None:
    done, encoded = cv2.imencode(suffix, np.zeros((32, 48, 3), np.uint8))
    data = bytearray(encoded.tobytes())
    at = data.index(b"\xff\xc0") + 5 if suffix == ".jpg" else 16  # height and width, or width and height
    size = struct.pack(">HH" if suffix == ".jpg" else ">II", 30_000, 30_000)
    data[at : at + len(size)] = size
    path = tmp_path / f"image{suffix}"
    path.write_bytes(data)
    assert done
    with pytest.raises(DataError, match=r"claims to have 30000 × 30000 pixels"):
        read_image(path)


def test_a_part_of_a_glb_that_claims_four_gigabytes_is_refused_before_memory_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "mesh.glb"
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 24) + struct.pack("<I", 0xFFFFFFF0) + b"JSON{}  ")
    with pytest.raises(UnreadableFileError, match="longer or shorter than it says"):
        read_surface_file(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("_crash", r"crashes \(SIGSEGV\)"),
        pytest.param("_hang", r"hangs beyond 2 s", marks=pytest.mark.slow),
        ("_grow", r"memory: more than 32 MiB"),
        ("_leak", r"leaks (ValueError|UnicodeDecodeError)"),
        ("_mumble", r"words: the message names no place"),
    ],
)
def test_a_faulty_parser_is_found_out_and_its_input_kept(name: str, fault: str, tmp_path: Path) -> None:
    sweep = Sweep(PARSERS, "hypothesis", tmp_path, reducing_tries=0)
    outcome = sweep.run({name: 1}, seconds=90.0)[name]
    assert outcome.findings
    assert all(re.match(fault, finding.fault) for finding in outcome.findings), outcome.findings
    assert all(finding.data != b"plain" * 4 for finding in outcome.findings)


def test_an_error_with_place_and_remedy_is_no_finding(tmp_path: Path) -> None:
    outcome = Sweep(PARSERS, "hypothesis", tmp_path).run({"_refuse": 50}, seconds=90.0)["_refuse"]
    assert (outcome.findings, outcome.refused > 0) == ([], True)


def test_the_input_of_a_finding_is_made_small(tmp_path: Path) -> None:
    outcome = Sweep(PARSERS, "hypothesis", tmp_path).run({"_leak": 50}, seconds=90.0)["_leak"]
    assert all(len(finding.data) <= 1 for finding in outcome.findings)
