"""Nothing that names a person or a place leaves with a recording: a planted value of each kind, in every place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from pydicom.dataset import Dataset

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.interfaces import (
    DeviceAnswers,
    DeviceIdentity,
    DeviceReport,
    Exchange,
    FileHeader,
    Listing,
    PtpProperty,
    answers_of,
)
from drivers.recording import RecordedDevice, Recording, readable
from drivers.recording.personal_data import TABLE, without_personal_data
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from tests.support.ct.ct_series import hospital, write_series

# What is planted of each kind in the table; those known from the rig file, a folder or an answer are told beside.
ROOT = Path(__file__).parents[2]
PLANTED = {
    "serial number": ("20235001234", "LB-0001"),
    "program": ("meier knee.urp",),
    "file": ("Meier_Hans_left.ply",),
    "description": ("Meier Hans control",),
    "e-mail": ("hans.meier@clinic.example",),
    "UID": ("1.3.12.2.1107.5.1.4.73473.30000",),
    "address": ("robot-7.clinic.example", "192.168.17.4:30004", "ptpip:10.0.0.9:15740:15740", "00:1b:1c:aa:bb:cc"),
    "path": ("/home/meier/scans", r"C:\Users\Meier\rig.yaml", "/media/Hans Meier/left knee.ply", r"\\nas\meier\ct"),
}
TOLD = ("serial number", "program", "file", "description")  # without a form of their own
SECRETS = {text: kind for kind in TOLD for text in PLANTED[kind]} | {"robot-7.clinic.example": "address"}


def recording(text: str) -> Recording:
    """A recording in which a text stands wherever a text can."""
    said = f"it tells {text} here"
    # Not in the identity, from which it would be known.
    identity = DeviceIdentity("robot", "UR10e", "4711", "5.12.0.1101319", "ur", "1 (ur_rtde 1.6.5)", "arm")
    listing = Listing(
        maker="Canon Inc.",
        model="Canon EOS R5",
        firmware="1.8.2",
        protocol=100,
        properties=(
            PtpProperty(code="d115", type="str", access="rw", form="none", value=text),
            PtpProperty(code="d1d8", type="str", access="ro", form="none", value=said),
            PtpProperty(code="d101", type="u16", access="rw", form="enum", numbers=(32, 35), value=35),
        ),
    )
    answers = DeviceAnswers(
        listing=listing,
        exchanges=(Exchange(question="PolyscopeVersion", answer=said),),
        headers=(FileHeader(format="PLY", size_bytes=10, lines=(said,)),),
        silent=(said,),
    )
    report = DeviceReport(identity, details={"robot mode": said}, problems=(said,))
    device = RecordedDevice(kind="robot", driver="ur", report=report, error=said, answers=answers)
    return Recording(by="orthocapture", devices={"robot": device})


def test_each_kind_of_the_table_is_planted() -> None:
    assert set(PLANTED) == {one.name for one in TABLE}


@pytest.mark.parametrize(("kind", "text"), [(kind, text) for kind, texts in PLANTED.items() for text in texts])
def test_a_planted_value_stands_nowhere(kind: str, text: str) -> None:
    told = recording(text)
    assert readable(told).count(text.replace("\\", "\\\\")) == 8
    said = readable(without_personal_data(told, SECRETS))
    assert text not in said
    assert not [word for word in ("eier", "Hans", "clinic", "192", "nas") if word in said]
    assert said.count(f"it tells ({kind} ") == 7
    assert Recording.model_validate_json(said).devices["robot"].answers.silent


@pytest.mark.parametrize("place", ["serial", "address"])
def test_what_the_identity_tells_is_taken_out_of_all_else(place: str) -> None:
    """Whatever its form."""
    told = recording("KX 99/7-b")
    report = told.devices["robot"].report
    assert report is not None
    identity = replace(report.identity, **{place: "KX 99/7-b"})
    device = told.devices["robot"].model_copy(update={"report": replace(report, identity=identity)})
    assert "KX 99" not in readable(without_personal_data(told.model_copy(update={"devices": {"robot": device}})))


def test_the_how_to_says_what_is_taken_out() -> None:
    words = (ROOT / "docs" / "howto" / "fault_report.md").read_text(encoding="utf-8")
    listed = [line.removeprefix("- ").rstrip(";.") for line in words.splitlines() if line.startswith("- ")]
    assert tuple(listed) == without_personal_data(recording("")).taken_out


def test_what_helps_stays() -> None:
    said = readable(without_personal_data(recording("f/8 at 1/60 s, 1.6.5, 5.12.0.1101319, 2026")))
    for kept in ("UR10e", "5.12.0.1101319", "ur_rtde 1.6.5", "Canon EOS R5", '"numbers": [32, 35]'):
        assert kept in said


@pytest.mark.parametrize(
    ("question", "answer", "left"),
    [
        ("get serial number", "20235001234", "(serial number 1)"),
        ("*IDN?", "ortho,LB1,LB-0001,1.4", "ortho,LB1,(serial number 1),1.4"),
        ("$I", "[VER:1.1h.20190825:meier]", "[VER:1.1h.20190825:(serial number 1)]"),
        ("get loaded program", "Loaded program: meier knee.urp", "Loaded program: (program 1)"),
        ("programState", "PLAYING meier knee.urp", "PLAYING (program 1)"),
        ("programState", "STOPPED <unnamed>", "STOPPED <unnamed>"),
        ("get loaded program", "No program loaded", "No program loaded"),
    ],
)
def test_what_an_answer_tells_is_taken_out_of_it_and_of_all_else(question: str, answer: str, left: str) -> None:
    """Also where the device could not be opened, and no identity names the number."""
    exchange = Exchange(question=question, answer=answer)
    device = RecordedDevice(
        kind="robot", driver="ur", error=f"refused: {answer}", answers=DeviceAnswers(exchanges=(exchange,))
    )
    clean = without_personal_data(Recording(by="orthocapture", devices={"robot": device})).devices["robot"]
    assert clean.answers.exchanges[0].answer == left
    assert clean.error == f"refused: {left}"


def test_equal_texts_have_equal_names_and_others_others() -> None:
    said = [f"{octet}.1.1.1 and 10.1.1.1" for octet in (10, 20)]
    device = RecordedDevice(kind="robot", driver="ur", answers=DeviceAnswers(silent=tuple(said)))
    clean = without_personal_data(Recording(by="orthocapture", devices={"robot": device}))
    assert clean.devices["robot"].answers.silent == ("(address 1) and (address 1)", "(address 2) and (address 1)")


# --- headers of files ---


def named(ds: Dataset, k: int) -> None:
    hospital(ds, k)
    ds.SeriesDescription, ds.ImageComments = "DOE spine", "secret"
    block = ds.private_block(0x0029, "ACME 1.1", create=True)
    block.add_new(0x10, "LO", "nickname")


def texts(answers: DeviceAnswers) -> Iterator[str]:
    device = RecordedDevice(kind="ct", driver="dicom_folder", answers=answers)
    clean = without_personal_data(Recording(by="orthocapture", devices={"ct": device}))
    for header in clean.devices["ct"].answers.headers:
        yield from header.lines


def test_the_header_of_a_series_names_no_patient(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", change=named)
    ct = DicomFolder(DicomFolderConfig(folder=tmp_path / "ct", stable_s=0.0))
    ct.open()
    lines = list(texts(answers_of(ct)))
    said = "\n".join(lines)
    for personal in [
        "DOE",
        "JOHN",
        "4711",
        "19500102",
        "ACC-12",
        "HOUSE",
        "SMITH",
        "General",
        "SN-99",
        "secret",
        "nickname",
    ]:
        assert personal not in said
    assert "SeriesDescription: (description 1)" in lines
    assert {"Modality: CT", "SOPClassUID: CT Image Storage", "transfer syntax: Explicit VR Little Endian"} <= set(
        lines
    )
    assert "PatientName" in lines[-1]


@pytest.mark.parametrize(
    ("name", "content", "kept"),
    [
        (
            "meier.ply",
            b"ply\nformat ascii 1.0\ncomment TextureFile Meier.png\ncomment made by Hans\nobj_info of Meier\n"
            b"element vertex 0\nproperty float x\nMeier\nend_header\n",
            "comment TextureFile (name)|comment (text)|obj_info (text)|element vertex 0|property float x",
        ),
        ("meier.obj", b"# Meier\nmtllib Meier.mtl\no Hans\nv 1 2 3\nMeier 1\nf 1/1 1/1 1/1\n", "v with 3 numbers"),
        ("meier.stl", b"solid Meier Hans\nfacet normal 0 0 1\nendsolid Meier\n", "solid (name)"),
        ("Meier.stl", b"Meier, Hans".ljust(80) + (1).to_bytes(4, "little") + bytes(50), "binary, 1 triangles"),
        ("Meier.zdf", b"\x89HDF\r\n\x1a\nMeier", "begins with the bytes 89 48 44 46"),
    ],
)
def test_the_header_of_a_scan_names_nobody(tmp_path: Path, name: str, content: bytes, kept: str) -> None:
    (tmp_path / name).write_bytes(content)
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, stable_s=0.0))
    scanner.open()
    said = "|".join(texts(answers_of(scanner)))
    assert kept in said
    assert not [word for word in ("eier", "Hans") if word in said]


@pytest.mark.parametrize("maker", ["Sony Corporation", "Nikon Corporation", "Canon Inc.", "Another"])
def test_what_an_owner_wrote_into_a_body_is_no_part_of_its_listing(maker: str) -> None:
    """Whatever it is: artist, copyright, comment and date have no form by which they could be found."""
    codes = ("501e", "501f", "5011", "d090", "d115", "d1ce")
    texts = [PtpProperty(code=code, type="str", access="rw", form="none", value="Jane Doe") for code in codes]
    listing = Listing(maker=maker, model="a body", firmware="1", protocol=100, properties=tuple(texts))
    device = RecordedDevice(kind="camera", driver="gphoto", answers=DeviceAnswers(listing=listing))
    clean = without_personal_data(Recording(by="orthocapture", devices={"camera": device})).devices["camera"]
    assert clean.answers.listing is not None
    assert [one.value for one in clean.answers.listing.properties] == [""] * len(codes)
