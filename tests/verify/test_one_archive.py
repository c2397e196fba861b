"""A bundle is exactly one zip file, or a folder of what was listed: all readers read the same from it."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from service.audit import bundle_verifier
from tests.support.record.bundled_site import Site, check, run_verifier


def streamed(content: bytes) -> Iterator[tuple[str, bytes]]:
    """The files as a reader finds them that unpacks while it receives, and never sees the directory at the end."""
    at = 0
    while content[at : at + 4] == b"PK\x03\x04":
        method, crc_at = struct.unpack_from("<H", content, at + 8)[0], at + 14
        compressed, _, name, extra = struct.unpack_from("<2L2H", content, crc_at + 4)
        begin = at + 30 + name
        if compressed == 0xFFFFFFFF:
            _, compressed = struct.unpack_from("<2Q", content, begin + 4)
        data = content[begin + extra : begin + extra + compressed]
        yield content[at + 30 : begin].decode(), zlib.decompress(data, -15) if method else data
        at = begin + extra + compressed


def forged(site: Site, tmp_path: Path) -> bytes:
    """A zip file with other events, as somebody without the key can make it."""
    path = tmp_path / "forged.zip"
    with zipfile.ZipFile(site.bundle) as archive, zipfile.ZipFile(path, "w") as other:
        for name in archive.namelist():
            other.writestr(name, archive.read(name).replace(b'"Ada"', b'"Eve"'))
    return path.read_bytes()


def test_a_forged_archive_before_the_genuine_one_is_found(site: Site, tmp_path: Path) -> None:
    both = tmp_path / "both.zip"
    both.write_bytes(forged(site, tmp_path) + site.bundle.read_bytes())
    unpacked = dict(streamed(both.read_bytes()))
    assert b'"Eve"' in unpacked["events.jsonl"]  # what another reader takes for the events
    with zipfile.ZipFile(both) as archive:
        assert b'"Eve"' not in archive.read("events.jsonl")
    assert any("something lies before its first file" in fault for fault in check(both))
    assert bundle_verifier.main([str(both)]) == 1
    assert check(site.bundle) == []


def lengthened_directory(content: bytes, *, start: int = 0, size: int = 0) -> bytes:
    """The content with the places in its last record moved."""
    made = bytearray(content)
    held_size, held_start = struct.unpack_from("<2L", made, len(made) - 10)
    struct.pack_into("<2L", made, len(made) - 10, held_size + size, held_start + start)
    return bytes(made)


def shifted(content: bytes, before: bytes) -> bytes:
    """The content behind other bytes, with every place in it corrected, as a self-extracting archive has it."""
    made = bytearray(lengthened_directory(content, start=len(before)))
    at = struct.unpack_from("<L", content, len(content) - 6)[0]
    while bytes(made[at : at + 4]) == b"PK\x01\x02":
        (offset,) = struct.unpack_from("<L", made, at + 42)
        struct.pack_into("<L", made, at + 42, offset + len(before))
        at += 46 + sum(struct.unpack_from("<3H", made, at + 28))
    return before + bytes(made)


def between(content: bytes, inserted: bytes) -> bytes:
    """Bytes between the last file and the directory."""
    at = struct.unpack_from("<L", content, len(content) - 6)[0]
    return lengthened_directory(content[:at] + inserted + content[at:], start=len(inserted))


def renamed_in_its_header(content: bytes) -> bytes:
    at = content.index(b"events.jsonl")
    return content[:at] + b"Events.jsonl" + content[at + 12 :]


def with_comment(content: bytes) -> bytes:
    return content[:-2] + struct.pack("<H", 4) + b"\0\0\0\0"


def of_two_parts(content: bytes) -> bytes:
    return content[:-18] + struct.pack("<2H", 1, 1) + content[-14:]


CONTAINERS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "bytes behind it": (lambda content: content + b"\0" * 40, "something follows the end"),
    "a comment": (with_comment, "something follows the end"),
    "bytes before it": (lambda content: b"#!/bin/sh\n" + content, "something lies before its first file"),
    "bytes before it, places corrected": (lambda content: shifted(content, b"#!/bin/sh\n"), "something lies before"),
    "bytes before the directory": (lambda content: between(content, b"x" * 50), "between its last file and"),
    "another name in the header": (renamed_in_its_header, "differs from the directory"),
    "one of two parts": (of_two_parts, "one of several parts"),
}


@pytest.mark.parametrize("name", CONTAINERS)
def test_what_is_not_exactly_one_archive_is_found(site: Site, tmp_path: Path, name: str) -> None:
    change, said = CONTAINERS[name]
    path = tmp_path / "b.zip"
    path.write_bytes(change(site.bundle.read_bytes()))
    try:
        found = check(path)
    except bundle_verifier.NotABundleError as error:
        found = [str(error)]
    assert any(said in fault for fault in found), found
    assert bundle_verifier.main([str(path)]) in (1, 2)


def packed(folder: Path, target: Path, entry: Callable[[zipfile.ZipFile, str, bytes], None]) -> Path:
    """The unpacked bundle, packed again; `entry` writes the README."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            name = path.relative_to(folder).as_posix()
            if name == "README.txt":
                entry(archive, name, path.read_bytes())
            else:
                archive.write(path, name)
    return target


