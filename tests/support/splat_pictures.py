"""A picture of splats by the formulas of the paper, in float64, one splat after the other."""

from __future__ import annotations

import numpy as np

from nerfbake import Camera, Splats
from nerfbake.kernels.march.sh import sh_basis


def covariances(splats: Splats) -> np.ndarray:
    """(n, 3, 3): R S S R'."""
    w, x, y, z = splats.quats.astype(np.float64).T
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]).transpose(2, 0, 1)  # fmt: skip
    axes = turn * splats.scales.astype(np.float64)[:, None]
    return axes @ axes.transpose(0, 2, 1)


def reference_picture(
    splats: Splats, camera: Camera, background: tuple[float, float, float] = (1, 1, 1), places: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour (H, W, 3) before the clamp at 1, alpha and depth.

    places (H, W, 2): where the pixels are in the picture of a pinhole camera; None: they are there.
    """
    to_camera = np.linalg.inv(camera.pose) * np.array([1, -1, -1, 1])[:, None]  # y down, z forward
    turn, shift = to_camera[:3, :3], to_camera[:3, 3]
    H, W = camera.height, camera.width
    if places is None:
        places = np.stack(np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5), axis=-1)
        low, high = np.zeros(2), np.array([W, H])
    else:
        low, high = places.min(axis=(0, 1)) - 0.5, places.max(axis=(0, 1)) + 0.5
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    margin = 0.3 * (high - low) / 2
    means = splats.means.astype(np.float64)
    ways = means - camera.pose[:3, 3]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    colours = np.maximum(np.einsum("nb,nbc->nc", sh_basis(ways, splats.B), splats.sh.astype(np.float64)) + 0.5, 0)
    seen = means @ turn.T + shift
    shapes = covariances(splats)
    passed, out, far = np.ones((H, W)), np.zeros((H, W, 3)), np.zeros((H, W))
    closed = np.zeros((H, W), bool)
    for i in np.argsort(seen[:, 2].astype(np.float32), kind="stable"):
        x, y, z = seen[i]
        if z <= 0.01:
            continue
        slope = np.clip([x / z, y / z], (low - margin - centre) / focal, (high + margin - centre) / focal)
        J = np.array([[focal[0] / z, 0, -focal[0] * slope[0] / z], [0, focal[1] / z, -focal[1] * slope[1] / z]])
        sharp = J @ turn @ shapes[i] @ turn.T @ J.T
        blurred = sharp + 0.3 * np.eye(2)
        opacity = float(splats.opacity[i])
        if splats.antialiased:
            opacity *= np.sqrt(max(2.5e-5, np.linalg.det(sharp) / np.linalg.det(blurred)))
        d = places - (focal * [x / z, y / z] + centre)
        exponent = -np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(blurred), d) / 2
        alpha = np.minimum(0.99, opacity * np.exp(exponent))
        alpha[alpha < 1 / 255] = 0
        closed |= passed * (1 - alpha) < 1e-4
        weight = np.where(closed, 0, passed * alpha)
        out += weight[..., None] * colours[i]
        far += weight * z
        passed = np.where(closed, passed, passed * (1 - alpha))
    ahead = (places - centre) / focal
    depth = np.where(passed < 1, far / np.maximum(1 - passed, 1e-30), 0) * np.sqrt(1 + (ahead**2).sum(axis=-1))
    return out + passed[..., None] * np.array(background), 1 - passed, depth
