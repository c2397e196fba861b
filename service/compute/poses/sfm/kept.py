"""Features and matches kept in a workspace, so that later calls compute only missing ones."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from service.compute.camera_model import CameraModel
from service.compute.poses.sfm.features import ImageFeatures, PairMatches, pack_matches, unpack_matches
from service.compute.poses.sfm.front_end import FrontEnd, missing_pairs
from service.compute.poses.sfm.options import Progress, SfmOptions


@dataclass(frozen=True, slots=True)
class CachedFrontEnd:
    """Features and matches of one camera and one set of options.

    Attributes:
        workspace: existing folder in which they are kept.
        camera: calibrated at the images' size.
        settings: with which they are computed.
        seconds: wall time of each stage that is run is written here.
    """

    workspace: Path
    camera: CameraModel
    settings: SfmOptions
    seconds: dict[str, float]

    def features(
        self, files: Mapping[str, Path], front: FrontEnd, progress: Progress | None
    ) -> dict[str, ImageFeatures]:
        """Features of every image; those in the workspace are used if file, camera and settings are the same."""
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
        """Matches of exactly these pairs; those in the workspace are used if the features are the same."""
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
