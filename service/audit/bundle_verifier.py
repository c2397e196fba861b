"""Tell whether an evidence bundle of orthocapture is whole and unaltered, on a machine without orthocapture.

    python -I verify.py BUNDLE.zip [--key FINGERPRINT] [--certificates FILE] [--json]
    python -I verify.py FOLDER        the same for an unpacked bundle; nothing is unpacked here

Without -I, Python would take a module from beside this file, such as a forged hashlib.py, in place of its own.
Needs Python 3.9 or newer and the package `cryptography`, nothing else and no network. Nothing is written.
Exit status: 0 whole and unaltered; 1 something differs, or a recorded pose contradicts the joints recorded with it,
and each is named; 2 nothing can be said, because this is not a bundle or `cryptography` is missing.

Every signature here is checked against keys that the bundle itself brings. That the bundle comes from whom it says
it comes from, only a key's fingerprint tells, if you obtained it in another way: give it with --key.
"""

from __future__ import annotations

import argparse
import base64
import datetime
import hashlib
import json
import math
import re
import stat
import struct
import sys
import zipfile
import zlib
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.x509.oid import ExtendedKeyUsageOID
except ImportError:
    sys.stderr.write("The package `cryptography` is needed: python -m pip install cryptography\n")
    raise SystemExit(2) from None  # nothing was found to differ

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

FORMAT = "orthocapture bundle v1"
CHECKPOINT = "orthocapture checkpoint v1"
MANIFEST_PREFIX = b"orthocapture bundle manifest v1\n"
MANIFEST, SIGNATURE = "manifest.json", "manifest.sig"
SITE = "site"
ROOT = "0" * 64
CHUNK = 1 << 20
LARGEST_MANIFEST = 64 << 20
LARGEST_LINE = 64 << 20
NOT_ISOLATED = (
    "This verifier was not started as `python -I verify.py`: a file beside it, such as hashlib.py, may have taken "
    "the place of a part of Python. Start it again with -I."
)
# What file managers leave in folders that they show, whatever the folder is.
LEFT_BY_FILE_MANAGERS = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})
LARGEST_EXPANSION = 200  # of a compressed file; records compress twentyfold at most
MOST_DEEP = 100  # of JSON within JSON; records have a tenth of it
SAFE_INTEGER = 2**53 - 1
REFERENCE = frozenset({"sha256", "kind", "media_type", "size_bytes", "original_name"})
# What a record must have, and of which kind; everything else is compared, not used.
KINDS: dict[str, dict[str, type]] = {
    "events.jsonl": {"run_id": str, "seq": int, "previous_sha256": str, "sha256": str, "payload": dict},
    "site_events.jsonl": {"run_id": str, "seq": int, "previous_sha256": str, "sha256": str, "payload": dict},
    "artefacts.jsonl": {"seq": int, "sha256": str, "size_bytes": int, "original_name": str, "record_sha256": str},
    "jobs.jsonl": {"job_id": str},
    "checkpoints.jsonl": {"run_id": str, "seq": int, "site_seq": int, "key_id": str, "signature": str},
    "timestamps.jsonl": {"run_id": str, "seq": int, "token": str},
    "keys.jsonl": {"key_id": str},
}
# What reading a file of a bundle may end in, whatever its bytes are.
UNREADABLE = (OSError, zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError, RuntimeError)
# What a time stamp and the certificates in it may end in.
UNPROVEN = (
    *(ValueError, IndexError, KeyError, TypeError, OverflowError, AttributeError, InvalidSignature),
    *(UnsupportedAlgorithm, x509.ExtensionNotFound, x509.DuplicateExtension, x509.InvalidVersion),
)
SIGNED_AT_ONCE = ("step_passed", "run_completed", "run_aborted")
AFTER_A_SIGNATURE = ("step_started", "session_started", "run_completed", "run_aborted")  # recorded once that is done
JOB_FIELDS = {"job": "job_id", "job_kind": "kind", "step": "step", "attempt": "attempt"}
# Published lengths of the arms of Universal Robots: a2, a3, d1, d4, d5, d6 in metres, by the lower-case name that the
# controller gives. It reports the tool, so a tool that nobody reckoned with shows in pose against joints.
ARMS: dict[str, tuple[float, float, float, float, float, float]] = {
    "ur3": (-0.24365, -0.21325, 0.1519, 0.11235, 0.08535, 0.0819),
    "ur3e": (-0.24355, -0.2132, 0.15185, 0.13105, 0.08535, 0.0921),
    "ur5": (-0.425, -0.39225, 0.089159, 0.10915, 0.09465, 0.0823),
    "ur5e": (-0.425, -0.3922, 0.1625, 0.1333, 0.0997, 0.0996),
    "ur10": (-0.612, -0.5723, 0.1273, 0.163941, 0.1157, 0.0922),
    "ur10e": (-0.6127, -0.57155, 0.1807, 0.17415, 0.11985, 0.11655),
    "ur16e": (-0.4784, -0.36, 0.1807, 0.17415, 0.11985, 0.11655),
    "ur20": (-0.8620, -0.7287, 0.2363, 0.2010, 0.1593, 0.1543),
    "ur30": (-0.6370, -0.5037, 0.2363, 0.2010, 0.1593, 0.1543),
}
TWISTS_RAD = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
# A controller computes with the arm's factory calibration; of the published ones none differs by 6 mm from this.
FITS_M, FITS_RAD = 0.010, math.radians(2.0)


class NotABundleError(Exception):
    """Nothing can be said of this: exit status 2."""


# --- RFC 8785 canonical JSON ------------------------------------------------------------------------------------

_ESCAPES = {"\b": "\\b", "\t": "\\t", "\n": "\\n", "\f": "\\f", "\r": "\\r", '"': '\\"', "\\": "\\\\"}
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]"
    r"|[\ud800-\udfff\U000e0000-\U000e007f]"
)
_ESCAPED = re.compile(r'[\x00-\x1f"\\]')


def canonical(value: Any) -> bytes:
    """Return RFC 8785 canonical JSON. Raises ValueError for what has none."""
    parts: list[str] = []
    _write(value, parts)
    return "".join(parts).encode("utf-8")  # a lone surrogate raises UnicodeEncodeError, which is a ValueError


def _write(value: Any, parts: list[str]) -> None:
    if value is None or value is True or value is False:
        parts.append({None: "null", True: "true", False: "false"}[value])
    elif isinstance(value, str):
        parts.append(_string(value))
    elif isinstance(value, int):
        if not -SAFE_INTEGER <= value <= SAFE_INTEGER:
            raise ValueError(f"{value} is beyond 2^53")
        parts.append(str(value))
    elif isinstance(value, float):
        parts.append(number(value))
    elif isinstance(value, (list, tuple)):
        parts.append("[")
        for index, item in enumerate(value):
            parts.append("," if index else "")
            _write(item, parts)
        parts.append("]")
    elif isinstance(value, dict):
        parts.append("{")
        for index, name in enumerate(sorted(value, key=lambda text: text.encode("utf-16-be", "surrogatepass"))):
            parts.append("," if index else "")
            parts.append(_string(name) + ":")
            _write(value[name], parts)
        parts.append("}")
    else:
        raise ValueError(f"{type(value).__name__} has no JSON form")  # one kind of error for callers


def _string(text: str) -> str:
    return '"' + _ESCAPED.sub(lambda found: _ESCAPES.get(found[0]) or f"\\u{ord(found[0]):04x}", text) + '"'


