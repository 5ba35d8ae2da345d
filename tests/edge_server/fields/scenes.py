"""A small analytic scene for field tests: a striped ball on a checkered plate, ray-cast without any field."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from freshfield.geometry import Pinhole, look_at, world_rays

BALL_M, RADIUS_M = np.array([0.0, 0.0, 0.5]), 0.5


def picture(camera: Pinhole, pose: NDArray[np.float64], ball_m: NDArray[np.float64] = BALL_M) -> NDArray:
    """uint8 (H, W, 3): striped ball, checkered plate, plain sky."""
    return seen(camera, pose, ball_m)[0]


def seen(
    camera: Pinhole, pose: NDArray[np.float64], ball_m: NDArray[np.float64] = BALL_M, radius_m: float = RADIUS_M
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The picture (H, W, 3), and how far away in meters what it shows is (H, W), inf for the sky."""
    origin, rays = world_rays(camera, pose)
    color = np.broadcast_to(np.array([0.5, 0.7, 0.9]), rays.shape).copy()
    down = rays[..., 2] < -1e-6
    t_ground = np.where(down, -origin[2] / np.where(down, rays[..., 2], -1.0), np.inf)
    hit = origin + rays * np.where(down, t_ground, 0.0)[..., None]
    near = down & (np.abs(hit[..., :2]).max(axis=-1) < 0.8)
    check = (np.floor(hit[..., 0] * 2.5) + np.floor(hit[..., 1] * 2.5)) % 2
    color[near] = np.where(check[near, None] > 0, [0.8, 0.8, 0.7], [0.3, 0.25, 0.2])
    offset = origin - ball_m
    b = rays @ offset
    root = b * b - (offset @ offset - radius_m**2)
    t_ball = np.where(root > 0, -b - np.sqrt(np.maximum(root, 0.0)), np.inf)
    front = (t_ball > 0) & (t_ball < np.where(near, t_ground, np.inf))
    normal = (origin + rays * np.where(front, t_ball, 0.0)[..., None] - ball_m) / radius_m
    stripe = 0.5 + 0.5 * np.sign(np.sin(8.0 * normal[..., 2]))
    paint = np.stack([0.9 - 0.5 * stripe, 0.2 + 0.4 * stripe, 0.2 + 0.2 * normal[..., 0]], axis=-1)
    color[front] = paint[front]
    away_m = np.where(front, t_ball, np.where(near, t_ground, np.inf))
    return np.clip(color * 255.0 + 0.5, 0, 255).astype(np.uint8), away_m


def ring(count: int, size: int = 48, ball_m: NDArray[np.float64] = BALL_M, distance_m: float = 2.5) -> list[View]:
    """``count`` cameras around the scene, at two heights, all looking at its middle."""
    camera = Pinhole.from_fov(size, size, 50.0)
    views = []
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        eye = distance_m * np.array([np.cos(angle), np.sin(angle), 0.35 + 0.35 * (k % 2)])
        pose = look_at(eye, (0.0, 0.0, 0.4))
        views.append(View(f"cam{k:02d}", picture(camera, pose, ball_m), pose, camera, k))
    return views


def a_meter_off(view: View) -> View:
    """With a pose a meter to the right of its picture's."""
    pose = view.camera_to_world.copy()
    pose[:3, 3] += pose[:3, 0]
    return replace(view, camera_to_world=pose)


def psnr(a: NDArray, b: NDArray) -> float:
    """PSNR in dB of float pictures in [0, 1]."""
    return float(-10.0 * np.log10(np.mean((np.asarray(a, float) - b) ** 2) + 1e-12))


def mean_psnr(field: Any, views: list[View]) -> float:
    """Of what a field shows of ``views``, dB."""
    pictures = [(field.render(v.camera_to_world, v.intrinsics).color, v.image / 255.0) for v in views]
    return float(np.mean([psnr(a, b) for a, b in pictures]))
