"""Vectors and quaternions as tf2 calculates with them (LinearMath), in the same order.

In C++ on x86-64 the bits are the same; a compiler that fuses multiplications and additions (ARM)
may differ in the last one.
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x y z w


def plus(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def conjugate(q: Quaternion) -> Quaternion:
    return -q[0], -q[1], -q[2], q[3]


def times(p: Quaternion, q: Quaternion) -> Quaternion:
    return (
        p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1],
        p[3] * q[1] + p[1] * q[3] + p[2] * q[0] - p[0] * q[2],
        p[3] * q[2] + p[2] * q[3] + p[0] * q[1] - p[1] * q[0],
        p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2],
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    turned = (
        q[3] * v[0] + q[1] * v[2] - q[2] * v[1],
        q[3] * v[1] + q[2] * v[0] - q[0] * v[2],
        q[3] * v[2] + q[0] * v[1] - q[1] * v[0],
        -q[0] * v[0] - q[1] * v[1] - q[2] * v[2],
    )
    return times(turned, conjugate(q))[:3]


def _dot(p: Quaternion, q: Quaternion) -> float:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]


def slerp(p: Quaternion, q: Quaternion, ratio: float) -> Quaternion:
    cosine = _dot(p, q)
    if cosine < 0.0:  # the same rotation, nearer
        q = (-q[0], -q[1], -q[2], -q[3])
    cosine = min(abs(cosine) / math.sqrt(_dot(p, p) * _dot(q, q)), 1.0)
    angle = math.acos(cosine) * 2.0 / 2.0
    if angle == 0.0:
        return p
    scale = 1.0 / math.sin(angle)
    s, t = math.sin((1.0 - ratio) * angle), math.sin(ratio * angle)
    return (
        (p[0] * s + q[0] * t) * scale,
        (p[1] * s + q[1] * t) * scale,
        (p[2] * s + q[2] * t) * scale,
        (p[3] * s + q[3] * t) * scale,
    )


def through_matrix(q: Quaternion) -> Quaternion:
    """The quaternion of a quaternion's matrix, as tf2's Transform holds rotations."""
    x, y, z, w = q
    s = 2.0 / _dot(q, q)
    xs, ys, zs = x * s, y * s, z * s
    wx, wy, wz = w * xs, w * ys, w * zs
    xx, xy, xz = x * xs, x * ys, x * zs
    yy, yz, zz = y * ys, y * zs, z * zs
    m = (
        (1.0 - (yy + zz), xy - wz, xz + wy),
        (xy + wz, 1.0 - (xx + zz), yz - wx),
        (xz - wy, yz + wx, 1.0 - (xx + yy)),
    )
    trace = m[0][0] + m[1][1] + m[2][2]
    if trace > 0.0:
        s = math.sqrt(trace + 1.0)
        w, s = s * 0.5, 0.5 / s
        return (m[2][1] - m[1][2]) * s, (m[0][2] - m[2][0]) * s, (m[1][0] - m[0][1]) * s, w
    i = 1 if m[0][0] < m[1][1] else 0
    if m[i][i] < m[2][2]:
        i = 2
    j, k = (i + 1) % 3, (i + 2) % 3
    s = math.sqrt(m[i][i] - m[j][j] - m[k][k] + 1.0)
    result = [0.0, 0.0, 0.0, 0.0]
    result[i], s = s * 0.5, 0.5 / s
    result[3] = (m[k][j] - m[j][k]) * s
    result[j] = (m[j][i] + m[i][j]) * s
    result[k] = (m[k][i] + m[i][k]) * s
    return result[0], result[1], result[2], result[3]
