"""Normal equations of the registration, compressed per image, with the errors of the images' poses marginalised.

The linearised model: rows r (three per outline, whitened) + J x + A_i xi_i = noise of variance `factor`, with x the
unknowns common to all images and xi_i ~ N(0, P_i) the pose error of image i, which moves all its spheres together. Of
each image only the products of [J A r] are needed: a few kilobytes, however many points or outlines it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class Blocks:
    """Products of the whitened rows for each of N images; n common unknowns."""

    JJ: Array  # (n, n), summed over the images
    JA: Array  # (N, n, 6)
    AA: Array  # (N, 6, 6)
    Jr: Array  # (N, n)
    Ar: Array  # (N, 6)
    rr: Array  # (N,)
    rows: Array  # (N,) number of rows; those with weights below one count in part


def compress(J: Array, A: Array, r: Array, image: NDArray[np.int64], n_images: int, weights: Array) -> Blocks:
    """Blocks from outlines' J (O, 3, n), A (O, 3, 6) and r (O, 3), each in `image` (O,) and with a weight (O,)."""
    n = J.shape[2]
    root = np.sqrt(weights)[:, None, None]
    F = np.concatenate([J, A, r[:, :, None]], axis=2) * root
    out = np.zeros((n_images, n + 7, n + 7))
    order = np.argsort(image, kind="stable")
    starts = np.searchsorted(image[order], np.arange(n_images + 1))
    for i in range(n_images):
        mine = order[starts[i] : starts[i + 1]]
        if len(mine):
            rows = F[mine].reshape(-1, n + 7)
            out[i] = rows.T @ rows
    counted = np.bincount(image, weights=3.0 * np.minimum(weights, 1.0), minlength=n_images)
    return Blocks(
        out[:, :n, :n].sum(axis=0), out[:, :n, n:-1], out[:, n:-1, n:-1],
        out[:, :n, -1], out[:, n:-1, -1], out[:, -1, -1], counted.astype(np.float64),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Marginal:
    """Normal equations of the common unknowns only: H dx = -g."""

    H: Array  # (n, n)
    g: Array  # (n,)
    quadratic: float  # weighted sum of squares at dx = 0
    log_determinant: float  # of the covariance of all rows
    Q: Array  # (N, 6, 6) covariance of a pose error, given the common unknowns


def marginalise(blocks: Blocks, root: Array, factor: float) -> Marginal:
    """Integrate out the pose errors, xi_i = root_i z with z ~ N(0, I); `root` is (N, 6, 6), zero for exact poses."""
    inner = np.eye(6) + np.einsum("nji,njk,nkl->nil", root, blocks.AA, root) / factor
    Q = np.einsum("nij,njk,nlk->nil", root, np.linalg.inv(inner), root)
    JQ = blocks.JA @ Q
    n = len(blocks.JJ)
    left = JQ.transpose(1, 0, 2).reshape(n, -1)
    H = blocks.JJ / factor - left @ blocks.JA.transpose(1, 0, 2).reshape(n, -1).T / factor**2
    g = blocks.Jr.sum(axis=0) / factor - left @ blocks.Ar.ravel() / factor**2
    quadratic = float(blocks.rr.sum() / factor - np.einsum("ni,nij,nj->", blocks.Ar, Q, blocks.Ar) / factor**2)
    log_determinant = float(np.linalg.slogdet(inner)[1].sum() + blocks.rows.sum() * np.log(factor))
    return Marginal((H + H.T) / 2, g, quadratic, log_determinant, Q)


def pose_errors(blocks: Blocks, marginal: Marginal, dx: Array, factor: float) -> Array:
    """Most probable pose errors (N, 6) for a step dx of the common unknowns."""
    return -np.einsum("nij,nj->ni", marginal.Q, blocks.Ar + np.einsum("nki,k->ni", blocks.JA, dx)) / factor


def outline_and_pose_shares(blocks: Blocks, marginal: Marginal, root: Array, factor: float) -> tuple[Array, Array]:
    """Parts (n, n) of H due to the noise of the outlines and to that of the poses; they sum to H.

    With R = C + A P A' they are J' R^-1 C R^-1 J and J' R^-1 A P A' R^-1 J.
    """
    # A' R^-1 J = A' C^-1 J - A' C^-1 A Q A' C^-1 J, with C^-1 the whitened product over the factor.
    AJ = blocks.JA.transpose(0, 2, 1) / factor
    through = AJ - blocks.AA @ marginal.Q @ AJ / factor
    poses = np.einsum("nji,njk->nik", root, through)
    share = np.einsum("nik,nil->kl", poses, poses)
    return marginal.H - share, share


def solve_symmetric(H: Array, b: Array) -> Array:
    """H^-1 b for a positive semi-definite H, scaled first because the unknowns' units differ."""
    d = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    scaled = H * np.outer(d, d)
    return d * np.linalg.lstsq(scaled, d * b, rcond=1e-14)[0]


def inverse_symmetric(H: Array) -> Array:
    """H^-1 (pseudo-inverse), scaled first because the unknowns' units differ."""
    d = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.linalg.pinv(H * np.outer(d, d), rcond=1e-14, hermitian=True) * np.outer(d, d)
