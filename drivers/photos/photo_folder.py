"""Lists a folder of existing photographs: which files form one exposure, and which are left out and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import UnreadableFileError
from drivers.folder_files import files_below
from drivers.photos.photo_file import ExifRecord, check_jpeg_complete, kind_of_file, read_exif, sha256_of
from service.core.jpeg_damage import damaged_jpegs
from service.core.picture_files import ForeignKindError

JPEG_SUFFIXES = (".jpg", ".jpeg")
RAW_MEDIA_TYPES: Mapping[str, str] = {
    ".arw": "image/x-sony-arw",
    ".cr2": "image/x-canon-cr2",
    ".cr3": "image/x-canon-cr3",
    ".dng": "image/x-adobe-dng",
    ".nef": "image/x-nikon-nef",
    ".orf": "image/x-olympus-orf",
    ".pef": "image/x-pentax-pef",
    ".raf": "image/x-fuji-raf",
    ".rw2": "image/x-panasonic-rw2",
}
# Programs and telephones give JPEG files these names too; what a file holds decides.
_PICTURE_SUFFIXES = (".jpe", ".jfif", ".heic", ".heif", ".png", ".webp", ".tif", ".tiff", ".bmp")
_SYSTEM_FILES = ("thumbs.db", "desktop.ini", "picasa.ini", ".ds_store")
_THUMBNAIL_FOLDERS = ("thumbs", "thumbnails", ".thumbnails", "@eadir", "previews")


@dataclass(frozen=True, slots=True)
class ListedFile:
    """A file with the hash, size and modification time that it had when it was listed."""

    path: Path
    sha256: str
    size_bytes: int
    modified_ns: int


@dataclass(frozen=True, slots=True)
class Photograph:
    """A JPEG, its EXIF data, and the raw files of the same exposure."""

    file: ListedFile
    exif: ExifRecord
    raws: tuple[ListedFile, ...]


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A file that is not imported, and the reason."""

    path: Path
    reason: str


@dataclass(frozen=True, slots=True)
class Photographs:
    """The content of a folder. `damaged` photographs cannot be used: they are errors, and not simply left out."""

    photographs: tuple[Photograph, ...]
    left_out: tuple[LeftOut, ...]
    damaged: tuple[LeftOut, ...]


def list_photographs(folder: Path) -> Photographs:
    """List the photographs in a folder and its subfolders, sorted by path.

    A photograph is a JPEG file as a camera wrote it, whatever its name says. A file of another kind under the name of
    a JPEG is left out, and the reason says what it is. A raw file belongs to the JPEG with the same name, anywhere in
    the folder; if there are several, to the one in the same subfolder. Nothing is written or changed.

    Raises:
        DeviceUnavailableError: the folder does not exist or cannot be read.
    """
    jpegs: list[Path] = []
    raws: list[Path] = []
    left_out: list[LeftOut] = []
    for path in files_below(folder):
        reason = odd(path, folder)
        suffix = path.suffix.lower()
        if reason:
            left_out.append(LeftOut(path, reason))
        elif suffix in JPEG_SUFFIXES or (suffix in _PICTURE_SUFFIXES and kind_of_file(path) == "JPEG"):
            jpegs.append(path)
        elif suffix in RAW_MEDIA_TYPES:
            raws.append(path)
        else:
            left_out.append(LeftOut(path, "not a photograph: only JPEG files, with raw files beside them, are read"))
    of_jpeg, alone = paired(jpegs, raws)
    left_out += [LeftOut(path, "a raw file without the JPEG of the same name; develop it first") for path in alone]
    whole: dict[Path, ExifRecord] = {}
    damaged: list[LeftOut] = []
    for path in jpegs:
        try:
            check_jpeg_complete(path)
            whole[path] = read_exif(path)
        except UnreadableFileError as error:
            (left_out if isinstance(error.__cause__, ForeignKindError) else damaged).append(LeftOut(path, error.what))
    within = damaged_jpegs(tuple(whole))
    damaged += [LeftOut(path, what) for path, what in within.items()]
    photographs = [
        Photograph(listed(path), exif, tuple(map(listed, of_jpeg.get(path, ()))))
        for path, exif in whole.items()
        if path not in within
    ]
    return Photographs(tuple(photographs), tuple(left_out), tuple(damaged))


