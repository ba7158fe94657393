"""The 2D Gaussian rasterizer written down plainly for torch autograd in float64: every splat at every pixel."""

import torch

SH_C0 = 0.28209479177387814


def rotation_of(quaternion):
    """Rotation matrices (n, 3, 3) of wxyz quaternions (n, 4)."""
    w, x, y, z = (quaternion / quaternion.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def exponential(xi):
    """The rigid transform (4, 4) of a tangent vector (translation, rotation)."""
    zero = xi.new_zeros(())
    rows = [
        torch.stack([zero, -xi[5], xi[4], xi[0]]),
        torch.stack([xi[5], zero, -xi[3], xi[1]]),
        torch.stack([-xi[4], xi[3], zero, xi[2]]),
        torch.stack([zero, zero, zero, zero]),
    ]
    return torch.linalg.matrix_exp(torch.stack(rows))


def render(parameters, xi, camera, world_from_camera, reference_depth=1.0, alpha_max=0.99):
    """Return (h, w, 9): color, sum of w z, normals, opacity, distortion; no cut-offs.

    The ray of every pixel is intersected with every splat by solving a 3x3 system, and all pairs of splats enter the
    distortion, so that nothing is shared with how the compiled kernels do it.
    """
    camera_from_world = torch.linalg.inv(world_from_camera @ exponential(xi))
    r, t = camera_from_world[:3, :3], camera_from_world[:3, 3]
    axes = r @ rotation_of(parameters[:, 3:7])
    center = parameters[:, :3] @ r.T + t
    scale = parameters[:, 7:9].exp()
    h = torch.stack([axes[:, :, 0] * scale[:, :1], axes[:, :, 1] * scale[:, 1:], center], dim=2)
    normal = axes[:, :, 2] * -torch.sign((axes[:, :, 2] * center).sum(1, keepdim=True))
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    yy, xx = torch.meshgrid(y, x, indexing="ij")
    rays = torch.stack([xx, yy, torch.ones_like(xx)], -1).reshape(-1, 3)
    solved = torch.linalg.solve(h, rays.T.expand(len(h), 3, -1))  # (n, 3, pixels): (u, v, 1) / z
    u, v, z_disk = solved[:, 0] / solved[:, 2], solved[:, 1] / solved[:, 2], 1 / solved[:, 2]
    dx = rays[None, :, 0] * camera.fx - (center[:, 0] / center[:, 2] * camera.fx)[:, None]
    dy = rays[None, :, 1] * camera.fy - (center[:, 1] / center[:, 2] * camera.fy)[:, None]
    rho_disk, rho_screen = u * u + v * v, 2 * (dx * dx + dy * dy)
    on_disk = (z_disk > 0) & (rho_disk <= rho_screen)
    rho = torch.where(on_disk, rho_disk, rho_screen)
    # Under the screen-space filter the depth follows the plane within a factor.
    z = torch.where(on_disk, z_disk, center[:, 2:] / (center[:, 2:] / z_disk).clamp(0.9, 1.1))
    alpha = (torch.sigmoid(parameters[:, 9:10]) * torch.exp(-0.5 * rho)).clamp(max=alpha_max)
    order = torch.argsort(center[:, 2])
    alpha, z, normal = alpha[order], z[order], normal[order]
    color = (0.5 + SH_C0 * parameters[:, 10:13]).clamp(min=0)[order]
    passed = torch.cumprod(1 - alpha, 0)
    light = torch.cat([torch.ones_like(passed[:1]), passed[:-1]])
    weight = alpha * light
    m = 4 * reference_depth / (reference_depth + z)
    spread = (m[:, None] - m[None]) ** 2 * weight[:, None] * weight[None]
    planes = [weight.T @ color, (weight * z).sum(0)[:, None], weight.T @ normal, weight.sum(0)[:, None]]
    planes.append(0.5 * spread.sum((0, 1))[:, None])
    return torch.cat(planes, 1).reshape(camera.height, camera.width, 9)
