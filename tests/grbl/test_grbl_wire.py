"""Both ends of GRBL's wire against a golden transcript that neither was made from."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from pydantic import ValidationError

from drivers.grbl.wire import Alarm, Feedback, Ok, Refused, Setting, Status, Welcome, jog, parse
from tests.support.arms.grbl_simulator import TURN, grbl_config, table

_SESSION = Path(__file__).parents[1] / "data" / "grbl" / "session.txt"


def rows() -> Iterator[tuple[str, str]]:
    """Direction and text of each row of the transcript."""
    for row in _SESSION.read_text(encoding="utf-8").splitlines():
        if not row.startswith("#"):
            yield row[0], row[2:]


def agrees(line: str, golden: str) -> bool:
    return fnmatch.fnmatchcase(line, golden.replace("[", "[[]"))


@pytest.mark.parametrize(
    ("line", "golden", "same"),
    [
        ("<Jog|MPos:1|FS:0,0>", "<Jog|MPos:*|FS:*>", True),
        ("<Idle|MPos:1>", "<Jog|*>", False),
        ("[OPT:V]", "[OPT:*]", True),
    ],
)
def test_how_lines_are_compared(line: str, golden: str, same: bool) -> None:
    assert agrees(line, golden) is same


def test_the_simulator_answers_as_the_transcript(tmp_path: Path) -> None:
    with table(tmp_path) as port, serial.Serial(str(port), timeout=60) as line:
        for direction, text in rows():
            if direction == ">":
                line.write({"^X": b"\x18", "?": b"?"}.get(text, text.encode() + b"\n"))
                if text == "^X":
                    continue
            else:
                heard = line.readline().decode("ascii").rstrip("\r\n")
                assert agrees(heard, text), (heard, text)


def test_the_driver_reads_every_line_of_the_transcript_and_writes_its_jog() -> None:
    said = [
        parse(text.replace("*", "0.000,0.000,0.000", 1).replace("*", "0,0").encode())
        for d, text in rows()
        if d == "<" and text
    ]
    assert None not in said
    kinds = {type(message) for message in said}
    assert kinds == {Welcome, Feedback, Status, Refused, Ok, Alarm}
    assert [m.code for m in said if isinstance(m, Alarm)] == [2, 3]
    assert jog(("X",), (-20.0,), 600.0).decode() in [text for d, text in rows() if d == ">"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            b"<Run|MPos:1.000,-2.000,3.500|FS:500,0|Ov:50,100,100>\r",
            Status("Run", 0, (1.0, -2.0, 3.5), None, None, 0.5),
        ),
        (
            b"<Hold:1|WPos:1.000,2.000,0.000|FS:0,0|WCO:0.500,0.000,0.000>",
            Status("Hold", 1, None, (1.0, 2.0, 0.0), (0.5, 0.0, 0.0), None),
        ),
        (b"$110=3600.000", Setting(110, 3600.0)),
        (b"ALARM:1\r", Alarm(1)),
        (b"error:20", Refused(20)),
        (b"<Idle|MPos:1.0", None),
        (b"\xff\x00garbage", None),
        (b"error:" + b"9" * 5000, None),
        (b"ALARM:" + b"1" * 5000, None),
        (b"$" + b"1" * 5000 + b"=1", None),
        (b"$110=" + b"9" * 400, None),
        (b"<Idle|MPos:" + b"9" * 400 + b",0,0|FS:0,0>", Status("Idle", 0, None, None, None, None)),
    ],
)
def test_lines_and_what_they_say(line: bytes, message: object) -> None:
    assert parse(line) == message


def test_reasons_are_told_in_words() -> None:
    assert re.search("limit switch.*alarm 1", Alarm(1).words)
    assert re.search("feed.*error 22", Refused(22).words)


def test_a_watchdog_leaves_time_to_brake() -> None:
    usual = grbl_config(Path("table"), TURN)
    assert usual.reaction_s == pytest.approx(0.3)
    with pytest.raises(ValidationError, match=r"rest after 1\.2 s at the earliest: rest_within_s"):
        grbl_config(Path("table"), TURN, watchdog_s=1.0)
    assert grbl_config(Path("table"), TURN, watchdog_s=1.0, rest_within_s=1.2).reaction_s == pytest.approx(1.1)
