"""Computes features and verified matches image by image, and stores them; later calls compute what is missing."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Self, TypeVar

from service.compute.camera_model import CameraModel
from service.compute.sfm.colmap_process import ColmapProcess
from service.compute.sfm.features import ImageFeatures, PairMatches, pack_matches, unpack_matches
from service.compute.sfm.options import Progress, SfmOptions
from service.core.errors import DataError

Item = TypeVar("Item")
Answer = TypeVar("Answer")


class FrontEnd:
    """Extracts and matches in child processes that live from one image to the next; close it, or use `with`.

    The results depend only on the images, the camera and the options: bit for bit the same, whatever the order of the
    images and the number of processes. As images arrive:

        with FrontEnd(camera, options) as front:
            features[name] = front.extract_features(file)
            begun = [pair for pair in planned if name in pair and features.keys() >= set(pair)]
            matches += front.match_pairs(features, begun)

    with `planned = pairs_of(…)` of the planned poses. At the end, the pairs of the images that did arrive are used:
    already matched ones are used again, `missing_pairs` of them are matched, and `reconstruct_from` maps.
    """

    def __init__(
        self,
        camera: CameraModel,
        options: SfmOptions | None = None,
        *,
        processes: int = 1,
        log: Path | None = None,
        child: ColmapProcess | None = None,
    ) -> None:
        """Prepare the front end; processes are started with the first work.

        Args:
            camera: the camera, calibrated at the images' size.
            options: settings.
            processes: number of children working in parallel, each on one core.
            log: file for COLMAP's output; None: a temporary one. Further processes write beside it.
            child: a process to use instead of own children, and leave running.
        """
        self._camera = camera
        self._options = options or SfmOptions()
        self._lent = child is not None
        self._children = (
            [child]
            if child is not None
            else [
                ColmapProcess(
                    seed=self._options.seed,
                    log=log if log is None or k == 0 else log.with_suffix(f".{k}{log.suffix}"),
                )
                for k in range(max(1, processes))
            ]
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the child processes, except a borrowed one."""
        for child in [] if self._lent else self._children:
            child.close()

    def extract_features(self, file: Path) -> ImageFeatures:
        """Extract the features of one image.

        Raises:
            DataError: the image is missing, unreadable or of another size than the camera.
            ComputeError: COLMAP failed.
        """
        return self._extracted(self._children[0], file)

    def extract_all(self, files: Mapping[str, Path], progress: Progress | None = None) -> dict[str, ImageFeatures]:
        """Extract features of images by name, in parallel; `progress` is called with ("extract", done, total).

        Raises:
            DataError, ComputeError: as `extract_features`; the message names the image.
        """

        def work(child: ColmapProcess, name: str) -> ImageFeatures:
            try:
                return self._extracted(child, files[name])
            except DataError as error:
                raise DataError(f"image {name}: {error.what}", where=error.where, remedy=error.remedy) from error

        names = sorted(files)
        return dict(zip(names, self._spread(work, names, "extract", progress), strict=True))

    def match_pairs(
        self,
        features: Mapping[str, ImageFeatures],
        pairs: Iterable[tuple[str, str]],
        progress: Progress | None = None,
    ) -> list[PairMatches]:
        """Match each pair of names and verify it, sorted by pair; `progress` is called with ("match", done, total).

        A pair is matched in the order of its names, so (a, b) and (b, a) give the same result.

        Raises:
            ComputeError: COLMAP failed.
        """
        ordered = sorted({(min(pair), max(pair)) for pair in pairs})

        def work(child: ColmapProcess, pair: tuple[str, str]) -> PairMatches:
            a, b = (features[name] for name in pair)
            job = self._job() | {
                "pixels": (a.pixels, b.pixels),
                "descriptors": (a.descriptors, b.descriptors),
            }
            found = child.run("match", job, timeout_s=self._options.timeout_s)
            return PairMatches(*pair, found["features"], found["configuration"], found["matrices"])

        return self._spread(work, ordered, "match", progress)

    def _job(self) -> dict[str, Any]:
        return {"camera": dataclasses.asdict(self._camera), "options": dataclasses.asdict(self._options)}

    def _extracted(self, child: ColmapProcess, file: Path) -> ImageFeatures:
        job = self._job() | {"file": str(file)}
        return ImageFeatures(**child.run("extract", job, timeout_s=self._options.timeout_s))

    def _spread(
        self,
        work: Callable[[ColmapProcess, Item], Answer],
        items: Sequence[Item],
        stage: str,
        progress: Progress | None,
    ) -> list[Answer]:
        """Return the answers in the order of the items, computed by the children in parallel."""
        free: SimpleQueue[ColmapProcess] = SimpleQueue()
        for child in self._children:
            free.put(child)

        def one(item: Item) -> Answer:
            child = free.get()
            try:
                return work(child, item)
            finally:
                free.put(child)

        out: list[Answer] = []
        if progress is not None:
            progress(stage, 0, len(items))
        with ThreadPoolExecutor(len(self._children)) as pool:
            tasks = [pool.submit(one, item) for item in items]
            try:
                for task in tasks:
                    out.append(task.result())
                    if progress is not None:
                        progress(stage, len(out), len(items))
            finally:
                pool.shutdown(cancel_futures=True)
        return out


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
        folder = self.workspace / "features"
        folder.mkdir(exist_ok=True)
        kept = {name: folder / f"{_key(file, self.camera, self.settings)}.npz" for name, file in files.items()}
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

    def matches(
        self,
        features: Mapping[str, ImageFeatures],
        pairs: Sequence[tuple[str, str]],
        front: FrontEnd,
        progress: Progress | None,
    ) -> list[PairMatches]:
        """Return the matches of exactly these pairs; those in the workspace are used if the features are the same."""
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
            known += front.match_pairs(features, missing, progress)
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
