"""A robot's shapes as triangles: one mesh for all of a body that has one colour, since few are drawn quickly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate
from servoid.sim.drawing.shapes import BodyShape

SECTIONS = 24  # of a circle


@dataclass(frozen=True)
class Mesh:
    body: str
    colour: tuple[int, int, int]  # 0..255
    opacity: float | None  # None: solid
    vertices: Array  # (n, 3) m, the body's frame
    faces: Array  # (m, 3) int


def meshes(shapes: Sequence[BodyShape]) -> list[Mesh]:
    """The triangles of shapes, by body and colour."""
    groups: dict[tuple[str, tuple[float, ...]], list[BodyShape]] = {}
    for shape in shapes:
        groups.setdefault((shape.body, tuple(shape.colour.tolist())), []).append(shape)
    made = []
    for (body, colour), group in groups.items():
        vertices, faces, count = [], [], 0
        for shape in group:
            points, triangles = triangulated(shape)
            vertices.append(rotate(shape.orientation, points) + shape.position)
            faces.append(triangles + count)
            count += len(points)
        rgb = (round(255 * colour[0]), round(255 * colour[1]), round(255 * colour[2]))
        opacity = None if colour[3] >= 1.0 else colour[3]
        made.append(Mesh(body, rgb, opacity, np.concatenate(vertices), np.concatenate(faces)))
    return made


def triangulated(shape: BodyShape) -> tuple[Array, Array]:
    """Corners `(n, 3)` m and triangles `(m, 3)` of a shape, about its own middle."""
    size = shape.size
    if shape.kind == "mesh":
        assert shape.vertices is not None
        assert shape.faces is not None
        return shape.vertices, shape.faces
    if shape.kind == "box":
        solid = trimesh.creation.box(extents=2 * size)
    elif shape.kind == "cylinder":
        solid = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=SECTIONS)
    elif shape.kind == "capsule":
        solid = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[SECTIONS // 2, SECTIONS])
    else:
        solid = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        solid.apply_scale(size if shape.kind == "ellipsoid" else size[0])
    return np.asarray(solid.vertices, dtype=float), np.asarray(solid.faces)
