"""Structure from motion on analytically rendered views: accuracy, shared features, missing images, errors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.sfm.colmap import extract_sift
from service.compute.sfm.estimate import SfmModel, SfmWorkspace, reconstruct, reconstruct_from
from service.compute.sfm.features import ImageFeatures, pack_matches, unpack_matches
from service.compute.sfm.front_end import FrontEnd, missing_pairs
from service.compute.sfm.options import SfmOptions, choose_pairs, pairs_of
from service.core.errors import ComputeError, DataError
from service.core.geometry import Transform, align_points, apply, inverse, transform
from tests.support.record.counting import lines_of
from tests.support.scenes.textured_scene import camera_of_width, render, ring_of_poses, slabs

OPTIONS = SfmOptions(max_features=1500, neighbours=4)


@pytest.fixture(scope="module")
def camera() -> CameraModel:
    return camera_of_width(480)


@pytest.fixture(scope="module")
def views(camera: CameraModel, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Transform]]:
    folder = tmp_path_factory.mktemp("views")
    scene = slabs()
    out: dict[str, tuple[Path, Transform]] = {}
    for k, T in enumerate(ring_of_poses(8)):
        path = folder / f"blob{k}"  # no suffix, as in a content-addressed store
        path.write_bytes(
            cv2.imencode(".jpg", render(scene, camera, T, k), [cv2.IMWRITE_JPEG_QUALITY, 96])[1].tobytes()
        )
        out[f"station {k % 2 + 1}/view_{k}.jpg"] = (path, T)
    return out


def _rms_m(model: SfmModel, views: dict[str, tuple[Path, Transform]]) -> float:
    truth = np.array([views[name][1][:3, 3] for name in model.T_world_camera])
    found = np.array([T[:3, 3] for T in model.T_world_camera.values()])
    T, scale = align_points(truth, found, with_scale=True)
    for name, pose in model.T_world_camera.items():
        drift = T[:3, :3] @ pose[:3, :3] @ views[name][1][:3, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(drift) - 1) / 2, -1, 1))) < 0.085  # one pixel
    return float(np.sqrt(np.mean(np.sum((truth - apply(T, scale * found)) ** 2, axis=1))))


def _unit_m(model: SfmModel, views: dict[str, tuple[Path, Transform]]) -> float:
    truth = np.array([views[name][1][:3, 3] for name in model.T_world_camera])
    return align_points(truth, np.array([T[:3, 3] for T in model.T_world_camera.values()]), with_scale=True)[1]


def _tracks_reproject(model: SfmModel) -> None:
    """Image and point of every observation belong together, in our pixel convention."""
    poses, tracks = list(model.T_world_camera.values()), model.tracks
    for i, T in enumerate(poses):
        mine = tracks.image == i
        pixels = model.camera.project(apply(inverse(T), tracks.points[tracks.point[mine]]))
        assert np.median(np.linalg.norm(pixels - tracks.pixels[mine], axis=1)) < 0.4


@pytest.mark.slow
def test_both_mappers_share_features_and_find_the_poses(
    camera: CameraModel, views: dict[str, tuple[Path, Transform]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    images = {name: path for name, (path, _) in views.items()}
    prior = {name: T for name, (_, T) in views.items()}
    # an image of something else cannot be registered and must be reported
    stray = tmp_path / "stray.png"
    cv2.imwrite(str(stray), np.random.default_rng(0).integers(0, 255, (camera.height, camera.width), dtype=np.uint8))
    images["stray.png"] = stray
    seen: list[tuple[str, int, int]] = []
    first = reconstruct(
        images,
        SfmWorkspace(tmp_path / "work", camera, OPTIONS, lambda *step: seen.append(step)),
        T_world_camera_prior=prior,
    )
    second = reconstruct(
        images, SfmWorkspace(tmp_path / "work", camera, OPTIONS), "global", T_world_camera_prior=prior
    )
    for model in (first, second):
        assert set(model.T_world_camera) == set(views)
        assert model.missing == ("stray.png",)
        assert model.n_registered == len(views)
        assert model.mean_reprojection_error_px < 0.4
        assert len(model.points_world) > 300
        _tracks_reproject(model)
        spread = np.sqrt(np.trace(model.pose_covariance()[:, :3, :3].sum(axis=0)) / len(views)) * _unit_m(
            model, views
        )
        assert 0.3 < _rms_m(model, views) / spread < 3
        # 0.25 mm is a quarter of a pixel at the scene
        assert _rms_m(model, views) < 2.5e-4
    assert set(first.seconds) == {"extract", "match", "map"}
    assert set(second.seconds) == {"map"}
    assert {stage for stage, _, _ in seen} == {"extract", "match", "map", "adjust"}
    assert all(0 <= done <= total for _, done, total in seen)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.sweep  # as jobs: test_front_end_jobs.py
def test_pieces_in_any_order_make_the_same_model(
    camera: CameraModel, views: dict[str, tuple[Path, Transform]], tmp_path: Path
) -> None:
    """Image by image as they arrive, in two orders, stored as bytes in between: the model's files are identical."""
    prior = {name: T for name, (_, T) in views.items()}
    planned = pairs_of(views, prior, OPTIONS)
    models: list[SfmModel] = []
    for turn, order in enumerate((sorted(views), sorted(views, reverse=True))):
        features: dict[str, Path] = {}
        packed: list[bytes] = []
        with FrontEnd(camera, OPTIONS, processes=1 + turn) as front:
            for name in order:
                features[name] = tmp_path / f"{turn}-{len(features)}.npz"
                features[name].write_bytes(front.extract_features(views[name][0]).to_bytes())
                begun = [pair for pair in planned[: 5 * turn + 8] if name in pair and features.keys() >= set(pair)]
                found = front.match_pairs(features, begun)
                packed.append(pack_matches(found))
            early = [match for data in packed for match in unpack_matches(data)]
            late = missing_pairs(planned, early)
            assert len(late) + len(early) == len(planned)
            matches = front.match_pairs(features, late)
        read = {name: ImageFeatures.from_bytes(file.read_bytes()) for name, file in features.items()}
        models.append(reconstruct_from(read, [*early, *matches], SfmWorkspace(tmp_path / str(turn), camera, OPTIONS)))
    images = {name: path for name, (path, _) in views.items()}
    models.append(reconstruct(images, SfmWorkspace(tmp_path / "one", camera, OPTIONS), T_world_camera_prior=prior))
    for model in models[1:]:
        for file in models[0].folder.iterdir():
            assert (model.folder / file.name).read_bytes() == file.read_bytes(), file.name
        assert np.array_equal(model.tracks.pixels, models[0].tracks.pixels)