def number(value: float) -> str:
    """Return a double as ECMAScript writes it (Number::toString): the shortest digits that read back as the same."""
    if not math.isfinite(value):
        raise ValueError(f"{value} has no JSON form")
    if value == 0:
        return "0"
    sign = "-" if value < 0 else ""
    mantissa, _, exponent = repr(abs(value)).partition("e")  # repr gives the shortest digits too
    whole, _, fraction = mantissa.partition(".")
    fraction = "" if fraction == "0" else fraction
    digits = (whole + fraction).lstrip("0")
    point = len(whole) + int(exponent or 0)  # digits before the decimal point, counted from the first of `whole`
    point -= len(whole + fraction) - len((whole + fraction).lstrip("0"))
    digits = digits.rstrip("0")
    count = len(digits)
    if count <= point <= 21:
        text = digits + "0" * (point - count)
    elif 0 < point <= 21:
        text = digits[:point] + "." + digits[point:]
    elif -6 < point <= 0:
        text = "0." + "0" * -point + digits
    else:
        power = point - 1
        text = (
            digits[0] + ("." + digits[1:] if count > 1 else "") + "e" + ("-" if power < 0 else "+") + str(abs(power))
        )
    return sign + text


def short_words(error: Exception) -> str:
    """Return an error's type and message, cut to 200 characters because some messages carry bytes along."""
    return f"{type(error).__name__}: {error}"[:200]


def parse(text: bytes) -> Any:
    """Return JSON without duplicate names, NaN and infinity. Raises ValueError."""
    try:
        found = json.loads(
            text.decode("utf-8"), object_pairs_hook=_pairs, parse_int=_integer, parse_constant=_constant
        )
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    # How deep the parser itself goes depends on the version of Python, and everything behind it recurses too.
    level = [found] if isinstance(found, (dict, list)) else []
    for _ in range(MOST_DEEP):
        inside = [holder.values() if isinstance(holder, dict) else holder for holder in level]
        level = [item for items in inside for item in items if isinstance(item, (dict, list))]
        if not level:
            return found
    raise ValueError("it is nested too deeply")


def _pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a name appears twice")
    return found


def _integer(digits: str) -> Any:
    # The canonical form of 1e20 has no exponent: beyond the safe range the number can only have been a double.
    if len(digits) > 400:
        raise ValueError("a number is too long")
    value = int(digits)
    return value if -SAFE_INTEGER <= value <= SAFE_INTEGER else float(digits)


def _constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


# --- the container ----------------------------------------------------------------------------------------------


class Bundle:
    """The files of a bundle: names and sizes, and a stream of each; of an unpacked one, also its folders."""

    sizes: dict[str, int]
    folders: Sequence[str] = ()
    left_by_others: Sequence[str] = ()

    def open(self, name: str) -> IO[bytes]:
        """Return a stream of one file."""
        raise NotImplementedError

    def read(self, name: str, limit: int) -> bytes:
        """Return a small file as a whole. Raises ValueError when it is longer than it may be."""
        with self.open(name) as stream:
            content = stream.read(limit + 1)
        if len(content) > limit:
            raise ValueError("the file is too long")
        return content

    def lines(self, name: str) -> Iterator[bytes]:
        """Yield the lines of a file without their ends. Raises ValueError for one that is too long or not ended."""
        with self.open(name) as stream:
            while line := stream.readline(LARGEST_LINE):
                if not line.endswith(b"\n"):
                    raise ValueError("a line is too long or has no end")
                yield line[:-1]


class ZipBundle(Bundle):
    """A zip file, read where it is.

    Readers disagree on what a zip file holds: some go by the directory at its end, others by the headers along the
    way. Only a file that both read alike is accepted.
    """

    def __init__(self, path: Path, fault: Callable[[str, str], None]) -> None:
        try:
            self._zip = zipfile.ZipFile(path)
            infos = self._zip.infolist()
            with path.open("rb") as stream:
                for problem in ZipLayout(stream, path.stat().st_size).problems(infos):
                    fault(path.name, f"{problem}: programs may read different contents from it")
        except UNREADABLE as error:
            raise NotABundleError(f"{path} cannot be read as a zip file: {error}") from error
        self._infos: dict[str, zipfile.ZipInfo] = {}
        self.sizes = {}
        compressed = 0
        for info in infos:
            compressed += info.compress_size
            problem = name_problem(info.orig_filename) or _entry_problem(info)
            if problem:
                fault(repr(info.orig_filename), problem)
            elif info.filename in self._infos:
                fault(info.filename, "the zip file holds this name twice")
            elif info.file_size > LARGEST_EXPANSION * info.compress_size + CHUNK:
                fault(info.filename, f"it would expand from {info.compress_size} to {info.file_size} bytes: not read")
            else:
                self._infos[info.filename] = info
                self.sizes[info.filename] = info.file_size
        if compressed > path.stat().st_size:
            raise NotABundleError("the entries of the zip file overlap: nothing in it was read")
        with path.open("rb") as stream:
            for name, info in self._infos.items():
                problem = _stream_problem(stream, info)
                if problem:
                    fault(name, problem)

    def open(self, name: str) -> IO[bytes]:
        """Open a file of the zip archive for reading."""
        return self._zip.open(self._infos[name])


def _offset(listed: tuple[zipfile.ZipInfo, bytes]) -> int:
    return listed[0].header_offset


