"""Identifies markers over the whole image set: assignments of single images, verified with all camera poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.registration.hypotheses import (
    ROBOT_GATE,
    Hypothesis,
    Sightings,
    image_hypotheses,
    match,
    rivals,
    sightings,
)
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, inverse, rotation_angle_rad, transform
from service.core.units import MISTAKEN_LENGTHS, mistaken_length, mm

_HYPOTHESES_PER_IMAGE = 6
_MOST_TRIED = 80
_LEAST_AGREEING = 3  # images from which a scale is believed
_LEAST_SCALE = 0.01  # relative: a station's images agree in spite of smaller ones


@dataclass(frozen=True, slots=True)
class Assignment:
    """The assignment of one image: outline index → marker index, and the pose that it implies (None: unknown)."""

    markers: dict[int, int] = field(default_factory=dict)
    T_camera_scan: Transform | None = None
    scale: float | None = None  # of the camera positions, if it was estimated


@dataclass(frozen=True, slots=True)
class _Reading:
    """One solution for a group of images."""

    T_world_scan: Transform
    scale: float
    markers: tuple[dict[int, int], ...]
    total: int
    cost: float  # mean angle in marker radii


@dataclass(frozen=True, slots=True)
class _Station:
    """The images of one station, which share a base frame, and what each shows on its own."""

    readings: Sequence[list[Hypothesis]]
    seen: Sequence[Sightings]
    poses: Array  # (N, 4, 4)
    centres: Array  # (M, 3)
    radius_m: float
    metric: bool
    where: str  # its name, for messages
    counts: str  # number of outlines of its images, for messages


def identify(
    outlines: Sequence[Sequence[SphereOutline]],
    images: PosedImages,
    spheres: ScanSpheres,
) -> tuple[Assignment, ...]:
    """Assign the registration spheres to outlines, station by station, so that all poses of a station agree.

    Args:
        outlines: the outlines of each image; those of other spheres stay unassigned.
        images: the images with their poses. If these are not metric, their scale is estimated too.
        spheres: the registration spheres.

    Raises:
        ComputeError: too few spheres are visible, more than one assignment fits, or none fits all poses.
    """
    names, poses, stations = images.labels, images.poses, images.stations
    centres = np.asarray(spheres.centres_m, dtype=np.float64)
    seen = [sightings(o, spheres.radius_m, images.camera) for o in outlines]
    readings = [image_hypotheses(o, centres, spheres.radius_m, images.camera) for o in outlines]
    _require_any(readings, outlines, names, spheres, images.camera)
    out: list[Assignment] = [Assignment()] * len(outlines)
    for g in sorted(set(stations.tolist())):
        members = np.nonzero(stations == g)[0]
        station = _Station(
            [readings[i] for i in members],
            [seen[i] for i in members],
            poses[members],
            centres,
            spheres.radius_m,
            images.metric,
            f"station {g}" if len(set(stations.tolist())) > 1 else "",
            ", ".join(f"{names[i]}: {len(outlines[i])}" for i in members[:12]),
        )
        reading = _solve_station(station)
        for k, i in enumerate(members):
            T = np.array(poses[i], dtype=np.float64)
            T[:3, 3] *= reading.scale
            out[i] = Assignment(reading.markers[k], inverse(T) @ reading.T_world_scan, reading.scale)
    return tuple(out)


def identify_each(
    outlines: Sequence[Sequence[SphereOutline]], camera: CameraModel, spheres: ScanSpheres
) -> tuple[Assignment, ...]:
    """Assign the registration spheres to the outlines of each image on its own, without poses.

    Among several images, an ambiguous one stays unassigned.

    Raises:
        ComputeError: no image shows four spheres, or all that do are ambiguous.
    """
    labels = [f"image {i}" for i in range(len(outlines))]
    centres = np.asarray(spheres.centres_m, dtype=np.float64)
    readings = [image_hypotheses(o, centres, spheres.radius_m, camera) for o in outlines]
    _require_any(readings, outlines, labels, spheres, camera)
    unclear = [k for k, r in enumerate(readings) if rivals(r)]
    if unclear and len(unclear) == sum(bool(r) for r in readings):
        k = unclear[0]
        raise ComputeError(
            f"the arrangement of spheres is ambiguous: {_named(readings[k][0].markers)} and "
            + " and ".join(_named(r.markers) for r in rivals(readings[k])[:3])
            + " explain the outlines equally well",
            where=labels[k],
            remedy="Show more of the spheres in one image, or place them less symmetrically",
        )
    return tuple(
        Assignment(dict(r[0].markers), r[0].T_camera_scan) if r and k not in unclear else Assignment()
        for k, r in enumerate(readings)
    )


def _require_any(
    readings: Sequence[list[Hypothesis]],
    outlines: Sequence[Sequence[SphereOutline]],
    names: Sequence[str],
    spheres: ScanSpheres,
    camera: CameraModel,
) -> None:
    if any(readings):
        return
    counts = ", ".join(f"{n}: {len(o)}" for n, o in list(zip(names, outlines, strict=True))[:24])
    most = max((len(o) for o in outlines), default=0)
    if most < 4:
        raise ComputeError(
            f"too few spheres are visible: one image must show four, at most {most} were found ({counts})",
            remedy="Look at the images: in blurred or dark ones no sphere is found. If they are sharp and bright, "
            "capture images that show more of the registration spheres, or check the detector's options",
        )
    centres_m = np.asarray(spheres.centres_m, dtype=np.float64)
    other = _words_of_other_scale(outlines, names, centres_m, spheres.radius_m, camera)
    raise ComputeError(
        f"no image shows four of the {len(centres_m)} spheres in the arrangement of the sphere list (spheres found: "
        f"{counts}){other}",
        remedy="Check the sphere list, its unit, the radius and the camera calibration",
    )


def _named(markers: dict[int, int]) -> str:
    """Describe an assignment: outline = sphere, counted from 0."""
    return "{" + ", ".join(f"{d}={m}" for d, m in sorted(markers.items())) + "}"


def _solve_station(station: _Station) -> _Reading:
    """Return the assignment on which the images of a station agree."""
    readings, n_images = station.readings, len(station.poses)
    if not any(readings):
        raise ComputeError(
            f"too few spheres are visible in the images of this station to tell which is which ({station.counts})",
            where=station.where,
            remedy="Capture at least one image with four or more registration spheres from this station",
        )
    n_hypotheses = sum(bool(r) for r in readings)
    if not station.metric and n_hypotheses < 2:
        raise _scale_unknown(station)
    try:
        best = _clear_best(_solutions(station), station.where)
    except ComputeError as error:
        raise _in_another_scale(station, error) from error
    if not station.metric and n_images > 1 and sum(len(m) > 0 for m in best.markers) < 2:
        raise _scale_unknown(station)
    agreeing = _agreeing(best, readings)
    if n_hypotheses >= 3 and agreeing < 0.34 * n_hypotheses:
        contradicted = ComputeError(
            f"the poses contradict the images: {agreeing} of {n_hypotheses} images agree with one registration",
            where=station.where,
            remedy="Check that the poses belong to these images, their convention and their unit",
        )
        raise _in_another_scale(station, contradicted)
    return best


def _in_another_scale(station: _Station, error: ComputeError) -> ComputeError:
    """Return the error, or what is wrong with the scale if the poses fit the spheres in another one."""
    if not station.metric:
        return error
    solved = _solutions(replace(station, metric=False))
    agreeing = _agreeing(solved[0], station.readings) if solved else 0
    if agreeing < max(_LEAST_AGREEING, 0.5 * sum(bool(r) for r in station.readings)):
        return error
    scale = solved[0].scale
    if abs(np.log(scale)) < _LEAST_SCALE:
        return error
    return ComputeError(
        f"the camera positions and the spheres are in different units or scales: with the positions multiplied by "
        f"{scale:.4g}{words_of_unit(scale)}, {agreeing} images agree",
        where=station.where,
        remedy="Correct the unit of the positions, or that of the spheres and their radius; with --estimate-scale, "
        "only the scale of the spheres counts",
    )


def _solutions(station: _Station) -> list[_Reading]:
    """Return every distinct solution to which the single images lead, the best first."""
    solved: list[_Reading] = []
    tried: set[frozenset[tuple[int, int, int]]] = set()
    starts = _metric_starts if station.metric else _similarity_starts
    for T, s in starts(station.readings, station.poses):
        first = _read(T, s, station)
        key = frozenset((k, d, m) for k, r in enumerate(first.markers) for d, m in r.items())
        if first.total < 4 or key in tried:
            continue
        tried.add(key)
        solved.append(_polish(first, station))
    return sorted(solved, key=lambda r: (-r.total, r.cost))


def _clear_best(solved: list[_Reading], where: str) -> _Reading:
    if not solved:
        raise ComputeError(
            "no assignment of the spheres agrees with the camera poses",
            where=where,
            remedy="Check that the poses are T_world_camera in the stated unit (--estimate-scale for poses without a "
            "metric scale) and belong to these images",
        )
    best = solved[0]
    for other in solved[1:]:
        if _differ(best, other) and other.total >= 0.9 * best.total and other.cost < 3 * best.cost + 0.02:
            raise ComputeError(
                f"the arrangement of spheres is ambiguous: two assignments explain {best.total} and {other.total} "
                f"of the detections, in one image {' and '.join(map(_named, _first_difference(best, other)))}",
                where=where,
                remedy="Place the spheres less symmetrically, or show more of them in an image",
            )
    return best


def _scale_unknown(station: _Station) -> ComputeError:
    return ComputeError(
        "the scale of the poses cannot be determined from one image",
        where=station.where,
        remedy=f"At least two images must show four or more registration spheres (spheres found: {station.counts})",
    )


def _agreeing(best: _Reading, readings: Sequence[list[Hypothesis]]) -> int:
    """Return the number of images whose own hypotheses include the assignment."""
    return sum(
        any(len(set(h.markers.items()) & set(m.items())) >= min(4, h.count) for h in r)
        for m, r in zip(best.markers, readings, strict=True)
    )


def _differ(a: _Reading, b: _Reading) -> bool:
    for ma, mb in zip(a.markers, b.markers, strict=True):
        if any(d in mb and mb[d] != m for d, m in ma.items()):
            return True
    return False


def _first_difference(a: _Reading, b: _Reading) -> tuple[dict[int, int], dict[int, int]]:
    """Return the markers of the first image in which two solutions differ."""
    return next(
        (x, y) for x, y in zip(a.markers, b.markers, strict=True) if any(d in y and y[d] != m for d, m in x.items())
    )


def _metric_starts(readings: Sequence[list[Hypothesis]], poses: Array) -> list[tuple[Transform, float]]:
    ranked = sorted(
        ((h.score, -h.rms_px, k, n) for k, r in enumerate(readings) for n, h in enumerate(r[:_HYPOTHESES_PER_IMAGE])),
        reverse=True,
    )
    return [(poses[k] @ readings[k][n].T_camera_scan, 1.0) for _, _, k, n in ranked[:_MOST_TRIED]]


def _similarity_starts(readings: Sequence[list[Hypothesis]], poses: Array) -> list[tuple[Transform, float]]:
    """Compute similarities to start from pairs of images: rotations must agree, their distance gives the scale."""
    ranked = sorted(
        ((h.score, -h.rms_px, k, n) for k, r in enumerate(readings) for n, h in enumerate(r[:_HYPOTHESES_PER_IMAGE])),
        reverse=True,
    )[:60]
    spread = float(np.max(np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0), axis=1)))
    starts: list[tuple[float, Transform, float]] = []
    for x, (_, _, i, a) in enumerate(ranked):
        for _, _, j, b in ranked[x + 1 :]:
            if i == j:
                continue
            Ti, Tj = readings[i][a].T_camera_scan, readings[j][b].T_camera_scan
            Ri, Rj = poses[i][:3, :3] @ Ti[:3, :3], poses[j][:3, :3] @ Tj[:3, :3]
            if rotation_angle_rad(transform(Ri.T @ Rj, np.zeros(3))) > 0.06:
                continue
            given = poses[j][:3, 3] - poses[i][:3, 3]
            length = float(np.linalg.norm(given))
            if length < 0.05 * spread:
                continue
            true = Ri @ (inverse(Tj)[:3, 3] - inverse(Ti)[:3, 3])
            s = float(np.linalg.norm(true)) / length
            cosine = float(true @ given) / max(float(np.linalg.norm(true)) * length, 1e-12)
            if cosine < 0.99:
                continue
            T = np.array(poses[i], dtype=np.float64)
            T[:3, 3] *= s
            starts.append((length, T @ Ti, s))
    starts.sort(key=lambda e: -e[0])
    return [(T, s) for _, T, s in starts[:_MOST_TRIED]]


def _camera_centres(T_world_scan: Transform, s: float, pose: Transform, centres: Array) -> Array:
    return (apply(T_world_scan, centres) - s * pose[:3, 3]) @ pose[:3, :3]


def _read(T_world_scan: Transform, s: float, station: _Station) -> _Reading:
    """Return the outlines that lie where a solution predicts spheres."""
    markers: list[dict[int, int]] = []
    cost, total = 0.0, 0
    for sight, pose in zip(station.seen, station.poses, strict=True):
        c = _camera_centres(T_world_scan, s, pose, station.centres)
        pairs = match(sight, c, station.radius_m, ROBOT_GATE)
        markers.append({d: m for d, m, _ in pairs})
        cost += sum(angle / sight.cones.half_angles[d] for d, _, angle in pairs)
        total += len(pairs)
    return _Reading(T_world_scan, s, tuple(markers), total, cost / max(total, 1))


def _polish(reading: _Reading, station: _Station) -> _Reading:
    """Solve least squares on the directions of all matched spheres, alternating with matching until nothing changes.

    The residuals are those of `ObservedCones` in radii. They are written out here to keep their rounding: the noise
    estimated from nearly exact outlines depends on the last digits, and a replay must reproduce recorded results.
    """
    seen, poses, radius_m, metric = station.seen, station.poses, station.radius_m, station.metric
    for _ in range(4):
        index = [(k, d, m) for k, r in enumerate(reading.markers) for d, m in r.items()]
        image = np.array([k for k, _, _ in index])
        axes = np.array([seen[k].cones.axes[d] for k, d, _ in index])
        half = np.array([seen[k].cones.half_angles[d] for k, d, _ in index])
        model = station.centres[[m for _, _, m in index]]
        R, origin = poses[image, :3, :3], poses[image, :3, 3]
        T0, s0 = reading.T_world_scan, reading.scale

        def unpack(x: Array, T0: Transform = T0, s0: float = s0) -> tuple[Transform, float]:
            T = transform(Rotation.from_rotvec(x[3:6]).as_matrix() @ T0[:3, :3], T0[:3, 3] + x[:3])
            return T, s0 if metric else s0 * float(np.exp(x[6]))

        def fun(
            x: Array,
            R: Array = R,
            origin: Array = origin,
            model: Array = model,
            axes: Array = axes,
            half: Array = half,
        ) -> Array:
            T, s = unpack(x)
            c = np.einsum("nji,nj->ni", R, apply(T, model) - s * origin)
            distance = np.linalg.norm(c, axis=1)
            size = (np.arcsin(np.minimum(radius_m / distance, 0.9)) / half - 1)[:, None]
            return np.hstack([(c / distance[:, None] - axes) / half[:, None], size]).ravel()

        # From a tenth of a radius on, a match is doubtful.
        fit = least_squares(fun, np.zeros(6 if metric else 7), loss="soft_l1", f_scale=0.1, x_scale="jac")
        T, s = unpack(np.asarray(fit.x))
        new = _read(T, s, station)
        same = new.markers == reading.markers
        if new.total < 4:
            return reading
        reading = new
        if same:
            break
    return reading


# A search in one scale finds a list that is off by up to 2 %.
_STEP, _STEPS = 1.03, 12
_OTHER_MISTAKES = {"a diameter taken as the radius": 2.0, "half the diameter taken as the diameter": 0.5}
_COMPARED = 3  # images
_LEAST = 5  # spheres that one image must show: four agree by chance in one of so many scales
_NEAR = 0.03  # relative, to one of the mistakes


def _words_of_other_scale(
    outlines: Sequence[Sequence[SphereOutline]],
    names: Sequence[str],
    centres_m: Array,
    radius_m: float,
    camera: CameraModel,
) -> str:
    """Describe the other scale in which an image shows the list; an empty text if there is none.

    An image alone cannot distinguish a list in another scale from another radius of the spheres.
    """
    best: tuple[int, float, int] = (0, 1.0, 0)
    factors = (
        *(_STEP**k for k in range(-_STEPS, _STEPS + 1) if k),
        *MISTAKEN_LENGTHS.values(),
        *_OTHER_MISTAKES.values(),
    )
    for i in sorted(range(len(outlines)), key=lambda i: -len(outlines[i]))[:_COMPARED]:
        seen_m = sightings(outlines[i], radius_m, camera).positions_m
        for factor in factors:
            if len(outlines[i]) <= max(best[0], _LEAST - 1):
                break  # no scale shows more spheres than there are outlines, and a search costs a second
            for reading in image_hypotheses(outlines[i], factor * centres_m, radius_m, camera)[:1]:
                if reading.count > max(best[0], _LEAST - 1):
                    shown, listed = (np.array(side) for side in zip(*reading.markers.items(), strict=True))
                    best = reading.count, align_points(seen_m[shown], centres_m[listed], with_scale=True)[1], i
    count, scale, image = best
    if not count:
        return ""
    return (
        f"; with the list multiplied by about {scale:.3g}{words_of_unit(scale)}, {names[image]} shows {count} of "
        f"them: the list is in another unit or scale, or the radius is about {mm(radius_m) / scale:.3g} mm"
    )


def words_of_unit(scale: float) -> str:
    """Return the mistake by which lengths have to be multiplied by `scale`, as text within brackets, or nothing."""
    others = (words for words, factor in _OTHER_MISTAKES.items() if abs(scale / factor - 1) < _NEAR)
    words = mistaken_length(scale, _NEAR) or next(others, "")
    return f" ({words})" if words else ""