@pytest.mark.slow
def test_rough_metric_poses_are_triangulated_and_adjusted(
    camera: CameraModel, views: dict[str, tuple[Path, Transform]], tmp_path: Path
) -> None:
    """From poses off by 2 mm and 0.2°: as accurate as without priors, metric and in their frame.

    A stray is missing.
    """
    rng = np.random.default_rng(3)
    start: dict[str, Transform] = {}
    for name, (_, T) in views.items():
        turn = Rotation.from_rotvec(rng.normal(0, np.radians(0.2), 3)).as_matrix()
        start[name] = transform(turn @ T[:3, :3], T[:3, 3] + rng.normal(0, 2e-3, 3))
    stray = tmp_path / "stray.png"
    cv2.imwrite(str(stray), np.random.default_rng(0).integers(0, 255, (camera.height, camera.width), dtype=np.uint8))
    start["stray.png"] = start["station 1/view_0.jpg"]
    images = {name: path for name, (path, _) in views.items()} | {"stray.png": stray}
    seen: list[tuple[str, int, int]] = []
    model = reconstruct(
        images,
        SfmWorkspace(tmp_path / "work", camera, OPTIONS, lambda *step: seen.append(step)),
        "triangulated",
        T_world_camera_prior=start,
    )
    assert model.missing == ("stray.png",)
    assert _rms_m(model, views) < 2.5e-4
    assert abs(_unit_m(model, views) - 1) < 0.01  # the poses' own noise
    found = np.array([T[:3, 3] for T in model.T_world_camera.values()])
    assert np.abs(found - [start[name][:3, 3] for name in model.T_world_camera]).max() < 8e-3
    _tracks_reproject(model)
    adjusted = [(done, total) for stage, done, total in seen if stage == "adjust"]
    assert adjusted == sorted(adjusted)
    assert adjusted[-1][0] == adjusted[-1][1]
    with pytest.raises(ComputeError, match="initial poses"):
        reconstruct(images, SfmWorkspace(tmp_path / "work", camera, OPTIONS), "triangulated")


def test_of_too_many_features_most_are_small_and_some_are_large() -> None:
    noise = np.random.default_rng(1).normal(size=(480, 640))
    picture = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.5, 4.0, 10.0))
    grey = np.clip(128 + 60 * picture, 0, 255).astype(np.uint8)
    every = extract_sift(grey, 100_000, 0)
    few = extract_sift(grey, 300, 0)
    assert len(few.points) == 300
    ordered = np.sort(every.scales_px)[::-1]
    found = np.sort(few.scales_px)[::-1]
    # The largest 37 of all, for images from other distances; the others are far below the 300 largest.
    np.testing.assert_allclose(found[:37], ordered[:37], rtol=1e-6)
    assert np.median(found[37:]) < ordered[300]
    rows = [np.flatnonzero((every.points == point).all(axis=1)) for point in few.points[:20]]
    for row, descriptor in zip(rows, few.descriptors[:20], strict=True):
        assert any((every.descriptors[k] == descriptor).all() for k in row)


