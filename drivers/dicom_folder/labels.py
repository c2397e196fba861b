"""Puts the voxels of a segmentation onto those of its CT series: exactly, or not at all."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import UnreadableFileError
from drivers.interfaces import Array, Transform
from service.core.units import mm

_TOLERANCE = 0.05  # voxels, at the farthest corner: what rounding of positions explains
#: NIfTI's axes (x right, y front, z head) in DICOM's (x left, y back, z head).
LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True)
class Block:
    """Labels on a grid of their own.

    Attributes:
        T_ct_block: (4, 4) maps indices along the array's axes, in their order, to metres in the ct frame.
        inside: array of three axes; a single slice has one element along its last axis.
        name: the slice's name, for messages; "" for the only block.
    """

    T_ct_block: Transform
    inside: NDArray[np.bool_]
    name: str = ""


def voxels_inside(
    blocks: Iterable[Block], shape: tuple[int, int, int], T_ct_voxel: Transform, where: Path
) -> NDArray[np.bool_]:
    """The union of the blocks on the voxels (K, J, I) of a series.

    Axes may be permuted or reversed. Raises UnreadableFileError if voxels do not coincide, or lie outside the series.
    """
    inside = np.zeros(shape, dtype=np.bool_)
    for block in blocks:
        T_voxel_block = _in_voxels(T_ct_voxel, block.T_ct_block)
        whole = np.rint(T_voxel_block)
        if not _coincide(T_voxel_block, block.inside.shape):
            raise _elsewhere(block, shape, T_ct_voxel, where)
        marked = np.argwhere(block.inside)
        i, j, k = (marked @ whole[:3, :3].T + whole[:3, 3]).astype(np.int64).T
        within = (i >= 0) & (j >= 0) & (k >= 0) & (i < shape[2]) & (j < shape[1]) & (k < shape[0])
        if not within.all():
            raise UnreadableFileError(
                f"{np.count_nonzero(~within):,} voxels of the segmentation{block.name} lie outside the CT series",
                where=str(where),
                remedy="Check that it was made of this series, and of all its slices",
            )
        inside[k, j, i] = True
    return inside


def _in_voxels(T_ct_voxel: Transform, T_ct_block: Transform) -> Transform:
    """T_voxel_block (4, 4): indices of a block to indices of the series."""
    return np.asarray(np.linalg.solve(T_ct_voxel, T_ct_block), dtype=np.float64)


def _coincide(T_voxel_block: Transform, shape: tuple[int, ...]) -> bool:
    """Return whether the indices of a block are those of voxels, up to the order and the direction of axes."""
    whole = np.rint(T_voxel_block)
    if not np.isfinite(T_voxel_block).all() or np.abs(whole).max() > 1e6:
        return False
    used = [axis for axis, n in enumerate(shape) if n > 1]
    turned = whole[:3, used]
    if not (np.all(np.abs(turned).sum(axis=0) == 1) and np.all(np.abs(turned).sum(axis=1) <= 1)):
        return False
    corners = np.array([[*corner, 1] for corner in itertools.product(*((0, n - 1) for n in shape))], dtype=np.float64)
    return float(np.abs(corners @ (T_voxel_block - whole)[:3].T).max()) <= _TOLERANCE


def _elsewhere(block: Block, shape: tuple[int, int, int], T_ct_voxel: Transform, where: Path) -> UnreadableFileError:
    """Why the voxels of a block are not those of the series."""
    negated = _in_voxels(T_ct_voxel, LPS_FROM_RAS @ block.T_ct_block)
    ends = np.array([[0, 0, 0, 1], [*(n - 1 for n in block.inside.shape), 1]]) @ negated[:3].T
    if _coincide(negated, block.inside.shape) and np.all((ends > -1) & (ends < np.array(shape[::-1]))):
        return UnreadableFileError(
            f"the segmentation{block.name} lies on the voxels of the CT series only if x and y are negated: it was "
            "written without the change between the axes of DICOM (LPS) and NIfTI (RAS), and is mirrored or turned",
            where=str(where),
            remedy="Write it with a program that changes the axes (3D Slicer and nibabel leave them to the affine)",
        )
    own, series = (mm(np.linalg.norm(T[:3, :3], axis=0)) for T in (block.T_ct_block, T_ct_voxel))
    return UnreadableFileError(
        f"the voxels of the segmentation{block.name} are not those of the CT series: they have {_sides(own)} mm, "
        f"those of the series {_sides(series)} mm, and the first one is {_offset(block, T_ct_voxel)} voxels from a "
        "voxel of the series",
        where=str(where),
        remedy="Segment this series, without resampling or cropping to another grid; nothing is resampled",
    )


def _sides(lengths: Array) -> str:
    return " × ".join(f"{length:.4g}" for length in lengths)


def _offset(block: Block, T_ct_voxel: Transform) -> str:
    first = _in_voxels(T_ct_voxel, block.T_ct_block)[:3, 3]
    return f"{np.linalg.norm(first - np.rint(first)):.2f}"


def chosen(wanted: tuple[str, ...], known: dict[str, int], where: Path) -> tuple[tuple[str, ...], frozenset[int]]:
    """The names and numbers of the wanted segments, of all if none is named.

    Raises UnreadableFileError, which lists the segments there are.
    """
    lacking = [name for name in wanted if name not in known]
    if lacking or not known:
        there = ", ".join(known) or "none"
        raise UnreadableFileError(
            f"it has no segment {', '.join(map(repr, lacking))} (there is: {there})"
            if lacking
            else "it has no segments",
            where=str(where),
            remedy="Name one of these in `segments` of the step, or export the segmentation again",
        )
    names = wanted or tuple(known)
    return names, frozenset(known[name] for name in names)
