"""Computes features and verified matches image by image, and stores them; later calls compute what is missing."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from service.compute.camera_model import CameraModel
from service.compute.sfm.colmap_process import end_thread_process, thread_process
from service.compute.sfm.features import ImageFeatures, PairMatches, pack_matches, unpack_matches
from service.compute.sfm.options import Progress, SfmOptions, reduction
from service.core.errors import DataError
from service.machine.executors import mapping

PAIRS_A_TASK = 8  # about two seconds; neighbours in the list share an image, whose features are read once
_FEWEST_PIXELS, _FEWEST_PAIRS = 16e6, 100  # that are worth further processes; a pair of 3000 features an image


@dataclass(frozen=True, slots=True)
class _Extraction:
    """The task of extracting the features of one image."""

    file: Path
    camera: CameraModel
    options: SfmOptions


@dataclass(frozen=True, slots=True)
class _Matching:
    """The task of matching some pairs, of images by name, whose features are in files."""

    pairs: tuple[tuple[str, str], ...]
    files: Mapping[str, Path]
    camera: CameraModel
    options: SfmOptions


class FrontEnd:
    """Extracts and matches; close it, or use `with`, unless COLMAP's child process is to stay for later work.

    Tasks are computed by the chosen executor (`service.machine.executors`), each in a child process that the thread
    which computes keeps from task to task. The results depend only on the images, the camera and the options: bit for
    bit the same, whatever the order of the images and the number of processes. As images arrive:

        with FrontEnd(camera, options) as front:
            found = front.extract_features(file)  # and its bytes are written to features[name]
            begun = [pair for pair in planned if name in pair and features.keys() >= set(pair)]
            matches += front.match_pairs(features, begun)

    with `planned = pairs_of(…)` of the planned poses. At the end, the pairs of the images that did arrive are used:
    already matched ones are used again, `missing_pairs` of them are matched, and `reconstruct_from` maps.
    """

    def __init__(self, camera: CameraModel, options: SfmOptions | None = None, *, processes: int = 1) -> None:
        """Prepare the front end; processes are started with the first work.

        Args:
            camera: the camera, calibrated at the images' size.
            options: settings.
            processes: number of processes of this machine that work in parallel; 1: this one, unless a cluster was
                chosen.
        """
        self._camera = camera
        self._options = options or SfmOptions()
        self._processes = processes

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End COLMAP's child process of this thread."""
        end_thread_process(self._options.seed)

    def extract_features(self, file: Path) -> ImageFeatures:
        """Extract the features of one image.

        Raises:
            DataError: the image is missing, unreadable or of another size than the camera.
            ComputeError: COLMAP failed.
        """
        return _extract(_Extraction(file, self._camera, self._options))

    def extract_each(self, files: Sequence[Path]) -> Iterator[ImageFeatures]:
        """Extract the features of images in parallel, and yield them in their order.

        Raises:
            DataError, ComputeError: as `extract_features`.
        """
        tasks = [_Extraction(file, self._camera, self._options) for file in files]
        with mapping(self._processes, len(tasks)) as map_over:
            yield from map_over(_extract, tasks)

    def extract_all(self, files: Mapping[str, Path], progress: Progress | None = None) -> dict[str, ImageFeatures]:
        """Extract features of images by name, in parallel; `progress` is called with ("extract", done, total).

        Raises:
            DataError, ComputeError: as `extract_features`; the message names the image.
        """
        names = sorted(files)
        found: dict[str, ImageFeatures] = {}
        if progress is not None:
            progress("extract", 0, len(names))
        try:
            for features in self.extract_each([files[name] for name in names]):
                found[names[len(found)]] = features
                if progress is not None:
                    progress("extract", len(found), len(names))
        except DataError as error:
            name = names[len(found)]
            raise DataError(f"image {name}: {error.what}", where=error.where, remedy=error.remedy) from error
        return found

    def match_pairs(
        self,
        features: Mapping[str, Path],
        pairs: Iterable[tuple[str, str]],
        progress: Progress | None = None,
    ) -> list[PairMatches]:
        """Match each pair of names and verify it, sorted by pair; `progress` is called with ("match", done, total).

        A pair is matched in the order of its names, so (a, b) and (b, a) give the same result.

        Args:
            features: the file of each image's features, as `ImageFeatures.to_bytes` makes it.
            pairs: pairs of these names.
            progress: called after some pairs.

        Raises:
            DataError: a file does not hold features.
            ComputeError: COLMAP failed.
        """
        ordered = sorted({(min(pair), max(pair)) for pair in pairs})
        blocks = [tuple(ordered[k : k + PAIRS_A_TASK]) for k in range(0, len(ordered), PAIRS_A_TASK)]
        tasks = [
            _Matching(block, {name: features[name] for pair in block for name in pair}, self._camera, self._options)
            for block in blocks
        ]
        found: list[PairMatches] = []
        if progress is not None:
            progress("match", 0, len(ordered))
        with mapping(self._processes, len(tasks)) as map_over:
            for matches in map_over(_match, tasks):
                found += matches
                if progress is not None:
                    progress("match", len(found), len(ordered))
        return found


