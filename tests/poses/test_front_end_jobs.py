"""Features and matches as jobs: the model is bitwise the same, whether images come one by one or all at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import pytest

from service.audit.recorded_run import RecordedFiles
from service.audit.replay import ScratchStore
from service.computations.job import JobContext, RecordedContext
from service.compute.sfm.options import SfmOptions, pairs_of
from service.core.records.base import ArtefactRef
from service.worker.loop import HANDLERS
from tests.support.scenes.textured_scene import camera_of_width, render, ring_of_poses, slabs

WIDTH_PX = 360
EFFORT: dict[str, Any] = {"max_image_size": WIDTH_PX, "max_features": 800, "neighbours": 3}


class Jobs:
    """Runs handlers on images of the textured scene."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.camera = folder, camera_of_width(WIDTH_PX)
        self.store = ScratchStore(RecordedFiles(folder), folder / "made")
        self.scene = slabs()
        self.poses = {f"v{i}": T for i, T in enumerate(ring_of_poses(5))}
        self.images = [self._image(name, T) for name, T in self.poses.items()]
        self.common: dict[str, Any] = {"camera": self.camera.record(), "effort": EFFORT}

    def _image(self, name: str, T: Any) -> dict[str, Any]:
        data = cv2.imencode(".png", render(self.scene, self.camera, T, 1))[1].tobytes()
        ref = self.store.put_bytes(data, kind="image", media_type="image/png", original_name=f"{name}.png")
        return {"viewpoint": name, "sha256": ref.sha256}

    def run(self, kind: str, **arguments: Any) -> tuple[ArtefactRef, ...]:
        scratch = self.folder / f"scratch{len(list(self.folder.iterdir()))}"
        scratch.mkdir()
        given = {**self.common, **arguments}
        context: RecordedContext = JobContext(given, self.store, scratch, lambda _w, _d, _t: None)
        return tuple(HANDLERS[kind](context).artefacts)


@pytest.mark.slow
def test_pieces_made_as_images_arrive_give_the_same_model_as_pieces_made_afterwards(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path)
    one_by_one = {i["viewpoint"]: jobs.run("features", images=[i])[0].sha256 for i in reversed(jobs.images)}
    together = jobs.run("features", images=jobs.images)
    features = {image["viewpoint"]: ref.sha256 for image, ref in zip(jobs.images, together, strict=True)}
    assert features == one_by_one
    prior = {name: T.tolist() for name, T in jobs.poses.items()}
    pairs = [list(pair) for pair in pairs_of(features, jobs.poses, SfmOptions(**EFFORT))]
    every = [[a, b] for a in features for b in features if a < b]
    extra = [pair for pair in every if pair not in pairs]
    assert len(pairs) > 3, "a part is left when the first three are taken away"
    assert extra

    def matched(some: list[list[str]]) -> str:
        mine = {name: features[name] for pair in some for name in pair}
        return jobs.run("match", features=mine, pairs=some)[0].sha256

    models = [
        jobs.run(
            "structure_from_motion", images=jobs.images, mappers=["triangulated", "incremental"], prior=prior,
            features=features, matches=[matched(some) for some in parts if some],
        )
        for parts in ([pairs], [pairs[3:], pairs[:3], extra])
    ]  # fmt: skip
    assert [ref.sha256 for ref in models[0]] == [ref.sha256 for ref in models[1]]
