"""How much alike the photographs are in patches that lie in a surface, when the surface is moved along its normal.

A patch is turned with the surface, so that all photographs foreshorten it alike; what is steep is compared as well as
what is seen from the front.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.pixels.ray_mesh import RayMesh
from service.compute.stereo.pairs import StereoView
from service.core.geometry import Array, apply, inverse

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

VIEWS = 4  # compared at each place
_HALF = 4  # of a patch's edge, in samples
_LEAST_COSINE = 0.13  # between the normal and the ray
_LEAST_PARALLAX = 0.2  # of two views, in the surface: metres for a metre along the normal
_LEAST_STRETCH = 0.3  # a patch is longer along the steep direction by 1/cosine, up to this
_NOISE = 1.0  # grey values
_FINE, _COARSE = 0.75, 4.5  # pixels: details between these sizes are compared, shading is not
_STEP = 4  # pixels between the rays of the known surface
_SLACK_M = 2e-3  # of the known surface
_AT_ONCE = 1500  # places whose patches are in memory
_LISTED = 10_000  # places that are held against all views at a time
_COLUMNS = 4096  # of the rectangle that lists are folded into for cv2.remap
_ROWS = 30_000

_V, _U = (k.ravel().astype(np.float32) for k in np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1])


@dataclass(frozen=True, slots=True)
class Photograph:
    """A view with what is compared of it, and the depth of the known surface in every _STEP-th pixel.

    Attributes:
        detail: (H, W) grey values without shading.
        farthest: depth of what is known around a pixel; infinite where nothing is.
        nearest: the same; 0 where nothing is.
    """

    view: StereoView
    detail: Floats = field(repr=False)
    farthest: Floats = field(repr=False)
    nearest: Floats = field(repr=False)

    def seen(self, points_m: Array) -> tuple[Array, Array, Ints, NDArray[np.bool_]]:
        """Pixels (..., 2), depth, place in the known depths (..., 2) and whether in the image, of points (..., 3)."""
        camera = apply(inverse(self.view.T_world_camera), points_m.reshape(-1, 3)).reshape(points_m.shape)
        of = self.view.camera
        z = np.maximum(camera[..., 2], 1e-9)
        pixels = camera[..., :2] / z[..., None] * [of.fx, of.fy] + [of.cx, of.cy]
        place = np.floor((pixels + 0.5) / _STEP)
        height, width = self.farthest.shape
        inside = (place >= 0).all(axis=-1) & (place < [width, height]).all(axis=-1) & (camera[..., 2] > 0)
        return pixels, z, np.where(inside[..., None], place, 0).astype(np.int64), inside


def photograph(view: StereoView, known: RayMesh) -> Photograph:
    """A view beside the surface that is known already."""
    grey = view.image.astype(np.float32)
    detail = cv2.GaussianBlur(grey, (0, 0), _FINE) - cv2.GaussianBlur(grey, (0, 0), _COARSE)
    camera = view.camera
    v, u = (k * _STEP + (_STEP - 1) / 2 for k in np.mgrid[: camera.height // _STEP, : camera.width // _STEP])
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    depth = known.depths(view.T_world_camera, rays.reshape(-1, 3)).reshape(u.shape).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(np.nan_to_num(depth, nan=1e9), kernel)
    nearest = cv2.erode(np.nan_to_num(depth, nan=0.0), kernel)
    return Photograph(
        view, np.asarray(detail, np.float32), np.asarray(farthest, np.float32), np.asarray(nearest, np.float32)
    )


def seen_through(photographs: Sequence[Photograph], points_m: Array) -> Ints:
    """(N, ...) how many photographs show a known surface behind each point (N, ..., 3)."""
    out = np.zeros(points_m.shape[:-1], dtype=np.int64)
    for begin in range(0, len(points_m), _LISTED):
        part = slice(begin, begin + _LISTED)
        for one in photographs:
            _, z, place, inside = one.seen(points_m[part])
            nearest = one.nearest[place[..., 1], place[..., 0]]
            out[part] += inside & (nearest > 0) & (z < nearest - _SLACK_M)
    return out


def best_views(photographs: Sequence[Photograph], points_m: Array, normals: Array) -> tuple[Ints, Array]:
    """(N, VIEWS) the views that face each place most, with parallax between them, and their cosines.

    -1 and 0 where there are no more. What lies behind the known surface is not seen. The memory that this takes does
    not grow with the places times the views.
    """
    chosen, found = np.full((len(points_m), VIEWS), -1, dtype=np.int64), np.zeros((len(points_m), VIEWS))
    for begin in range(0, len(points_m), _LISTED):
        part = slice(begin, begin + _LISTED)
        chosen[part], found[part] = _best_views_at_once(photographs, points_m[part], normals[part])
    return chosen, found


def _best_views_at_once(photographs: Sequence[Photograph], points_m: Array, normals: Array) -> tuple[Ints, Array]:
    count = len(points_m)
    cosines = np.zeros((count, len(photographs)))
    slants = np.zeros((count, len(photographs), 3))
    for k, one in enumerate(photographs):
        _, z, place, inside = one.seen(points_m)
        ray = one.view.eye_m - points_m
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        cosine = np.einsum("ij,ij->i", ray, normals)
        inside &= z < one.farthest[place[:, 1], place[:, 0]] + _SLACK_M
        cosines[:, k] = np.where(inside & (cosine > _LEAST_COSINE), cosine, 0)
        slants[:, k] = (ray - cosine[:, None] * normals) / np.maximum(cosine, _LEAST_COSINE)[:, None]
    chosen, found = np.full((count, VIEWS), -1, dtype=np.int64), np.zeros((count, VIEWS))
    left, row = cosines.copy(), np.arange(count)
    for j in range(VIEWS):
        k = left.argmax(axis=1)
        any_left = left[row, k] > 0
        chosen[any_left, j], found[any_left, j] = k[any_left], cosines[row, k][any_left]
        left[_parallax(slants, slants[row, k], np.minimum(cosines, cosines[row, k][:, None])) < _LEAST_PARALLAX] = 0
    return chosen, found


def _parallax(slants: Array, one: Array, cosines: Array) -> Array:
    """(N, K) how far apart two views see a place, in lengths of the surface as they show it, for a unit move."""
    apart = slants - one[:, None]
    steep = one / np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-9)
    along = np.einsum("nki,ni->nk", apart, steep)
    across2 = np.maximum(np.einsum("nki,nki->nk", apart, apart) - along**2, 0)
    return np.sqrt(across2 + (along * cosines) ** 2)


def evidence(
    photographs: Sequence[Photograph], points_m: Array, normals: Array, moves_m: Array, spacing_m: float
) -> tuple[Floats, Array]:
    """How alike the photographs are, 0 to 1 (N, L), with each place moved along its normal; and the views' cosines.

    It is the correlation of patches, averaged over pairs of views. A noise is added to each variance, so that patches
    without texture correlate little. It is 0 where fewer than two views see a place.
    """
    out = np.zeros((len(points_m), len(moves_m)), dtype=np.float32)
    views, cosines = best_views(photographs, points_m, normals)
    usable = np.flatnonzero((views >= 0).sum(axis=1) >= 2)
    eyes = np.stack([one.view.eye_m for one in photographs])
    for begin in range(0, len(usable), _AT_ONCE):
        part = usable[begin : begin + _AT_ONCE]
        chosen, seen = views[part], views[part] >= 0
        eye = np.einsum("nv,nvi->ni", seen / seen.sum(axis=1, keepdims=True), eyes[chosen])
        stretch = np.maximum(cosines[part].sum(axis=1) / seen.sum(axis=1), _LEAST_STRETCH)
        steep, level = _axes(points_m[part], normals[part], eye)
        axes = np.stack([normals[part], spacing_m * steep / stretch[:, None], spacing_m * level], axis=1)
        out[part] = _likeness(_patches(photographs, points_m[part], axes, chosen, moves_m), seen)
    return out, cosines


def _axes(points_m: Array, normals: Array, eye_m: Array) -> tuple[Array, Array]:
    """Unit vectors in the surface: towards the eye, which is foreshortened, and across."""
    toward = eye_m - points_m + 1e-9  # never exactly along the normal
    steep = toward - np.einsum("ij,ij->i", toward, normals)[:, None] * normals
    steep /= np.maximum(np.linalg.norm(steep, axis=1, keepdims=True), 1e-12)
    return steep, np.cross(normals, steep).astype(np.float64)


def _likeness(patches: Floats, seen: NDArray[np.bool_]) -> Floats:
    """(N, L) mean correlation of pairs of patches (N, VIEWS, L, samples)."""
    variance = np.mean(patches**2, axis=-1) + np.float32(_NOISE**2)
    total, count = np.zeros((patches.shape[0], patches.shape[2]), dtype=np.float32), np.zeros(len(patches))
    for i in range(VIEWS):
        for j in range(i):
            both = seen[:, i] & seen[:, j]
            together = np.mean(patches[:, i] * patches[:, j], axis=-1) / np.sqrt(variance[:, i] * variance[:, j])
            total += np.where(both[:, None], np.maximum(together, 0), 0)
            count += both
    return np.asarray(total / np.maximum(count, 1)[:, None], dtype=np.float32)


def _patches(photographs: Sequence[Photograph], points_m: Array, axes: Array, chosen: Ints, moves_m: Array) -> Floats:
    """(N, VIEWS, L, samples) what each view shows of each moved patch, less its mean.

    The patch is projected with the derivative at its middle, since it is small compared with its distance.
    """
    out = np.zeros((*chosen.shape, len(moves_m), len(_U)), dtype=np.float32)
    for k in np.unique(chosen[chosen >= 0]):
        place, slot = np.nonzero(chosen == k)
        view = photographs[k].view
        R = view.T_world_camera[:3, :3]
        focal, principal = (np.array(x) for x in ((view.camera.fx, view.camera.fy), (view.camera.cx, view.camera.cy)))
        normal, steep, level = np.moveaxis(axes[place] @ R, 1, 0)
        middle = ((points_m[place] - view.eye_m) @ R)[:, None] + moves_m[:, None] * normal[:, None]
        ray, z = middle[..., :2] / middle[..., 2:], middle[..., 2:]
        pixel = ray * focal + principal
        along, across = ((x[:, None, :2] - ray * x[:, None, 2:]) / z * focal for x in (steep, level))
        u, v = (
            (pixel[..., i, None] + along[..., i, None] * _V + across[..., i, None] * _U).astype(np.float32)
            for i in (0, 1)
        )
        grey = _sampled(photographs[k].detail, u, v)
        out[place, slot] = grey - grey.mean(axis=-1, keepdims=True)
    return out


def _sampled(image: Floats, u: Floats, v: Floats) -> Floats:
    """The image at pixels (...), which cv2.remap takes as rectangles only."""
    rows = -(-u.size // _COLUMNS)
    x, y = (np.pad(k.ravel(), (0, rows * _COLUMNS - u.size), mode="edge").reshape(rows, _COLUMNS) for k in (u, v))
    out = np.empty((rows, _COLUMNS), dtype=np.float32)
    for begin in range(0, rows, _ROWS):
        part = slice(begin, begin + _ROWS)
        out[part] = cv2.remap(image, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.ravel()[: u.size].reshape(u.shape)
