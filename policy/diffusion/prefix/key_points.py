"""Places of a robot's key points by forward kinematics from its MJCF, for numpy arrays and, differentiably, torch.

Key points are the ends of the limbs (soles, hands, head) and, of a limb with three joints or more, the joint in its
middle (knees, elbows); of a whole body also its first joint (hips, shoulders), and the toes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotation_matrix
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.hw.robot.limbs import Limb
from servoid.hw.robot.mirror import Mirror
from servoid.hw.robot.mjcf import compiled, read_body

if TYPE_CHECKING:
    import mujoco

AnyArray = Any  # a numpy array or a torch tensor

_AMID = 0.02  # m from the middle plane within which an end has no side


@dataclass(frozen=True)
class _Link:
    """A servo's body: `turn` + sin(q) `sine` + (1 - cos(q)) `versine` turns it into its parent, where it is at `place`
    but for what its joint's anchor, `anchor` in its own frame, adds."""

    parent: int  # index of a link; -1: the base
    joint: int
    place: Array  # (3,) m of the anchor, in the parent's frame
    turn: Array  # (3, 3)
    sine: Array
    versine: Array
    anchor: Array  # (3,) m


class KeyPoints:
    """Names and places of key points `(..., points, 3)`; `ends` of the names are those of limbs."""

    def __init__(self, robot: Robot, *, whole: bool = False) -> None:
        """`whole` adds what says how trunk and feet are turned. Raises ConfigError for an MJCF that cannot be read."""
        model = compiled(read_body(robot), robot.mjcf)
        self._base = int(model.body(robot.base).id)
        self._links: list[_Link] = []
        self._of_body: dict[int, int] = {self._base: -1}  # body -> its link
        self._in_link: dict[int, tuple[Array, Array]] = {self._base: (np.zeros(3), np.eye(3))}  # body -> pose in it
        for body in range(self._base + 1, model.nbody):
            if int(model.body_parentid[body]) in self._of_body:
                self._add(model, robot, body)
        ends: dict[str, tuple[int, Array]] = {}
        for side, sole in zip(robot.legs, self._soles(model, robot), strict=True):
            ends[f"{side} foot"] = sole
        ends = {**self._free_ends(model, robot), **ends}
        middles = {}
        for name, (link, place) in ends.items():
            limb, _, part = name.rpartition(" ")
            middle = self._middle(link, place, robot.home)
            if middle is not None and limb:
                middles[f"{limb} {'knee' if part == 'foot' else 'elbow'}"] = (middle, self._links[middle].anchor)
        self.ends = tuple(ends)
        points = {**ends, **middles, **(self._further(robot, ends) if whole else {})}
        self.names = tuple(points)
        self._point_links = [link for link, _ in points.values()]
        self._point_places = np.array([place for _, place in points.values()])

    def __call__(self, joints: AnyArray) -> AnyArray:
        """Places `(..., points, 3)` m in the base frame, of joints `(..., n_joints)` rad."""
        rotations, positions = self._frames(joints)
        places = [
            positions[link] + self._turned(rotations[link], self._point_places[i])
            for i, link in enumerate(self._point_links)
        ]
        return np.stack(places, -2) if isinstance(joints, np.ndarray) else _torch().stack(places, -2)

    def mirror(self) -> Mirror:
        """Of `points` vectors (x, y, z), one after the other."""
        swap = {"left": "right", "right": "left"}
        other = [" ".join(swap.get(word, word) for word in name.split(" ")) for name in self.names]
        points = Mirror(
            np.array([self.names.index(name) for name in other]), np.ones(len(self.names), dtype=np.float32)
        )
        return Mirror.vectors(points)

    def limb(self, name: str) -> Limb:
        """The chain from the base to a key point. Raises KeyError where there is none of that name."""
        if name not in self.names:
            raise KeyError(name)
        point = self.names.index(name)
        link, place = self._point_links[point], self._point_places[point]
        rotations, positions = self._frames(np.zeros(1 + max(each.joint for each in self._links)))
        tip, chain = positions[link] + rotations[link] @ place, self._chain(link)
        anchors = [positions[k] + rotations[k] @ self._links[k].anchor for k in chain]
        axes = []
        for k in chain:
            skew = self._links[k].turn.T @ self._links[k].sine
            axes.append(rotations[k] @ [skew[2, 1], skew[0, 2], skew[1, 0]])
        return Limb(tuple(self._links[k].joint for k in chain), np.array(anchors), np.array(axes), tip)

    # -- reading the model ---------------------------------------------------------------------------------------------

    def _add(self, model: mujoco.MjModel, robot: Robot, body: int) -> None:
        """Take in a body: as a link where a servo moves it, and else as fixed to the link of its parent."""
        parent = int(model.body_parentid[body])
        place, turn = self._in_link[parent]
        place = place + turn @ model.body_pos[body]
        turn = turn @ rotation_matrix(model.body_quat[body])
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        servos = [j for j in range(first, first + count) if model.joint(j).name in robot.names]
        link = self._of_body[parent]
        for j in servos:  # a body may have several, each in the frame that those before it leave
            x, y, z = model.jnt_axis[j]
            skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            anchor = np.array(model.jnt_pos[j])
            self._links.append(
                _Link(
                    link,
                    robot.names.index(model.joint(j).name),
                    place + turn @ anchor,
                    turn,
                    turn @ skew,
                    turn @ skew @ skew,
                    anchor,
                )
            )
            link, place, turn = len(self._links) - 1, np.zeros(3), np.eye(3)
        self._of_body[body], self._in_link[body] = link, (place, turn)

    def _soles(self, model: mujoco.MjModel, robot: Robot) -> list[tuple[int, Array]]:
        """Link and place in it of the middle of each sole."""
        found = []
        for name in robot.legs:
            foot = robot.feet[name]
            body = int(model.geom(foot.geoms[0]).bodyid[0])
            place, turn = self._in_link[body]
            found.append((self._of_body[body], place + turn @ np.array(foot.sole)))
        return found

    def _further(self, robot: Robot, ends: Mapping[str, tuple[int, Array]]) -> dict[str, tuple[int, Array]]:
        """The first joint of each limb that has a side, and the middle of each sole's front edge."""
        rotations, positions = self._frames(robot.home)
        legs = Legs(robot)
        corners = dict(zip(robot.legs, legs.soles(legs.pick(robot.home))[1], strict=True))
        found = {}
        for name, (link, _) in ends.items():
            side, _, part = name.rpartition(" ")
            if side:
                first = self._chain(link)[0]
                found[f"{side} {'hip' if part == 'foot' else 'shoulder'}"] = first, self._links[first].anchor
            if part == "foot":
                front = corners[side][np.argsort(corners[side][:, 0])[-2:]].mean(0)
                found[f"{side} toe"] = link, rotations[link].T @ (front - positions[link])
        return found

    def _chain(self, link: int) -> list[int]:
        """Links from the base to this one."""
        chain = [link]
        while self._links[chain[0]].parent >= 0:
            chain.insert(0, self._links[chain[0]].parent)
        return chain

    def _free_ends(self, model: mujoco.MjModel, robot: Robot) -> dict[str, tuple[int, Array]]:
        """Head and hands: the highest end in the middle, and the furthest one of each side that is no foot."""
        parents = set(model.body_parentid.tolist())
        feet = {int(model.geom(geom).bodyid[0]) for foot in robot.feet.values() for geom in foot.geoms}
        found: dict[str, tuple[float, int, Array]] = {}
        for body, link in self._of_body.items():
            if body in parents or body in feet or link < 0:
                continue
            place = self._tip(model, body)
            _, y, z = self._at(link, place, robot.home)
            name = "head" if abs(y) < _AMID else "left hand" if y > 0 else "right hand"
            far = z if name == "head" else abs(y)
            if name not in found or far > found[name][0]:
                found[name] = (far, link, place)
        return {name: found[name][1:] for name in ("left hand", "right hand", "head") if name in found}

    def _tip(self, model: mujoco.MjModel, body: int) -> Array:
        """The middle of the body's furthest part from its joint, in the frame of its link."""
        place, turn = self._in_link[body]
        first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
        solid = [g for g in range(first, first + count) if model.geom_contype[g] or model.geom_conaffinity[g]]
        places = [np.array(model.geom_pos[g]) for g in solid] or [np.array(model.body_ipos[body])]
        return place + turn @ max(places, key=lambda p: float(np.linalg.norm(p)))

    def _middle(self, link: int, end: Array, home: Array) -> int | None:
        """The joint of a limb that is furthest from its first joint and from its end; None for one of two joints."""
        chain = self._chain(link)
        if len(chain) < 3:
            return None
        root, tip = self._at(chain[0], self._links[chain[0]].anchor, home), self._at(link, end, home)

        def inside(k: int) -> float:
            at = self._at(k, self._links[k].anchor, home)
            return float(min(np.linalg.norm(at - root), np.linalg.norm(at - tip)))

        return max(chain[1:], key=inside)

    def _at(self, link: int, place: Array, joints: Array) -> Array:
        rotations, positions = self._frames(joints)
        at: Array = positions[link] + rotations[link] @ place
        return at

    # -- kinematics ----------------------------------------------------------------------------------------------------

    def _frames(self, joints: AnyArray) -> tuple[list[AnyArray], list[AnyArray]]:
        """Rotation `(..., 3, 3)` and position `(..., 3)` of each link in the base frame."""
        xp: Any = np if isinstance(joints, np.ndarray) else _torch()
        sine, versine = xp.sin(joints)[..., None, None], 1.0 - xp.cos(joints)[..., None, None]
        rotations: list[AnyArray] = []
        positions: list[AnyArray] = []
        for link in self._links:
            turn, by_sine, by_versine, place, anchor = (
                part if xp is np else joints.new_tensor(part)
                for part in (link.turn, link.sine, link.versine, link.place, link.anchor)
            )
            local = turn + sine[..., link.joint, :, :] * by_sine + versine[..., link.joint, :, :] * by_versine
            if link.parent < 0:
                rotation, position = local, place
            else:
                rotation = rotations[link.parent] @ local
                position = positions[link.parent] + rotations[link.parent] @ place
            rotations.append(rotation)
            positions.append(position - rotation @ anchor)
        return rotations, positions

    @staticmethod
    def _turned(rotation: AnyArray, place: Array) -> AnyArray:
        return rotation @ (place if isinstance(rotation, np.ndarray) else rotation.new_tensor(place))


class Soles:
    """How much each foot touches the ground, by the height of its sole alone, as HumanML3D has it: `(..., n_feet)`.

    1 up to `ON` above the ground, 0 from `OFF` on, straight in between.
    """

    ON, OFF = 0.005, 0.015  # m

    def __init__(self, robot: Robot) -> None:
        self._legs = Legs(robot)

    def __call__(self, place: Array, turn: Array, joints: Array) -> Array:
        """Of a base at `place` `(..., 3)` m, turned by `turn` `(..., 3, 3)`, with `joints` `(..., n_joints)` rad."""
        _, corners = self._legs.soles(self._legs.pick(joints))
        lowest = np.einsum("...lki,...i->...lk", corners, turn[..., 2, :]).min(-1) + place[..., None, 2]
        return np.clip((self.OFF - lowest) / (self.OFF - self.ON), 0.0, 1.0)


def _torch() -> Any:
    import torch

    return torch
