"""Detects spheres by Grounding DINO and SAM 2, run on arrays: boxes and masks of networks, outlines by our edges."""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image_of
from service.compute.markers.cones import Cone, cones_through, fit_cone
from service.compute.markers.detect import confirmed_outlines, detect_spheres
from service.compute.markers.paper import (
    MARGIN,
    MASK_SIDE,
    MOST_LOSS,
    Box,
    EllipseEstimate,
    cut,
    fit_ellipse,
    in_the_middle,
    middle_colour,
)
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.compute.markers.rough import RoughSphere, apart_rad
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array

PROMPT = "spheres."  # the paper's; Grounding DINO ends each phrase with a dot
INSTALL = 'pip install "orthocapture[grounded]"'
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the RGB images that both were trained on, 0..1
_SIZE = (800, 1333)  # shorter and longer side at which Grounding DINO was trained
_HALF = 0.5
Floats = NDArray[np.float32]
# PyTorch and transformers have no types that this module could use without installing them.
_Torch = Any


@dataclass(frozen=True, slots=True)
class Networks:
    """Both networks, loaded.

    `boxes` maps (B, 3, h, w) normalised RGB images to scores (B, Q), 0..1, and boxes (B, Q, 4): centre, width and
    height as fractions of the image. `masks` maps (B, 3, s, s) images, s = `side_px`, to (B, m, m) logits of the
    object in the middle.
    """

    boxes: Callable[[Floats], tuple[Floats, Floats]]
    masks: Callable[[Floats], Floats]
    size_px: tuple[int, int]  # shorter and longer side of an image for `boxes`
    side_px: int  # of an image for `masks`
    device: str


def load_networks(weights: Weights) -> Networks:
    """Load both networks with their weights, on the GPU if there is one; nothing is downloaded.

    Raises:
        ConfigurationError: PyTorch or transformers are not installed.
        DataError: the files hold something else.
    """
    try:
        torch, transformers = (importlib.import_module(name) for name in ("torch", "transformers"))
    except ImportError as error:
        raise ConfigurationError(
            f"{error.name} is not installed, which the detector `grounded` needs", remedy=f"Run {INSTALL}"
        ) from error
    transformers.utils.logging.disable_progress_bar()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    detector = _network(weights.boxes, transformers.GroundingDinoForObjectDetection).to(device).eval()
    tokenizer = _read(weights.boxes, transformers.PreTrainedTokenizerFast)
    segmenter = _network(weights.masks, transformers.Sam2Model).to(device).eval()
    return Networks(
        _box_function(torch, detector, tokenizer, device),
        _mask_function(torch, segmenter, device),
        _size(weights.boxes / "preprocessor_config.json"),
        int(segmenter.prompt_encoder.input_image_size),
        device,
    )


def _network(folder: Path, kind: Any) -> Any:
    """Return a network of this class with all of its weights; transformers would leave missing ones at random."""
    network, loaded = _read(folder, kind, output_loading_info=True)
    if missing := sorted(loaded["missing_keys"]):
        raise DataError(
            f"these are not the weights of a {kind.__name__}: {len(missing)} are missing, such as {missing[0]}",
            where=str(folder),
            remedy="Download the files again, and compare their SHA-256",
        )
    return network


def _read(folder: Path, kind: Any, **options: bool) -> Any:
    """Read a model or tokenizer of this class from its folder."""
    try:
        return kind.from_pretrained(str(folder), local_files_only=True, **options)
    # Damaged weights and configurations raise whatever the parsers of these libraries do.
    except Exception as error:
        raise DataError(
            f"this is not a {kind.__name__}: {str(error).splitlines()[0] if str(error) else type(error).__name__}",
            where=str(folder),
            remedy="Download the files again, and compare their SHA-256",
        ) from error


def _box_function(
    torch: _Torch, detector: Any, tokenizer: Any, device: str
) -> Callable[[Floats], tuple[Floats, Floats]]:
    words: Mapping[str, Any] = tokenizer(PROMPT, return_tensors="pt", return_token_type_ids=True)

    def boxes(images: Floats) -> tuple[Floats, Floats]:
        with torch.inference_mode():
            text = {name: tensor.expand(len(images), -1).to(device) for name, tensor in words.items()}
            found = detector(pixel_values=torch.from_numpy(images).to(device), **text)
            # A query's score is that of the word it fits best (Grounding DINO's own post-processing).
            scores = torch.sigmoid(found.logits).amax(dim=-1)
        return scores.cpu().numpy(), found.pred_boxes.cpu().numpy()

    return boxes