class ZipLayout:
    """The layout of a zip file's parts. Entries and directory must cover it without a gap, as they were written."""

    _END, _END_64, _LOCATOR_64 = b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"
    _CENTRAL, _LOCAL = b"PK\x01\x02", b"PK\x03\x04"
    # Extra fields that change nothing: sizes beyond 4 GB, times and owners. Others may give another name or content.
    _HARMLESS = frozenset({0x0001, 0x000A, 0x5455, 0x5855, 0x7855, 0x7875})

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self._stream = stream
        self._size = size

    def problems(self, infos: Sequence[zipfile.ZipInfo]) -> list[str]:
        """List what keeps this from being exactly one zip file."""
        try:
            start, end, count = self._directory()
            names = self._directory_names(start, end)
            if len(names) != len(infos) or count != len(infos):
                return ["its directory lists another number of files than it says"]
            return self._entry_problems(infos, names, start)
        except (struct.error, ValueError) as error:
            return [str(error) if isinstance(error, ValueError) else "it is cut off"]

    def _at(self, offset: int, size: int) -> bytes:
        self._stream.seek(offset)
        return self._stream.read(size)

    def _directory(self) -> tuple[int, int, int]:
        """Return where the directory begins and ends, and how many files it lists. Raises ValueError."""
        end = self._size - 22
        last = self._at(max(end, 0), 22)
        if not last.startswith(self._END) or last[20:] != b"\0\0":
            raise ValueError("something follows the end of the zip file")
        disk, first_disk, here, count, size, start = struct.unpack("<4H2L", last[4:20])
        if (disk, first_disk, here) != (0, 0, count):
            raise ValueError("it says that it is one of several parts")
        if end >= 20 and self._at(end - 20, 4) == self._LOCATOR_64:
            disk, at, disks = struct.unpack("<LQL", self._at(end - 16, 16))
            record = self._at(at, 56)
            if at + 56 != end - 20 or not record.startswith(self._END_64) or record[4:12] != struct.pack("<Q", 44):
                raise ValueError("something lies within the end of the zip file")
            first_disk, other_disk, here, count, size, start = struct.unpack("<2L4Q", record[16:])
            if (disk, disks, first_disk, other_disk, here) != (0, 1, 0, 0, count):
                raise ValueError("it says that it is one of several parts")
            end = at
        if start + size != end:
            raise ValueError("something lies before its first file, or between its directory and its end")
        return start, end, count

    def _directory_names(self, start: int, end: int) -> list[bytes]:
        """Return the names in the directory, as bytes. Raises ValueError, struct.error."""
        names: list[bytes] = []
        while start < end:
            head = self._at(start, 46)
            if not head.startswith(self._CENTRAL):
                raise ValueError("its directory has a gap")
            name, extra, comment = struct.unpack("<3H", head[28:34])
            if comment or head[34:36] != b"\0\0":
                raise ValueError("its directory has comments or other parts")
            names.append(self._at(start + 46, name))
            self._check_extra(self._at(start + 46 + name, extra))
            start += 46 + name + extra
        if start != end:
            raise ValueError("its directory is cut off")
        return names

    def _check_extra(self, extra: bytes) -> bytes:
        """Return the sizes beyond 4 GB among the extra fields. Raises ValueError, struct.error."""
        sizes = b""
        while extra:
            kind, size = struct.unpack("<2H", extra[:4])
            if kind not in self._HARMLESS or len(extra) < 4 + size:
                raise ValueError(f"its entries have additions of the kind {kind:#06x}, which no bundle has")
            if kind == 1:
                sizes = extra[4 : 4 + size]
            extra = extra[4 + size :]
        return sizes

    def _entry_problems(self, infos: Sequence[zipfile.ZipInfo], names: Sequence[bytes], end: int) -> list[str]:
        """Return entries that do not follow each other, or whose own header differs from the directory."""
        found: list[str] = []
        position = 0
        for info, name in sorted(zip(infos, names), key=_offset):  # noqa: B905 - not in 3.9
            if info.header_offset != position:
                return [*found, f"something lies before {name!r}, or it overlaps another file"]
            head = self._at(position, 30)
            if not head.startswith(self._LOCAL):
                return [*found, f"{name!r} has no header where the directory places it"]
            _, flags, method, _, _, crc, compressed, size, length, extra = struct.unpack("<5H3L2H", head[4:])
            own = self._at(position + 30, length)
            beyond = self._check_extra(self._at(position + 30 + length, extra))
            if 0xFFFFFFFF in (compressed, size):
                size, compressed = struct.unpack("<2Q", beyond[:16])
            if flags & 8:
                return [*found, f"the header of {name!r} leaves its size open (pack it again, or verify the folder)"]
            if (own, flags, method, crc, compressed, size) != (
                *(name, info.flag_bits, info.compress_type),
                *(info.CRC, info.compress_size, info.file_size),
            ):
                found.append(f"the header of {name!r} differs from the directory")
            position = info.header_offset + 30 + length + extra + info.compress_size
        if position != end:
            found.append("something lies between its last file and its directory")
        return found


class FolderBundle(Bundle):
    """An unpacked bundle."""

    def __init__(self, folder: Path, fault: Callable[[str, str], None]) -> None:
        self._folder = folder
        self.sizes = {}
        folders: list[str] = []
        left: list[str] = []
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder).as_posix()
            if path.is_symlink():
                fault(name, "it is a link, not a file")
            elif path.is_dir():
                folders.append(name)
            elif not path.is_file():
                fault(name, "it is a device or a pipe, not a file")
            elif path.name in LEFT_BY_FILE_MANAGERS:
                left.append(name)
            else:
                self.sizes[name] = path.stat().st_size
        self.folders, self.left_by_others = folders, left

    def open(self, name: str) -> IO[bytes]:
        """Open a file of the folder for reading."""
        return (self._folder / name).open("rb")


def name_problem(name: str) -> str:
    """Return why a name must not be in a bundle (it could lead out of the unpacked folder); "" for a good one."""
    if not name or "\\" in name or "\x00" in name or name.startswith("/") or re.match(r"[A-Za-z]:", name):
        return "the name leads out of the bundle, or is none"
    if any(part in ("", ".", "..") for part in name.rstrip("/").split("/")):
        return "the name leads out of the bundle, or is none"
    return ""


def _entry_problem(info: zipfile.ZipInfo) -> str:
    mode = info.external_attr >> 16
    if info.is_dir() or stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        return "it is a folder, a link or a device, not a file"
    if info.flag_bits & 1:
        return "it is encrypted"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return "it is compressed in a way that no bundle is"  # others may ask for gigabytes to unpack a kilobyte
    return ""


def _stream_problem(stream: IO[bytes], info: zipfile.ZipInfo) -> str:
    """Return why the bytes of an entry are not exactly its content, with nothing behind it; "" if they are."""
    if info.compress_type == zipfile.ZIP_STORED:
        return "" if info.compress_size == info.file_size else "it is stored with another size than it has"
    stream.seek(info.header_offset + 26)
    lengths = stream.read(4)
    stream.seek(info.header_offset + 30 + sum(lengths[::2]) + 256 * sum(lengths[1::2]))
    expand, left, size = zlib.decompressobj(-15), info.compress_size, 0
    try:
        while not expand.eof and size <= info.file_size:
            chunk = expand.unconsumed_tail or stream.read(min(CHUNK, left))
            left -= 0 if expand.unconsumed_tail else len(chunk)
            content = expand.decompress(chunk, CHUNK)
            size += len(content)
            if not chunk and not content:
                break
    except zlib.error as error:
        return f"it cannot be expanded ({error})"
    if left or expand.unused_data or not expand.eof or size != info.file_size:
        return "its compressed bytes are not exactly those of its content: something may be hidden behind it"
    return ""


# --- the checks -------------------------------------------------------------------------------------------------