def odd(path: Path, folder: Path) -> str:
    """Why a file is ignored, judged by its name alone (hidden, thumbnail, system file); "" for an ordinary file."""
    name = path.name.lower()
    parents = [part.lower() for part in path.relative_to(folder).parts[:-1]]
    if name.startswith("._") or "__macosx" in parents:
        return "a metadata file of macOS; it holds no image"
    if name in _SYSTEM_FILES:
        return "a file of the operating system"
    if any(part in _THUMBNAIL_FOLDERS for part in parents):
        return "a thumbnail"
    if name.startswith((".", "~")) or any(part.startswith(".") for part in parents):
        return "hidden"
    return ""


def listed(path: Path) -> ListedFile:
    """Hash a file and record its size and modification time."""
    stat = path.stat()
    return ListedFile(path, sha256_of(path), stat.st_size, stat.st_mtime_ns)


def without_duplicates(
    photographs: Sequence[Photograph], seen: dict[str, Path]
) -> tuple[list[Photograph], list[LeftOut]]:
    """Separate photographs from byte-identical copies; returns those kept and those left out.

    `seen` maps the SHA-256 of each photograph to its first file, and is extended.
    """
    kept: list[Photograph] = []
    left_out: list[LeftOut] = []
    # Of a file and its copies (`DSC1.JPG`, `DSC1 (1).JPG`) the one with the shortest name is the original.
    for photograph in sorted(photographs, key=lambda p: (len(p.file.path.name), p.file.path)):
        first = seen.setdefault(photograph.file.sha256, photograph.file.path)
        if first == photograph.file.path:
            kept.append(photograph)
        else:
            left_out.append(LeftOut(photograph.file.path, f"the same bytes as {first.parent.name}/{first.name}"))
    return sorted(kept, key=lambda p: p.file.path), left_out


def usual_size(photographs: Iterable[Photograph]) -> tuple[int, int] | None:
    """The most frequent width and height; the larger one if two are equally frequent, None without photographs."""
    counts = Counter((photograph.exif.width, photograph.exif.height) for photograph in photographs)
    return max(counts, key=lambda size: (counts[size], size), default=None)


def of_size(photographs: Sequence[Photograph], size: tuple[int, int]) -> tuple[list[Photograph], list[LeftOut]]:
    """Separate photographs of this width and height from the others; returns those kept and those left out."""
    kept = [p for p in photographs if (p.exif.width, p.exif.height) == size]
    left_out = [
        LeftOut(p.file.path, f"{p.exif.width} × {p.exif.height} px, most are {size[0]} × {size[1]}")
        for p in photographs
        if (p.exif.width, p.exif.height) != size
    ]
    return kept, left_out


def paired(jpegs: Sequence[Path], raws: Sequence[Path]) -> tuple[dict[Path, list[Path]], list[Path]]:
    """Match raw files to JPEGs by name; returns the raw files of each JPEG, and those without a JPEG."""
    by_stem: dict[str, list[Path]] = {}
    for jpeg in jpegs:
        by_stem.setdefault(jpeg.stem.lower(), []).append(jpeg)
    of_jpeg: dict[Path, list[Path]] = {}
    alone: list[Path] = []
    for raw in raws:
        named = by_stem.get(raw.stem.lower(), [])
        beside = [jpeg for jpeg in named if jpeg.parent == raw.parent]
        chosen = beside or (named if len(named) == 1 else [])
        if chosen:
            of_jpeg.setdefault(chosen[0], []).append(raw)
        else:
            alone.append(raw)
    return of_jpeg, alone