def _mask_function(torch: _Torch, segmenter: Any, device: str) -> Callable[[Floats], Floats]:
    def masks(images: Floats) -> Floats:
        # SAM 2's prompt: one point, the middle of the image, which the paper takes to lie in the sphere.
        middle = torch.full((len(images), 1, 1, 2), _HALF * images.shape[-1], device=device)
        with torch.inference_mode():
            found = segmenter(
                pixel_values=torch.from_numpy(images).to(device),
                input_points=middle,
                input_labels=torch.ones((len(images), 1, 1), dtype=torch.int32, device=device),
                multimask_output=False,
            )
        return found.pred_masks[:, 0, 0].cpu().numpy()

    return masks


def _size(path: Path) -> tuple[int, int]:
    """Return the shorter and longer side, pixels, at which Grounding DINO sees an image."""
    try:
        size = json.loads(path.read_text("utf-8")).get("size", {})
        return int(size.get("shortest_edge", _SIZE[0])), int(size.get("longest_edge", _SIZE[1]))
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise DataError("the file is not the configuration of an image processor", where=str(path)) from error


VARIABLE = "ORTHOCAPTURE_GROUNDED"
BOXES, MASKS = "grounding-dino", "sam2"  # the two folders
_FILES = {
    BOXES: ("config.json", "preprocessor_config.json", "model.safetensors", "tokenizer.json"),
    MASKS: ("config.json", "model.safetensors"),
}
_NAMES = tuple(f"{model}/{name}" for model, names in _FILES.items() for name in names)
_SOURCES = {BOXES: "IDEA-Research/grounding-dino-base", MASKS: "facebook/sam2.1-hiera-large"}
_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Weights:
    """A folder with `grounding-dino/` and `sam2/`, each as Hugging Face publishes the model."""

    folder: Path

    @property
    def boxes(self) -> Path:
        """The folder of Grounding DINO."""
        return self.folder / BOXES

    @property
    def masks(self) -> Path:
        """The folder of SAM 2."""
        return self.folder / MASKS

    def sha256(self) -> Mapping[str, str]:
        """Return the hash of every file that decides what the networks find, by its name within the folder."""
        return {name: _sha256(self.folder / name) for name in _NAMES}


def weights_in(folder: Path | None = None) -> Weights:
    """Return the weights in a folder; None: in the one that the environment variable ORTHOCAPTURE_GROUNDED names.

    Raises:
        ConfigurationError: no folder is named, or files are missing; the remedy says which, and where to put them.
    """
    named = folder or (Path(value) if (value := os.environ.get(VARIABLE)) else None)
    if named is None:
        raise ConfigurationError(
            "the detector `grounded` needs the weights of Grounding DINO and SAM 2",
            where=VARIABLE,
            remedy=f"Set {VARIABLE} (or --weights) to a folder with {_wanted()}",
        )
    missing = [name for name in _NAMES if not (named / name).is_file()]
    if missing:
        raise ConfigurationError(
            f"weights are missing: {', '.join(missing)}", where=str(named), remedy=f"The folder needs {_wanted()}"
        )
    return Weights(named)


def _wanted() -> str:
    return "; ".join(
        f"{model}/ with {', '.join(names)} of {_SOURCES[model]} (huggingface.co)" for model, names in _FILES.items()
    )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


_POINTS = 48  # of an ellipse, through which its cone is fitted
_SAME_OUTLINE = 0.3  # of the half angle: outlines of two detectors so close are of one sphere
_SURE = 0.6  # coverage and score with which an outline counts that only one detector finds