class Check:
    """One pass over a bundle: faults and notes, in the order in which they were found."""

    files: dict[str, tuple[str, int]]  # the files as the manifest lists them

    def __init__(self) -> None:
        self.faults: list[dict[str, str]] = []
        self.notes: list[str] = []
        self.manifest: dict[str, Any] = {}
        self.keys: dict[str, dict[str, Any]] = {}  # key_id → seq, replaced_seq, raw, vouched
        self.counts: dict[str, int] = {}
        self.contradictions: list[dict[str, str]] = []  # recorded as they were, and yet wrong

    def fault(self, where: str, what: str) -> None:
        """Note something that is not as it should be."""
        self.faults.append({"where": where, "what": what})

    def run(self, path: Path, key: str | None, certificates: Path | None) -> None:
        """Verify everything. Raises NotABundleError."""
        if not path.exists():
            raise NotABundleError(f"{path} is not there")
        bundle = FolderBundle(path, self.fault) if path.is_dir() else ZipBundle(path, self.fault)
        signed = self._read_manifest(bundle)
        whole = self._check_files(bundle)
        run_id = str(self.manifest["run_id"])
        site = Chain(self, bundle, "site_events.jsonl", SITE, whole)
        run = Chain(self, bundle, "events.jsonl", run_id, whole)
        self.notes += [
            f"event {seq}: {payload.get('step')} counts as passed with figures outside their limits, as {actor} "
            f"({payload.get('role')}) accepted them: {payload.get('reason')}"
            for seq, payload, actor in run.accepted
        ]
        self.contradictions, notes = run.poses.findings(run.file)
        self.notes += notes
        self._check_heads(run, site)
        rows = self._check_artefacts(bundle, run, whole)
        chains = {chain.run_id: chain for chain in (run, site)}
        signatures = list(self.records(bundle, "checkpoints.jsonl", whole))
        self._check_keys(site, signatures)
        self._check_checkpoints(signatures, chains, site, rows)
        self._check_key_file(bundle, whole)
        self._check_signature(bundle, signed)
        self._check_jobs(bundle, run, whole)
        self._check_copies(bundle, run)
        self._check_crate(bundle, whole)
        stamps = list(self.records(bundle, "timestamps.jsonl", whole))
        self._check_stamps(stamps, signatures, certificates)
        self._check_expected_key(key)

    # --- manifest and files ---

    def _read_manifest(self, bundle: Bundle) -> bytes:
        if MANIFEST not in bundle.sizes:
            raise NotABundleError("there is no manifest.json: this is not a bundle of orthocapture")
        try:
            content = bundle.read(MANIFEST, LARGEST_MANIFEST)
            manifest = parse(content)
            files = {str(item["path"]): (str(item["sha256"]), int(item["size_bytes"])) for item in manifest["files"]}
            canonical(manifest)  # what has no canonical form cannot be shown either
            if manifest["format"] != FORMAT:
                raise NotABundleError(f"this verifier does not know the format {manifest['format']!r}")
            for name in ("run_id", "simulated", "hashes_only", "made_by_key"):
                manifest[name]
            for name in ("head", "site_head"):
                if not isinstance(manifest[name], dict):
                    raise TypeError(f"{name} is not an object")  # noqa: TRY301
        except (*UNREADABLE, KeyError, TypeError, OverflowError, AttributeError) as error:
            raise NotABundleError(f"manifest.json cannot be read: {short_words(error)}") from error
        if len(files) != len(manifest["files"]):
            self.fault(MANIFEST, "it lists a file twice")
        self.manifest = manifest
        self.files = files
        return content

    def _check_files(self, bundle: Bundle) -> frozenset[str]:
        """Check that exactly the listed files are present and unaltered. Returns the names of the intact ones."""
        whole: list[str] = []
        for name, (sha256, size) in self.files.items():
            if name not in bundle.sizes:
                self.fault(name, "it is missing from the bundle")
            elif bundle.sizes[name] != size:
                self.fault(name, f"it has {bundle.sizes[name]} bytes, the manifest lists {size}")
            else:
                found = self._hash(bundle, name)
                if found != sha256:
                    self.fault(name, f"its content was altered: its SHA-256 is {found}, the manifest lists {sha256}")
                whole.append(name)  # altered records are read too, to say what was altered
        for name in sorted(set(bundle.sizes) - set(self.files) - {MANIFEST, SIGNATURE}):
            self.fault(name, "it is in the bundle, but not in the manifest")
        holding = {name[:at] for name in self.files for at, letter in enumerate(name) if letter == "/"}
        for name in bundle.folders:
            if name not in holding:
                self.fault(name, "it is a folder that is not in the manifest")
        self.notes += [
            f"{name}: a file manager left this here; it is no part of the bundle" for name in bundle.left_by_others
        ]
        for name in ("events.jsonl", "site_events.jsonl", "artefacts.jsonl", "jobs.jsonl", "checkpoints.jsonl"):
            if name not in self.files:
                self.fault(name, "a bundle must have it; the manifest does not list it")
        self.counts["files"] = len(self.files)
        return frozenset(whole)

    def _hash(self, bundle: Bundle, name: str) -> str:
        digest = hashlib.sha256()
        try:
            with bundle.open(name) as stream:
                while chunk := stream.read(CHUNK):
                    digest.update(chunk)
        except UNREADABLE as error:
            return f"unreadable ({error})"
        return digest.hexdigest()

    def records(self, bundle: Bundle, name: str, whole: frozenset[str]) -> Iterator[dict[str, Any]]:
        """Yield the lines of a file of records, each canonical JSON."""
        if name not in whole:
            return
        try:
            for index, line in enumerate(bundle.lines(name), 1):
                try:
                    record = parse(line)
                    if not isinstance(record, dict) or canonical(record) != line:
                        raise ValueError("it is not canonical JSON: its text was altered")  # noqa: TRY301
                    for field, kind in KINDS[name].items():
                        if type(record.get(field)) is not kind:
                            raise ValueError(f"its field {field} is missing or of another kind")  # noqa: TRY301
                except ValueError as error:
                    self.fault(f"{name}, line {index}", str(error))
                else:
                    yield record
        except UNREADABLE as error:
            self.fault(name, f"it cannot be read to its end: {error}")

    def _check_heads(self, run: Chain, site: Chain) -> None:
        for chain, name in ((run, "head"), (site, "site_head")):
            head = self.manifest[name]
            if (head.get("seq"), head.get("sha256")) != chain.end:
                said = f"event {head.get('seq')} ({head.get('sha256')})"
                self.fault(
                    chain.file, f"the chain ends at event {chain.end[0]} ({chain.end[1]}), it was left at {said}"
                )
        first = run.first or {}
        if first.get("kind") != "run_started":
            self.fault(run.file, "the chain does not begin with run_started")
        elif bool(first.get("simulated")) != self.manifest["simulated"]:
            self.fault(MANIFEST, "the manifest and the run's first event disagree on whether it was simulated")
        for start, heads in site.starts:
            seq, sha256 = heads.get(run.run_id, (0, ""))
            if seq and run.hashes.get(seq) != sha256:
                what = f"the service saw another event {seq} when it started (event {start} of the site's chain)"
                self.fault(run.file, what)
        for at, signed in site.signed:
            seq = signed.get("seq")
            known = run.hashes.get(seq) if isinstance(seq, int) else None
            if signed.get("run") == run.run_id and known != signed.get("sha256"):
                what = f"another event {seq} was signed once (event {at} of the site's chain): cut or rewritten"
                self.fault(run.file, what)

    # --- artefacts ---

    def _check_artefacts(self, bundle: Bundle, run: Chain, whole: frozenset[str]) -> list[dict[str, Any]]:
        rows = list(self.records(bundle, "artefacts.jsonl", whole))
        present = frozenset(name for name in whole if name.startswith("artefacts/"))
        wanted: dict[str, int] = {}
        for row in rows:
            seq, sha256 = row.get("seq"), str(row.get("sha256"))
            shown = f"artefacts.jsonl, {row.get('original_name')} of event {seq}"
            event = run.hashes.get(seq)
            reference = canonical({name: row.get(name) for name in REFERENCE})
            if event is None:
                self.fault(shown, "it belongs to an event that is not there")
                continue
            named = {name: value for name, value in row.items() if name != "record_sha256"}
            if hashlib.sha256(canonical(dict(named, event_sha256=event))).hexdigest() != row.get("record_sha256"):
                self.fault(shown, "the row was altered (device, step, time, who …)")
            elif reference not in run.references.get(int(row["seq"]), ()):
                self.fault(shown, "the row is not what the event refers to")
            wanted[sha256] = int(row.get("size_bytes", -1))
        recorded = {canonical({name: row.get(name) for name in ("sha256", "size_bytes")}) for row in rows}
        for seq, found in run.references.items():
            for text in found:
                reference = parse(text)
                if canonical({name: reference[name] for name in ("sha256", "size_bytes")}) not in recorded:
                    self.fault(run.file, f"event {seq} refers to {reference['original_name']}, which has no row")
        self._check_artefact_files(wanted, present)
        self.counts["artefacts"] = len(rows)
        return rows

    def _check_artefact_files(self, wanted: Mapping[str, int], present: frozenset[str]) -> None:
        for sha256, size in wanted.items():
            name = f"artefacts/{sha256[:2]}/{sha256}"
            if self.manifest["hashes_only"]:
                continue
            if name not in self.files:
                self.fault(name, "an artefact of the record is not among the files of the bundle")
            elif self.files[name] != (sha256, size):
                self.fault(name, "the manifest lists another content than the record")
        for name in sorted(present):
            if name.rsplit("/", 1)[-1] not in wanted:
                self.fault(name, "no record refers to this file")
        if self.manifest["hashes_only"]:
            self.notes.append("The recorded files are not in this bundle, only their hashes.")

    # --- keys and signatures ---

    def _check_keys(self, site: Chain, signatures: Sequence[Mapping[str, Any]]) -> None:
        vouchers = {item.get("seq"): item for item in signatures if item.get("run_id") == SITE}
        before = ""
        for seq, change in site.key_changes:
            key_id = str(change.get("key_id"))
            shown = f"site_events.jsonl, event {seq}"
            try:
                raw = base64.b64decode(str(change.get("public_key")), validate=True)
            except ValueError:
                raw = b""
            if len(raw) != 32 or hashlib.sha256(raw).hexdigest() != key_id:
                self.fault(shown, f"the fingerprint {key_id} is not that of the public key")
            if change.get("previous_key_id") != before:
                self.fault(shown, f"key {key_id} does not follow the key before it")
            if key_id in self.keys:
                self.fault(shown, f"key {key_id} is introduced twice")
                continue
            vouched = not before
            if before:
                self.keys[before]["replaced_seq"] = seq
                voucher = vouchers.get(seq)
                vouched = voucher is not None and signature_fits(voucher, self.keys[before]["raw"])
                if not vouched:
                    self.notes.append(
                        f"Key {key_id} was not vouched for by the key before it ({change.get('reason')}): "
                        "compare its fingerprint with one obtained in another way."
                    )
            self.keys[key_id] = {"seq": seq, "replaced_seq": None, "raw": raw, "vouched": vouched}
            before = key_id
        if not self.keys:
            self.fault("site_events.jsonl", "it brings no public key: nothing can be proved")

    def _check_checkpoints(
        self,
        signatures: Sequence[Mapping[str, Any]],
        chains: Mapping[str, Chain],
        site: Chain,
        rows: Sequence[Mapping[str, Any]],
    ) -> None:
        last = dict.fromkeys(chains, 0)
        for item in signatures:
            run_id, seq = str(item.get("run_id")), item.get("seq")
            shown = f"checkpoints.jsonl, {run_id} at event {seq}"
            chain, key = chains.get(run_id), self.keys.get(str(item.get("key_id")))
            if chain is None or not isinstance(seq, int):
                self.fault(shown, "it belongs to no chain of this bundle")
                continue
            if key is None:
                self.fault(shown, f"its key {item.get('key_id')} is not in the site's chain")
            elif not signature_fits(item, key["raw"]):
                self.fault(shown, "its signature is not valid")
            elif not in_use(item, key):
                self.fault(shown, "its key was not in use at that time")
            if chain.hashes.get(seq) != item.get("sha256"):
                self.fault(shown, "it signs another event than the chain has: the chain was cut or rewritten")
            digest = hashlib.sha256()
            for row in rows if run_id != SITE else ():
                if row.get("seq", 0) <= seq:
                    digest.update(str(row.get("record_sha256")).encode() + b"\n")
            if digest.hexdigest() != item.get("artefacts_sha256"):
                self.fault(shown, "the rows of the artefacts up to it are not those that it signs")
            if site.hashes.get(item.get("site_seq")) != item.get("site_sha256"):
                self.fault(shown, "the site's chain is not the one that it names")
            last[run_id] = max(last[run_id], seq)
        self.counts["checkpoints"] = len(signatures)
        for run_id, chain in chains.items():
            self._note_late(chain, [item["seq"] for item in signatures if item.get("run_id") == run_id])
            if chain.end[0] > last[run_id]:
                self.notes.append(
                    f"{run_id}: {chain.end[0] - last[run_id]} events after the last checkpoint; "
                    "the signature of the bundle covers them."
                )

    def _note_late(self, run: Chain, signed: Sequence[int]) -> None:
        """Note events that had to be signed at once, and were signed only later."""
        late = [seq for seq, before in run.to_sign.items() if not any(seq <= at < before for at in signed)]
        if late:
            self.notes.append(
                f"{run.run_id}: not signed at once, but only with a later event: {', '.join(map(str, late))}; "
                "a change before that leaves no trace."
            )

    def _check_key_file(self, bundle: Bundle, whole: frozenset[str]) -> None:
        listed = [record.get("key_id") for record in self.records(bundle, "keys.jsonl", whole)]
        if listed != list(self.keys):
            self.fault("keys.jsonl", "it does not list the keys of the site's chain")

    def _check_signature(self, bundle: Bundle, signed: bytes) -> None:
        key_id = str(self.manifest["made_by_key"])
        key = self.keys.get(key_id)
        if SIGNATURE not in bundle.sizes:
            self.fault(SIGNATURE, "it is missing from the bundle")
            return
        try:
            signature = base64.b64decode(bundle.read(SIGNATURE, 4096).strip(), validate=True)
        except UNREADABLE as error:
            self.fault(SIGNATURE, f"it cannot be read: {error}")
            return
        if key is None or key["replaced_seq"] is not None:
            self.fault(MANIFEST, f"its key {key_id} is not the one in use at the end of the site's chain")
        elif not ed25519_fits(key["raw"], signature, MANIFEST_PREFIX + signed):
            self.fault(f"{MANIFEST}, {SIGNATURE}", "the signature is not valid: the manifest was altered")

    def _check_expected_key(self, key: str | None) -> None:
        made_by = str(self.manifest["made_by_key"])
        if key is None:
            self.notes.append(f"Compare this fingerprint with one obtained in another way (or use --key): {made_by}")
            return
        wanted = key.replace(":", "").replace(" ", "").lower()
        order = list(self.keys)
        if wanted not in self.keys:
            self.fault("--key", f"the bundle knows no key with the fingerprint {wanted}; it is signed with {made_by}")
        elif not all(self.keys[key_id]["vouched"] for key_id in order[order.index(wanted) + 1 :]):
            self.fault("--key", f"no unbroken line of signatures leads from {wanted} to the key in use")

    # --- the rest ---

    def _check_jobs(self, bundle: Bundle, run: Chain, whole: frozenset[str]) -> None:
        rows = {row.get("job_id"): row for row in self.records(bundle, "jobs.jsonl", whole)}
        known = set()
        for seq, payload in run.jobs:
            job = str(payload.get("job"))
            known.add(job)
            row = rows.get(job)
            if row is None:
                self.fault("jobs.jsonl", f"job {job} of event {seq} has no row")
            elif payload["kind"] == "job_enqueued":
                same = all(payload.get(name) == row.get(column) for name, column in JOB_FIELDS.items())
                if not same or row.get("enqueued_seq") != seq or row.get("arguments") != payload.get("arguments"):
                    self.fault("jobs.jsonl", f"job {job} differs from its event {seq}")
            elif (row.get("state"), row.get("ended_seq")) != (payload["kind"][4:], seq):
                self.fault("jobs.jsonl", f"job {job} is {row.get('state')}, but event {seq} is {payload['kind']}")
        for job in sorted(set(map(str, rows)) - set(map(str, known))):
            self.fault("jobs.jsonl", f"job {job} has no event")

    def _check_copies(self, bundle: Bundle, run: Chain) -> None:
        for field in ("protocol", "rig"):
            reference = (run.first or {}).get(field)
            name = f"{field}.yaml"
            if not isinstance(reference, dict) or self.files.get(name, ("", 0))[0] != reference.get("sha256"):
                self.fault(name, f"it is not the {field} file with which the run began")

    def _check_crate(self, bundle: Bundle, whole: frozenset[str]) -> None:
        name = "ro-crate-metadata.json"
        if name not in whole:
            return
        try:
            graph = parse(bundle.read(name, LARGEST_MANIFEST))["@graph"]
            listed = {str(item["@id"]): str(item.get("sha256", "")) for item in graph if "File" in str(item["@type"])}
        except (*UNREADABLE, KeyError, TypeError, AttributeError) as error:
            self.fault(name, f"it cannot be read: {short_words(error)}")
            return
        for path, sha256 in listed.items():
            if path in (MANIFEST, SIGNATURE) or path.startswith("#"):
                continue
            if path not in self.files or (sha256 and self.files[path][0] != sha256):
                self.fault(name, f"its description of {path} differs from the manifest")

    def _check_stamps(
        self,
        stamps: Sequence[Mapping[str, Any]],
        signatures: Sequence[Mapping[str, Any]],
        certificates: Path | None,
    ) -> None:
        signed = {(item.get("run_id"), item.get("seq")): item for item in signatures}
        roots = load_certificates(certificates)
        for stamp in stamps:
            shown = f"timestamps.jsonl, {stamp.get('authority')} at event {stamp.get('seq')}"
            item = signed.get((stamp.get("run_id"), stamp.get("seq")))
            try:
                if item is None:
                    raise ValueError("it belongs to a checkpoint that is not there")
                message = statement(item) + b"\n" + str(item.get("signature")).encode()
                token = Token(base64.b64decode(str(stamp.get("token")), validate=True))
                token.check_message(message)
                if roots:
                    token.check_signature(roots)
            except UNPROVEN as error:
                self.fault(shown, f"the time stamp does not hold: {error or 'its signature is not valid'}")
            else:
                checked = "" if roots else " (its signature was not checked: give the authority's --certificates)"
                self.notes.append(f"{shown}: it existed at {token.at.isoformat()}{checked}")
        self.counts["timestamps"] = len(stamps)