def plainly(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    archive.writestr(name, content)


def under_two_names(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    other = b"other.txt"
    info = zipfile.ZipInfo(name)
    info.extra = struct.pack("<2HBL", 0x7075, 5 + len(other), 1, zlib.crc32(name.encode())) + other
    archive.writestr(info, content)


def test_a_bundle_that_was_packed_again_is_whole(unpacked: Path, tmp_path: Path) -> None:
    assert check(packed(unpacked, tmp_path / "b.zip", plainly)) == []
    found = check(packed(unpacked, tmp_path / "names.zip", under_two_names))
    assert len(found) == 1
    assert "additions of the kind 0x7075" in found[0]


def test_bytes_hidden_behind_the_compressed_content_are_found(unpacked: Path, tmp_path: Path) -> None:
    path = packed(unpacked, tmp_path / "b.zip", plainly)
    content, hidden = path.read_bytes(), b"PK\x03\x04 a header of another file"
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("README.txt")
        later = [other.header_offset for other in archive.infolist() if other.header_offset > info.header_offset]
    end = min(later)  # where the next file begins
    made = bytearray(content[:end] + hidden + content[end:])
    struct.pack_into("<L", made, info.header_offset + 18, info.compress_size + len(hidden))
    made = bytearray(lengthened_directory(bytes(made), start=len(hidden)))
    at = struct.unpack_from("<L", made, len(made) - 6)[0]
    while bytes(made[at : at + 4]) == b"PK\x01\x02":
        compressed, offset = struct.unpack_from("<L", made, at + 20)[0], struct.unpack_from("<L", made, at + 42)[0]
        if offset == info.header_offset:
            struct.pack_into("<L", made, at + 20, compressed + len(hidden))
        elif offset >= end:
            struct.pack_into("<L", made, at + 42, offset + len(hidden))
        at += 46 + sum(struct.unpack_from("<3H", made, at + 28))
    path.write_bytes(bytes(made))
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None  # Python's own reader sees nothing
    (fault,) = check(path)
    assert fault.startswith("README.txt: its compressed bytes are not exactly those of its content")


class Pipe(io.RawIOBase):
    """Takes what is written and cannot go back, so sizes follow behind each file."""

    def __init__(self) -> None:
        self.content = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, content: Any) -> int:
        self.content += content
        return len(content)


def test_a_bundle_packed_into_a_pipe_says_what_to_do(unpacked: Path, tmp_path: Path) -> None:
    path, pipe = tmp_path / "b.zip", Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(file for file in unpacked.rglob("*") if file.is_file()):
            archive.writestr(file.relative_to(unpacked).as_posix(), file.read_bytes())
    path.write_bytes(pipe.content)
    (fault,) = check(path)
    assert "leaves its size open (pack it again, or verify the folder)" in fault


def test_a_folder_holds_nothing_but_what_is_listed(unpacked: Path) -> None:
    for name in (".DS_Store", "artefacts/Thumbs.db", "desktop.ini"):
        (unpacked / name).write_bytes(b"left by a file manager")
    found = bundle_verifier.Check()
    found.run(unpacked, None, None)
    assert found.faults == []
    assert sum("a file manager left this here" in note for note in found.notes) == 3
    (unpacked / "hashlib.py").write_text("raise SystemExit(0)")
    (unpacked / "__pycache__").mkdir()
    os.mkfifo(unpacked / "pipe")
    assert check(unpacked) == [
        "pipe: it is a device or a pipe, not a file",
        "hashlib.py: it is in the bundle, but not in the manifest",
        "__pycache__: it is a folder that is not in the manifest",
    ]


def test_the_verifier_says_when_a_file_beside_it_may_have_taken_over(site: Site, unpacked: Path) -> None:
    script = unpacked / "verify.py"
    words = [sys.executable, str(script), str(site.bundle)]
    done = subprocess.run(words, cwd=unpacked, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0
    assert "not started as `python -I verify.py`" in done.stdout
    assert "not started" not in run_verifier(script, str(site.bundle), cwd=unpacked).stdout
    (unpacked / "hashlib.py").write_text("print('WHOLE AND UNALTERED'); raise SystemExit(0)")
    done = run_verifier(script, str(unpacked), cwd=unpacked)  # with -I it does not take over
    assert done.returncode == 1
    assert "hashlib.py: it is in the bundle, but not in the manifest" in done.stdout