@dataclass(frozen=True, slots=True)
class GroundedDetector:
    """The paper's chain on image files (supplement, "Ellipse Detection"), with our edges after its rough ellipse.

    `least` is the number of spheres below which the threshold of the boxes falls. With `vote`, the classical detector
    searches the image as well: an outline counts if both find it, or if one finds it whole and clear.
    """

    networks: Networks
    least: int
    vote: bool = False

    @classmethod
    def of(cls, weights: Weights, least: int, *, vote: bool = False) -> GroundedDetector:
        """Load the detector with the weights of a folder; see `load_networks` for the errors raised."""
        return cls(load_networks(weights), least, vote)

    def __call__(self, path: Path, camera: CameraModel, options: DetectionOptions) -> tuple[SphereOutline, ...]:
        """Return the outlines in one image file, the most certain first.

        Raises:
            DataError: the file is not an image of the camera's size.
        """
        return self.detect(read_image_of(path, camera), camera, options)

    def detect(
        self, image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions = DEFAULTS
    ) -> tuple[SphereOutline, ...]:
        """Detect the outlines in an image (H, W, 3) of the camera's size, the most certain first."""
        boxes = [_widened(box) for box in find_boxes(image_bgr, self.networks, self.least, options)]
        roughs: list[RoughSphere] = []
        for box, mask in zip(boxes, _sphere_masks(image_bgr, boxes, self.networks), strict=True):
            if mask is not None and (rough := _rough(image_bgr, camera, fit_ellipse(mask, box))) is not None:
                roughs.append(rough)
        roughs.sort(key=lambda rough: -rough.score)
        outlines = confirmed_outlines(image_bgr, camera, roughs, options)
        return voted(outlines, detect_spheres(image_bgr, camera, options)) if self.vote else outlines


def voted(first: Sequence[SphereOutline], second: Sequence[SphereOutline]) -> tuple[SphereOutline, ...]:
    """Return the outlines that both detectors find, and the complete and clear ones of either; the best first."""
    out = [o for o in first if _shown_by(o, second) or _sure(o)]
    out += [o for o in second if _sure(o) and not _shown_by(o, first)]
    return tuple(sorted(out, key=lambda outline: -outline.score))


def _shown_by(outline: SphereOutline, others: Sequence[SphereOutline]) -> bool:
    return any(
        apart_rad(outline.cone, other.cone) < _SAME_OUTLINE * outline.cone.half_angle_rad
        and abs(other.cone.half_angle_rad - outline.cone.half_angle_rad) < _SAME_OUTLINE * outline.cone.half_angle_rad
        for other in others
    )


def _sure(outline: SphereOutline) -> bool:
    return outline.coverage > _SURE and outline.score > _SURE


def _widened(box: Box) -> Box:
    """Return the box with the margin that masks and ellipses expect around a sphere."""
    x, y = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    half = 0.5 * (1 + MARGIN) * max(box[2] - box[0], box[3] - box[1])
    return x - half, y - half, x + half, y + half