class Chain:
    """A chain of events, checked line by line in one pass. It keeps only what other checks need."""

    def __init__(self, check: Check, bundle: Bundle, file: str, run_id: str, whole: frozenset[str]) -> None:
        self.file, self.run_id = file, run_id
        self.hashes: dict[Any, str] = {}
        self.references: dict[int, list[bytes]] = {}
        self.key_changes: list[tuple[int, dict[str, Any]]] = []
        self.starts: list[tuple[int, dict[str, tuple[int, str]]]] = []
        self.signed: list[tuple[int, dict[str, Any]]] = []  # runs, up to which event
        self.jobs: list[tuple[int, dict[str, Any]]] = []
        self.to_sign: dict[int, int] = {}  # events that are signed at once → the event before which they are signed
        self._passed = 0  # the last event that is signed at once
        self.accepted: list[tuple[int, dict[str, Any], str]] = []  # figures outside their limits, and by whom
        self.poses = Poses()
        self.first: dict[str, Any] | None = None
        self.end: tuple[Any, str] = (0, ROOT)
        for event in check.records(bundle, file, whole):  # both belong to this file
            self._add(check, event)
        check.counts[file] = len(self.hashes)

    def _add(self, check: Check, event: dict[str, Any]) -> None:
        seq, payload, sha256 = event.get("seq"), event.get("payload"), str(event.get("sha256"))
        shown = f"{self.file}, event {seq}"
        before, previous = self.end
        if event.get("run_id") != self.run_id:
            check.fault(shown, f"it belongs to another chain ({event.get('run_id')})")
        if seq != before + 1:
            check.fault(self.file, f"after event {before} comes event {seq}: events are missing or out of order")
        elif event.get("previous_sha256") != previous:
            check.fault(shown, "it does not follow the event before it: previous_sha256 differs")
        named = {name: value for name, value in event.items() if name != "sha256"}
        found = hashlib.sha256(canonical(named)).hexdigest()
        if found != sha256:
            check.fault(shown, f"its content was altered: its SHA-256 is {found}, recorded is {sha256}")
        if not isinstance(seq, int) or not isinstance(payload, dict):
            check.fault(shown, "it is not an event")
            return
        self.end = (seq, sha256)
        self.hashes[seq] = sha256
        self.first = self.first or payload
        kind = payload.get("kind")
        self._await_signature(seq, kind)
        self.poses.add(seq, payload)
        if kind == "key_changed" and self.run_id == SITE:
            self.key_changes.append((seq, payload))
        elif kind == "run_signed":
            self.signed.append((seq, payload))
        elif kind == "service_started":
            self.starts.append((seq, _heads(payload.get("heads"))))
        elif kind == "operator_action" and payload.get("action") == "accept":
            self.accepted.append((seq, payload, str(event.get("actor"))))
        elif kind in ("job_enqueued", "job_finished", "job_failed"):
            self.jobs.append((seq, payload))
        references = [canonical(reference) for reference in references_in(payload)]
        if references:
            self.references[seq] = references

    def _await_signature(self, seq: int, kind: Any) -> None:
        if kind in AFTER_A_SIGNATURE and self._passed:
            self.to_sign.setdefault(self._passed, seq)
        if kind in SIGNED_AT_ONCE:
            self._passed = seq