def processes_worth(files: int, pairs: int, camera: CameraModel, options: SfmOptions) -> int:
    """Return the number of processes of this machine for so much work; starting one takes as long as a megapixel."""
    factor = reduction(options.max_image_size, camera.width, camera.height)
    pixels = files * camera.width * camera.height / factor**2
    worth = pixels >= _FEWEST_PIXELS or pairs * (options.max_features / 3000) ** 2 >= _FEWEST_PAIRS
    return options.threads if worth else 1


def _extract(task: _Extraction) -> ImageFeatures:
    job = _job(task) | {"file": str(task.file)}
    child = thread_process(task.options.seed)
    return ImageFeatures(**child.run("extract", job, timeout_s=task.options.timeout_s))


def _match(task: _Matching) -> list[PairMatches]:
    features = {name: ImageFeatures.from_bytes(file.read_bytes()) for name, file in task.files.items()}
    child = thread_process(task.options.seed)
    matches: list[PairMatches] = []
    for pair in task.pairs:
        a, b = (features[name] for name in pair)
        job = _job(task) | {"pixels": (a.pixels, b.pixels), "descriptors": (a.descriptors, b.descriptors)}
        found = child.run("match", job, timeout_s=task.options.timeout_s)
        matches.append(PairMatches(*pair, found["features"], found["configuration"], found["matrices"]))
    return matches


def _job(task: _Extraction | _Matching) -> dict[str, Any]:
    return {"camera": dataclasses.asdict(task.camera), "options": dataclasses.asdict(task.options)}


def missing_pairs(pairs: Iterable[tuple[str, str]], matches: Iterable[PairMatches]) -> list[tuple[str, str]]:
    """Return the pairs that have not been matched yet."""
    done = {m.pair for m in matches}
    return sorted({(min(pair), max(pair)) for pair in pairs} - done)


@dataclass(frozen=True, slots=True)
class CachedFrontEnd:
    """Features and matches of one camera and one set of options.

    Attributes:
        workspace: existing folder in which they are stored.
        camera: the camera, calibrated at the images' size.
        settings: settings with which they are computed.
        seconds: wall time of each stage that is run is written here.
    """

    workspace: Path
    camera: CameraModel
    settings: SfmOptions
    seconds: dict[str, float]

    def features(
        self, files: Mapping[str, Path], front: FrontEnd, progress: Progress | None
    ) -> dict[str, ImageFeatures]:
        """Return features of every image; stored ones are used if file, camera and settings are the same."""
        kept = self.files(files)
        wanted = {name: files[name] for name, path in kept.items() if not path.is_file()}
        start = time.monotonic()
        fresh = front.extract_all(wanted, progress) if wanted else {}
        if wanted:
            self.seconds["extract"] = time.monotonic() - start
        for name, found in fresh.items():
            _write(kept[name], found.to_bytes())
        return {
            name: fresh[name] if name in fresh else ImageFeatures.from_bytes(kept[name].read_bytes())
            for name in sorted(files)
        }

    def files(self, files: Mapping[str, Path]) -> dict[str, Path]:
        """Return the file in which the features of each image are stored, or will be."""
        folder = self.workspace / "features"
        folder.mkdir(exist_ok=True)
        return {name: folder / f"{_key(file, self.camera, self.settings)}.npz" for name, file in files.items()}

    def matches(
        self,
        features: Mapping[str, ImageFeatures],
        files: Mapping[str, Path],
        pairs: Sequence[tuple[str, str]],
        front: FrontEnd,
        progress: Progress | None,
    ) -> list[PairMatches]:
        """Return the matches of exactly these pairs; those in the workspace are used if the features are the same.

        Args:
            features: the features of every image.
            files: the images, whose features `features` has stored.
            pairs: the pairs.
            front: the front end that matches the missing ones.
            progress: called with ("match", done, total).
        """
        kept = self.workspace / "matches.npz"
        stamp = self.workspace / "matches.json"
        recipe = json.dumps(
            [
                dataclasses.asdict(self.camera),
                self.settings.verification_error_px,
                self.settings.seed,
                _hash(features),
            ]
        )
        known: list[PairMatches] = []
        if kept.is_file() and stamp.is_file() and stamp.read_text(encoding="utf-8") == recipe:
            known = unpack_matches(kept.read_bytes())
        missing = missing_pairs(pairs, known)
        if missing:
            start = time.monotonic()
            known += front.match_pairs(self.files(files), missing, progress)
            self.seconds["match"] = time.monotonic() - start
            stamp.unlink(missing_ok=True)
            _write(kept, pack_matches(known))
            stamp.write_text(recipe, encoding="utf-8")
        wanted = set(pairs)
        return [m for m in known if m.pair in wanted]


def _hash(features: Mapping[str, ImageFeatures]) -> str:
    digest = hashlib.sha256()
    for name, found in features.items():
        digest.update(name.encode() + found.pixels.tobytes() + found.descriptors.tobytes())
    return digest.hexdigest()


def _key(file: Path, camera: CameraModel, settings: SfmOptions) -> str:
    stat = file.stat()
    front = ("max_image_size", "max_features", "first_octave")
    words = [str(file.resolve()), stat.st_size, stat.st_mtime_ns, camera.width, camera.height]
    text = json.dumps([*words, *(getattr(settings, key) for key in front)])
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _write(path: Path, data: bytes) -> None:
    part = path.with_suffix(".part")
    part.write_bytes(data)
    part.replace(path)