def _rough(image_bgr: NDArray[np.uint8], camera: CameraModel, ellipse: EllipseEstimate) -> RoughSphere | None:
    """Return the cone through an ellipse in pixels; None if it does not fit its mask or is not an outline."""
    if ellipse.loss > MOST_LOSS:
        return None
    t = np.linspace(0.0, 2 * np.pi, _POINTS, endpoint=False)
    c, s = np.cos(ellipse.theta_rad), np.sin(ellipse.theta_rad)
    along, across = ellipse.a * np.cos(t), ellipse.b * np.sin(t)
    pixels = np.stack([ellipse.x + c * along - s * across, ellipse.y + s * along + c * across], axis=1)
    rays = np.column_stack([camera.normalise(pixels), np.ones(_POINTS)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    third = _POINTS // 3
    axis, half = cones_through(rays[None, [0, third, 2 * third]])
    if not np.isfinite(half[0]):
        return None
    cone = fit_cone(rays, np.ones(_POINTS), Cone(axis[0], float(half[0])))
    return RoughSphere(cone, 1.0, 0.0, ellipse.loss, middle_colour(image_bgr, ellipse), plain=True)


FIRST_THRESHOLD = 0.35  # Grounding DINO's usual one
LAST_THRESHOLD = 0.1
_FALL = 0.8  # of the threshold, until enough spheres are found
_MOST_REDUCED = 2.5  # images reduced more than this are searched in tiles as well
_OVERLAP = 0.25  # of a tile, with its neighbour: a sphere on the border of one is whole in the other
_BORDER = 0.01  # of a tile; a box that ends so close to an inner border is a part
_SAME_BOX = 0.5  # intersection over union of two boxes of one sphere
_INSIDE = 0.8  # of the smaller box, in a larger one
_MOST_STRETCHED = 2.0  # side ratio of a box; a sphere at the image's border is cut
_TILES_AT_ONCE = 4  # images given to the network at once


@dataclass(frozen=True, slots=True)
class _Tile:
    left: int
    top: int
    right: int
    bottom: int

    def cuts(self, box: Array, width: int, height: int) -> bool:
        """Return whether a box in pixels of the image ends at a border of the tile that is not one of the image."""
        x, y = _BORDER * (self.right - self.left), _BORDER * (self.bottom - self.top)
        return bool(
            (self.left > 0 and box[0] < self.left + x)
            or (self.top > 0 and box[1] < self.top + y)
            or (self.right < width and box[2] > self.right - x)
            or (self.bottom < height and box[3] > self.bottom - y)
        )


def find_boxes(
    image_bgr: NDArray[np.uint8], networks: Networks, least: int, options: DetectionOptions = DEFAULTS
) -> list[Box]:
    """Find boxes (left, top, right, bottom) in pixels of an image (H, W, 3), the most certain first.

    The threshold falls from FIRST_THRESHOLD until there are `least` boxes or it is below LAST_THRESHOLD (paper,
    "Sphere Detection").

    Args:
        image_bgr: an image of any size; larger ones are searched in tiles as well.
        networks: Grounding DINO.
        least: spheres expected in the image.
        options: the range of radii, as fractions of the image's width.
    """
    width = image_bgr.shape[1]
    scores, boxes = _proposals(image_bgr, networks)
    sides = boxes[:, 2:] - boxes[:, :2]
    low, high = 2 * options.min_radius * width, 2.5 * options.max_radius * width
    fits = (sides.min(axis=1) > low) & (sides.max(axis=1) < high)
    fits &= sides.max(axis=1) < _MOST_STRETCHED * sides.min(axis=1)
    order = np.argsort(-scores[fits], kind="stable")
    scores, boxes = scores[fits][order], boxes[fits][order]
    threshold = FIRST_THRESHOLD
    while True:
        kept = _apart(boxes[scores >= threshold])
        if len(kept) >= least or threshold <= LAST_THRESHOLD:
            return [(float(b[0]), float(b[1]), float(b[2]), float(b[3])) for b in kept]
        threshold = max(LAST_THRESHOLD, _FALL * threshold)


def _proposals(image_bgr: NDArray[np.uint8], networks: Networks) -> tuple[Array, Array]:
    """Return the scores (N,) and boxes (N, 4) of the whole image and its tiles, parts at inner borders left out."""
    height, width = image_bgr.shape[:2]
    scores: list[Array] = [np.zeros(0)]
    boxes: list[Array] = [np.zeros((0, 4))]
    for group in _batches(tiles_of(width, height, networks.size_px)):
        pictures = [image_bgr[t.top : t.bottom, t.left : t.right] for t in group]
        found = networks.boxes(np.concatenate([_prepared(picture, networks.size_px) for picture in pictures]))
        for tile, some, relative in zip(group, *found, strict=True):
            side = np.array([tile.right - tile.left, tile.bottom - tile.top], dtype=np.float64)
            middle, half = relative[:, :2] * side, 0.5 * relative[:, 2:] * side
            # Fractions count from the outer edge of the first pixel, our pixels from its centre.
            shift = np.array([tile.left, tile.top]) - 0.5
            corners = np.hstack([middle - half + shift, middle + half + shift])
            whole = np.array([not tile.cuts(box, width, height) for box in corners], dtype=np.bool_)
            scores.append(np.asarray(some[whole], dtype=np.float64))
            boxes.append(np.asarray(corners[whole], dtype=np.float64))
    return np.concatenate(scores), np.concatenate(boxes)


def tiles_of(width: int, height: int, size_px: tuple[int, int]) -> list[_Tile]:
    """Return the whole image, and overlapping equal tiles if the network would see it much reduced."""
    reduced = max(min(width, height) / size_px[0], max(width, height) / size_px[1])
    out = [_Tile(0, 0, width, height)]
    if reduced > _MOST_REDUCED:
        columns, rows = (math.ceil(side / (_MOST_REDUCED * size_px[1])) + 1 for side in (width, height))
        across, down = list(_spans(width, columns)), list(_spans(height, rows))
        out += [_Tile(left, top, right, bottom) for top, bottom in down for left, right in across]
    return out


def _spans(length: int, count: int) -> Iterator[tuple[int, int]]:
    """Yield `count` equal spans that cover a length and overlap."""
    side = math.ceil(length / (count - (count - 1) * _OVERLAP)) if count > 1 else length
    for k in range(count):
        start = round(k * (length - side) / max(1, count - 1))
        yield start, start + side


def _batches(tiles: Sequence[_Tile]) -> Iterator[list[_Tile]]:
    """Yield the whole image alone, since its size differs; then tiles, several at once."""
    yield [tiles[0]]
    for first in range(1, len(tiles), _TILES_AT_ONCE):
        yield list(tiles[first : first + _TILES_AT_ONCE])


def _prepared(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> Floats:
    """Return (1, 3, h, w) of a picture as Grounding DINO was trained on them."""
    height, width = picture.shape[:2]
    factor = min(size_px[0] / min(height, width), size_px[1] / max(height, width))
    return normalised(picture, (round(factor * width), round(factor * height)))


def normalised(picture: NDArray[np.uint8], size: tuple[int, int]) -> Floats:
    """Return (1, 3, h, w) RGB of a BGR picture resized to (w, h), with the training images' mean and deviation."""
    larger = size[0] > picture.shape[1]
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR if larger else cv2.INTER_AREA)
    rgb = np.asarray(resized, dtype=np.float32)[:, :, ::-1] / np.float32(255)
    scaled = (rgb - np.array(MEAN, dtype=np.float32)) / np.array(DEVIATION, dtype=np.float32)
    return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])