class Poses:
    """The views of a run: whether the pose of each fits the joints recorded with it."""

    def __init__(self) -> None:
        self._arms: dict[str, str] = {}  # device → model
        self._away: dict[int, str] = {}  # event → what is wrong with its view
        self._newest: dict[tuple[str, str, str], int] = {}  # view → its newest event
        self._not_judged: dict[str, int] = {}  # reason → number of views

    def add(self, seq: int, payload: Mapping[str, Any]) -> None:
        """Look at an event; most say nothing of a pose."""
        if payload.get("kind") == "device_opened":
            self._open(payload)
        elif payload.get("kind") == "viewpoint_captured":
            self._look(seq, payload)

    def _open(self, payload: Mapping[str, Any]) -> None:
        report = payload.get("report")
        identity = report.get("identity") if isinstance(report, dict) else None
        if isinstance(identity, dict) and identity.get("kind") == "robot":
            self._arms[str(payload.get("device"))] = str(identity.get("model"))

    def _look(self, seq: int, payload: Mapping[str, Any]) -> None:
        view = str(payload.get("viewpoint"))
        self._newest[str(payload.get("step")), view, str(payload.get("station"))] = seq
        reason = self._reason(payload.get("joints_rad"))
        if reason:
            self._not_judged[reason] = self._not_judged.get(reason, 0) + 1
            return
        try:
            joints = [float(value) for value in payload["joints_rad"]]
            pose = [[float(value) for value in row] for row in payload["T_base_flange"]]
            gaps = [pose_gap(flange_pose(ARMS[model.lower()], joints), pose) for model in self._arms.values()]
        except (KeyError, TypeError, ValueError, IndexError, OverflowError):
            self._away[seq] = f"joints and pose of {view} cannot be read as six angles and a pose"
            return
        if not any(distance_m <= FITS_M and angle_rad <= FITS_RAD for distance_m, angle_rad in gaps):
            distance_m, angle_rad = min(gaps)
            self._away[seq] = (
                f"the pose of {view} is {1000 * distance_m:.0f} mm and {math.degrees(angle_rad):.1f}° from where its "
                "recorded joints put the flange: the tool at the controller was not the one reckoned with"
            )

    def _reason(self, joints: Any) -> str:
        """Return why a view with these joints is not judged; "" for one that is."""
        if not self._arms:
            return "the record names no arm that was connected before"
        unknown = [model for model in self._arms.values() if model.lower() not in ARMS]
        if unknown:
            return f"this verifier does not judge an arm {unknown[0]!r}"
        count = len(joints) if isinstance(joints, list) else 0
        return "" if count == 6 else f"an arm with six joints has not the {count} that were recorded"

    def findings(self, file: str) -> tuple[list[dict[str, str]], list[str]]:
        """Return contradictions of views that count; and notes on those taken again since, or not judged."""
        newest = set(self._newest.values())
        found = [{"where": f"{file}, event {seq}", "what": what} for seq, what in self._away.items() if seq in newest]
        notes = [
            f"event {seq}: {what}. It was taken again since" for seq, what in self._away.items() if seq not in newest
        ]
        notes += [
            f"pose and joints of {number} view{'s' * (number != 1)} are not compared, because {reason}"
            for reason, number in self._not_judged.items()
        ]
        return found, notes