def test_damaged_pieces_are_refused() -> None:
    with pytest.raises(DataError, match="features"):
        ImageFeatures.from_bytes(b"no archive")
    with pytest.raises(DataError, match="matches"):
        unpack_matches(b"no archive")
    claims_encryption = bytearray(pack_matches([]))
    claims_encryption[6] |= 1
    claims_encryption[claims_encryption.index(b"PK\1\2") + 8] |= 1
    with pytest.raises(DataError, match="matches"):
        unpack_matches(bytes(claims_encryption))


@pytest.mark.slow
def test_wrong_size_or_broken_image_is_named(
    camera: CameraModel, views: dict[str, tuple[Path, Transform]], tmp_path: Path
) -> None:
    images = {name: path for name, (path, _) in list(views.items())[:4]}
    broken = tmp_path / "cut.jpg"
    broken.write_bytes(next(iter(images.values())).read_bytes()[:300])
    with pytest.raises(DataError, match=r"cut\.jpg"):
        reconstruct({**images, "cut.jpg": broken}, SfmWorkspace(tmp_path / "a", camera, OPTIONS))
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((100, 150), dtype=np.uint8))
    with pytest.raises(DataError, match=r"small\.png"):
        reconstruct({**images, "small.png": small}, SfmWorkspace(tmp_path / "b", camera, OPTIONS))


@pytest.mark.slow
def test_unrelated_images_give_no_model(camera: CameraModel, tmp_path: Path) -> None:
    paths: list[Path] = []
    for k in range(3):
        paths.append(tmp_path / f"noise{k}.png")
        noise = np.random.default_rng(k).integers(0, 255, (camera.height, camera.width), dtype=np.uint8)
        cv2.imwrite(str(paths[-1]), cv2.GaussianBlur(noise, (0, 0), 3))
    with pytest.raises(ComputeError, match="registered 0 of 3"):
        reconstruct(paths, SfmWorkspace(tmp_path / "work", camera, OPTIONS))


def test_missing_file_and_too_few_images(camera: CameraModel, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not exist"):
        reconstruct([tmp_path / "nothing.jpg"], SfmWorkspace(tmp_path / "work", camera))
    with pytest.raises(ComputeError, match="at least 3"):
        reconstruct([], SfmWorkspace(tmp_path / "work", camera))


def test_pairs_are_neighbours_and_connected() -> None:
    poses = ring_of_poses(24)
    names = [f"v{k:02d}" for k in range(24)]
    prior = dict(zip(names, poses, strict=True))
    pairs = choose_pairs(names, prior, 6, 60.0)
    assert 24 * 6 / 2 <= len(pairs) < 24 * 6
    reach = {0}
    for _ in range(24):
        reach |= {j for i, j in pairs if i in reach} | {i for i, j in pairs if j in reach}
    assert reach == set(range(24))
    # an image without a pose is matched with all others; without any prior all pairs are matched
    del prior["v07"]
    assert sum(7 in pair for pair in choose_pairs(names, prior, 6, 60.0)) == 23
    assert len(choose_pairs(names, None, 8, 60.0)) == 24 * 23 / 2


def test_twice_as_many_images_are_twice_the_work() -> None:
    """For two thousand images the selection once took minutes, and memory for every pair."""

    def work(count: int) -> int:
        names = [f"v{k:03d}" for k in range(count)]
        prior = dict(zip(names, ring_of_poses(count), strict=True))
        return lines_of(lambda: choose_pairs(names, prior, 6, 60.0), "/service/")

    assert work(120) < 2.3 * work(60)


def test_across_stations_every_pair_is_kept() -> None:
    """Poses in two base frames say nothing about pairs between them."""
    poses = ring_of_poses(12)
    names = [f"v{k:02d}" for k in range(12)]
    prior = {name: poses[k % 6] for k, name in enumerate(names)}
    stations = {name: "one" if k < 6 else "two" for k, name in enumerate(names)}
    pairs = choose_pairs(names, prior, 2, 60.0, stations=stations)
    assert sum((i < 6) != (j < 6) for i, j in pairs) == 36
    assert sum((i < 6) == (j < 6) for i, j in pairs) < 30


def test_two_far_stations_are_bridged() -> None:
    """Two tight groups of views, further apart than the angle limit, still get pairs that connect them."""
    poses = ring_of_poses(24, tilt_deg=45)
    names = [f"v{k:02d}" for k in range(24)]
    prior = {names[k]: poses[k] for k in (1, 3, 5, 13, 15, 17)}
    pairs = choose_pairs(sorted(prior), prior, 2, 30.0)
    assert any(i < 3 <= j for i, j in pairs)