def _apart(boxes: Array) -> list[Array]:
    """Select from boxes (N, 4), the best first, those that are not on a better one."""
    kept: list[Array] = []
    for box in boxes:
        if all(not _overlap(box, other) for other in kept):
            kept.append(box)
    return kept


def _overlap(a: Array, b: Array) -> bool:
    common = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    areas = [float(np.prod(box[2:] - box[:2])) for box in (a, b)]
    return bool(common > _SAME_BOX * (sum(areas) - common) or common > _INSIDE * min(areas))


_PICTURES_AT_ONCE = 6  # pictures given to the network at once: two boxes


def _sphere_masks(
    image_bgr: NDArray[np.uint8], boxes: Sequence[Box], networks: Networks
) -> Iterator[NDArray[np.bool_] | None]:
    """Yield a (MASK_SIDE, MASK_SIDE) mask of the sphere in each box's middle; None if there is none.

    SAM 2 sees each colour channel as a grey picture and is pointed at its middle; the mask has what any channel shows
    (paper, "Sphere Segmentation").

    Args:
        image_bgr: (H, W, 3) the image.
        boxes: boxes with a margin around the sphere.
        networks: the networks of SAM 2.
    """
    size = (networks.side_px, networks.side_px)
    per_batch = _PICTURES_AT_ONCE // 3
    for first in range(0, len(boxes), per_batch):
        some = [cut(image_bgr, box) for box in boxes[first : first + per_batch]]
        pictures = [normalised(np.repeat(patch[:, :, c, None], 3, axis=2), size) for patch in some for c in range(3)]
        logits = networks.masks(np.concatenate(pictures))
        for k in range(len(some)):
            yield in_the_middle(_union_of_masks(logits[3 * k : 3 * k + 3]))


def _union_of_masks(logits: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return pixels that at least one of three channels' logits (3, m, m) calls the object, at the masks' size."""
    size = (MASK_SIDE, MASK_SIDE)
    channels = [cv2.resize(channel, size, interpolation=cv2.INTER_LINEAR) > 0 for channel in logits]
    return np.any(np.array(channels), axis=0).astype(np.uint8)