def flange_pose(lengths: Sequence[float], joints_rad: Sequence[float]) -> list[list[float]]:
    """Return the flange's pose, as four rows, at six joints."""
    a2, a3, d1, d4, d5, d6 = lengths
    pose: list[list[float]] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    links = zip((0.0, a2, a3, 0.0, 0.0, 0.0), (d1, 0.0, 0.0, d4, d5, d6), TWISTS_RAD, joints_rad)  # noqa: B905
    for a, d, alpha, theta in links:
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        link = (
            (ct, -st * ca, st * sa, a * ct),
            (st, ct * ca, -ct * sa, a * st),
            (0.0, sa, ca, d),
            (0.0, 0.0, 0.0, 1.0),
        )
        pose = [[sum((row[k] * link[k][j] for k in range(4)), 0.0) for j in range(4)] for row in pose]
    return pose


def pose_gap(left: Sequence[Sequence[float]], right: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses. Raises ValueError for what is no pose."""
    if len(right) != 4 or any(len(row) != 4 for row in right):
        raise ValueError("it is not a pose")
    turn = [[sum(left[k][i] * right[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
    sine = math.sqrt((turn[2][1] - turn[1][2]) ** 2 + (turn[0][2] - turn[2][0]) ** 2 + (turn[1][0] - turn[0][1]) ** 2)
    distance_m = math.sqrt(sum((left[i][3] - right[i][3]) ** 2 for i in range(3)))
    return distance_m, math.atan2(sine, turn[0][0] + turn[1][1] + turn[2][2] - 1.0)


def _heads(value: Any) -> dict[str, tuple[int, str]]:
    """Return ends of chains as recorded at a start of the service, without malformed ones: the hash shows them."""
    found = value.items() if isinstance(value, dict) else ()
    pairs = {run: end for run, end in found if isinstance(end, list) and len(end) == 2}
    return {run: (end[0], end[1]) for run, end in pairs.items() if isinstance(end[0], int)}


def references_in(value: Any) -> Iterator[dict[str, Any]]:
    """Yield every reference to a file anywhere within a payload."""
    if isinstance(value, dict):
        if value.keys() == REFERENCE:
            yield value
        else:
            for item in value.values():
                yield from references_in(item)
    elif isinstance(value, list):
        for item in value:
            yield from references_in(item)


def statement(item: Mapping[str, Any]) -> bytes:
    """Return the bytes that a checkpoint's signature covers."""
    named = {name: value for name, value in item.items() if name != "signature"}
    return canonical(dict(named, purpose=CHECKPOINT))


def signature_fits(item: Mapping[str, Any], raw: bytes) -> bool:
    """Return whether a checkpoint is signed by this key."""
    try:
        signature = base64.b64decode(str(item.get("signature")), validate=True)
    except ValueError:
        return False
    return ed25519_fits(raw, signature, statement(item))


def ed25519_fits(raw: bytes, signature: bytes, message: bytes) -> bool:
    """Return whether a signature is this key's over this message."""
    try:
        Ed25519PublicKey.from_public_bytes(raw).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


def in_use(item: Mapping[str, Any], key: Mapping[str, Any]) -> bool:
    """Return whether a key was in use when an item was signed. Its last act is to sign the key that replaces it."""
    at, replaced = item["site_seq"], key["replaced_seq"]
    if replaced is None or at < replaced:
        return bool(at >= key["seq"])
    return bool(item.get("run_id") == SITE and item.get("seq") == at == replaced)


# --- RFC 3161 time stamps: as much of DER and CMS as they need ------------------------------------------------------

_DIGESTS = {
    "2.16.840.1.101.3.4.2.1": hashes.SHA256(),
    "2.16.840.1.101.3.4.2.2": hashes.SHA384(),
    "2.16.840.1.101.3.4.2.3": hashes.SHA512(),
}
_CONTENT_TYPE, _MESSAGE_DIGEST, _TST_INFO = (
    "1.2.840.113549.1.9.3",
    "1.2.840.113549.1.9.4",
    "1.2.840.113549.1.9.16.1.4",
)


class DerValue:
    """One DER value: its tag, its content, and its bytes as a whole."""

    def __init__(self, data: bytes, start: int = 0) -> None:
        self.tag = data[start]
        length, at = data[start + 1], start + 2
        if length & 0x80:
            count = length & 0x7F
            length, at = int.from_bytes(data[at : at + count], "big"), at + count
            if not 0 < count <= 4:
                raise ValueError("it is not DER")
        if at + length > len(data):
            raise ValueError("it ends too early")
        self.content = data[at : at + length]
        self.end = at + length
        self.whole = data[start : self.end]

    def children(self) -> list[DerValue]:
        """Return the values within."""
        found: list[DerValue] = []
        at = 0
        while at < len(self.content):
            found.append(DerValue(self.content, at))
            at = found[-1].end
        return found

    def oid(self) -> str:
        """Return an object identifier as text."""
        numbers = [self.content[0] // 40, self.content[0] % 40]
        value = 0
        for byte in self.content[1:]:
            value = value << 7 | byte & 0x7F
            if not byte & 0x80:
                numbers.append(value)
                value = 0
        return ".".join(map(str, numbers))


class Token:
    """A TimeStampResp: what it was given for, when, and by whom. Raises ValueError, IndexError for what is none."""

    def __init__(self, data: bytes) -> None:
        status, content = DerValue(data).children()[:2]
        if status.children()[0].content != b"\x00":
            raise ValueError("the authority did not grant it")
        signed = content.children()[1].children()[0].children()
        encapsulated = signed[2].children()
        if encapsulated[0].oid() != _TST_INFO:
            raise ValueError("it holds no time stamp")
        self._info = encapsulated[1].children()[0].content
        info = DerValue(self._info).children()
        imprint = info[2].children()
        self._imprint = (imprint[0].children()[0].oid(), imprint[1].content)
        text = info[4].content.decode("ascii")
        form = "%Y%m%d%H%M%S.%fZ" if "." in text else "%Y%m%d%H%M%SZ"
        self.at = datetime.datetime.strptime(text, form).replace(tzinfo=datetime.timezone.utc)  # noqa: UP017  # Python 3.9
        self._certificates = [node.whole for part in signed[3:] if part.tag == 0xA0 for node in part.children()]
        self._signers = signed[-1].children()

    def check_message(self, message: bytes) -> None:
        """Raises ValueError when it was given for something else."""
        algorithm, imprint = self._imprint
        if algorithm not in _DIGESTS or _digest(algorithm, message) != imprint:
            raise ValueError("it was given for something other than this checkpoint")

    def check_signature(self, trusted: Sequence[x509.Certificate]) -> None:
        """Raises ValueError, InvalidSignature when no line of certificates leads to one of the trusted."""
        if len(self._signers) != 1:
            raise ValueError("it has not one signature but several or none")
        signer = self._signers[0].children()
        issuer, serial = signer[1].children()
        algorithm, attributes, signature = signer[2].children()[0].oid(), signer[3], signer[5].content
        if attributes.tag != 0xA0 or algorithm not in _DIGESTS:
            raise ValueError("it is signed in a way that this verifier does not know")
        values = {node.children()[0].oid(): node.children()[1].children()[0] for node in attributes.children()}
        if values[_CONTENT_TYPE].oid() != _TST_INFO or values[_MESSAGE_DIGEST].content != _digest(
            algorithm, self._info
        ):
            raise ValueError("its signature is for another content")
        brought = [x509.load_der_x509_certificate(data) for data in self._certificates] + list(trusted)
        wanted = int.from_bytes(serial.content, "big", signed=True)
        leaf = next(
            (c for c in brought if c.serial_number == wanted and c.issuer.public_bytes() == issuer.whole), None
        )
        if leaf is None:
            raise ValueError("the certificate of its signature is missing")
        key, content = leaf.public_key(), b"\x31" + attributes.whole[1:]
        if isinstance(key, rsa.RSAPublicKey):
            key.verify(signature, content, padding.PKCS1v15(), _DIGESTS[algorithm])
        elif isinstance(key, ec.EllipticCurvePublicKey):
            key.verify(signature, content, ec.ECDSA(_DIGESTS[algorithm]))
        else:
            raise ValueError("its key is of a kind that this verifier does not know")  # noqa: TRY004  # as all faults
        usage = leaf.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        if ExtendedKeyUsageOID.TIME_STAMPING not in usage:
            raise ValueError("its certificate is not one for time stamps")
        self._check_line(leaf, brought, trusted)

    def _check_line(
        self, leaf: x509.Certificate, brought: Sequence[x509.Certificate], trusted: Sequence[x509.Certificate]
    ) -> None:
        at = leaf
        for _ in range(8):
            moment = self.at.replace(tzinfo=None)
            begins, ends = at.not_valid_before_utc, at.not_valid_after_utc
            if not begins.replace(tzinfo=None) <= moment <= ends.replace(tzinfo=None):
                raise ValueError(f"the certificate of {at.subject.rfc4514_string()} was not valid at that time")
            if at in trusted:
                return
            at = next((above for above in brought if above != at and _issued(above, at)), at)
        raise ValueError("no line of certificates leads from it to one that was given")


def _issued(above: x509.Certificate, below: x509.Certificate) -> bool:
    try:
        if not above.extensions.get_extension_for_class(x509.BasicConstraints).value.ca:
            return False
        below.verify_directly_issued_by(above)
    except UNPROVEN:
        return False
    return True


def _digest(algorithm: str, message: bytes) -> bytes:
    return hashlib.new(_DIGESTS[algorithm].name, message).digest()


def load_certificates(path: Path | None) -> list[x509.Certificate]:
    """Return the certificates of a PEM file. Raises NotABundleError."""
    if path is None:
        return []
    try:
        return x509.load_pem_x509_certificates(path.read_bytes())
    except (OSError, *UNPROVEN) as error:
        raise NotABundleError(f"{path} cannot be read as certificates: {error}") from error


# --- what people see ------------------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> int:
    """Check a bundle and say what was found. The exit status."""
    parser = argparse.ArgumentParser(description="Tell whether an evidence bundle is whole and unaltered.")
    parser.add_argument("bundle", type=Path, help="the bundle, or the folder into which it was unpacked")
    parser.add_argument("--key", metavar="FINGERPRINT", help="fingerprint of the site's key, as you were told it")
    parser.add_argument(
        "--certificates", metavar="FILE", type=Path, help="PEM certificates of the time-stamp authority"
    )
    parser.add_argument("--json", action="store_true", help="write the result as JSON")
    options = parser.parse_args(arguments)
    check = Check()
    if not sys.flags.isolated:
        check.notes.append(NOT_ISOLATED)
    try:
        check.run(options.bundle, options.key, options.certificates)
    except NotABundleError as error:
        sys.stderr.write(shown(str(error)) + "\n")
        for fault in check.faults:
            sys.stderr.write(shown(f"  {fault['where']}: {fault['what']}") + "\n")
        return 2
    if options.json:
        result = {
            "ok": not check.faults and not check.contradictions,
            "run_id": check.manifest["run_id"],
            "simulated": check.manifest["simulated"],
            "head": check.manifest["head"],
            "signed_by": check.manifest["made_by_key"],
            "keys": list(check.keys),
            "counts": check.counts,
            "faults": check.faults,
            "contradictions": check.contradictions,
            "notes": check.notes,
        }
        sys.stdout.write(json.dumps(result, indent=1) + "\n")
    else:
        sys.stdout.write(report(check))
    return 1 if check.faults or check.contradictions else 0


def report(check: Check) -> str:
    """Return the result as text."""
    counts = check.counts
    simulated = " SIMULATED: no real device took part." if check.manifest["simulated"] else ""
    lines = [
        f"Run {check.manifest['run_id']}.{simulated}",
        f"Read {counts.get('files', 0)} files, {counts.get('events.jsonl', 0)} events of the run, "
        f"{counts.get('site_events.jsonl', 0)} of the site, {counts.get('artefacts', 0)} artefacts, "
        f"{counts.get('checkpoints', 0)} checkpoints, {counts.get('timestamps', 0)} time stamps.",
        f"The run's chain ends with {check.manifest['head'].get('sha256')}.",
        *(f"note: {note}" for note in check.notes),
    ]
    if check.faults:
        lines.append(f"NOT AS IT WAS RECORDED: {len(check.faults)} difference{'s' * (len(check.faults) != 1)}.")
        lines += [f"  {fault['where']}: {fault['what']}" for fault in check.faults]
    else:
        lines.append("WHOLE AND UNALTERED: every file, record, link and signature is as it was recorded.")
    if check.contradictions:
        number = len(check.contradictions)
        lines.append(
            f"BUT {number} VIEW{'S' * (number != 1)} CANNOT BE RIGHT: pose and joints contradict each other."
        )
        lines += [f"  {view['where']}: {view['what']}" for view in check.contradictions]
    return "".join(f"{shown(line)}\n" for line in lines)


def shown(text: str) -> str:
    """Return one line with every character escaped that a terminal would obey: an attacker may choose names."""
    return _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)


if __name__ == "__main__":
    sys.exit(main())
