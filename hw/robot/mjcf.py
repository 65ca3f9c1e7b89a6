"""A robot's MJCF or URDF, read by MuJoCo: the one description of its body. MuJoCo is imported when a file is read."""

from __future__ import annotations

import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError
from servoid.hw.robot.rerooted import rerooted

if TYPE_CHECKING:
    import mujoco

    from servoid.hw.robot.description import Robot

_NAMED = 8  # of the names that there are, where none is near
_MESHES = (".stl", ".obj", ".msh")  # that MuJoCo reads
# MuJoCo warns that such a model cannot be saved, which nobody does, and that options differ, which are left out.
EXPECTED = "Attaching a spec with an empty prefix|Attach conflict"


def read_body(robot: Robot) -> mujoco.MjSpec:
    """The file of a robot's body, with all that the robot's file names. Raises ConfigError naming what it lacks."""
    path = Path(robot.mjcf)
    spec = read_spec(path, robot.base)
    _hold(spec, robot, path)
    _check(spec, robot, path)
    if any(robot.origin):
        _move_origin(spec.body(robot.base), robot.origin)
    return spec


def _hold(spec: mujoco.MjSpec, robot: Robot, path: Path) -> None:
    """Take away the joints that the robot holds, and the constraints that name them."""
    import mujoco

    held = set(robot.held)
    for name in robot.held:
        _need(robot, path, "joint", name, [joint.name for joint in spec.joints])
    for constraint in list(spec.equalities):
        if constraint.type == mujoco.mjtEq.mjEQ_JOINT and held & {constraint.name1, constraint.name2}:
            spec.delete(constraint)
    for tendon in list(spec.tendons):
        if held & {wrap.target.name for wrap in tendon.path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT}:
            spec.delete(tendon)
    for element in [*spec.actuators, *spec.sensors, *spec.keys] if held else []:
        spec.delete(element)
    for name in robot.held:
        spec.delete(spec.joint(name))


def _move_origin(body: mujoco.MjsBody, origin: tuple[float, float, float]) -> None:
    """Put the origin of a body's frame to a point of it, and leave all that it holds where it is."""
    for part in [*body.bodies, *body.geoms, *body.sites, *body.cameras, *body.lights, *body.frames]:
        if part.frame is None:
            part.pos = part.pos - origin
    if body.explicitinertial:
        body.ipos = body.ipos - origin


def read_spec(path: Path, base: str | None = None) -> mujoco.MjSpec:
    """The editable model of an MJCF or a URDF file, hanging on the body `base` where that is named.

    The root of a URDF becomes a body with a free joint, fixed links stay bodies of their own, and meshes are looked for
    beside the file and above it, however they are named. Raises ConfigError.
    """
    import mujoco

    if not path.is_file():
        raise ConfigError(f"mjcf: no such file: {path}")
    with heard() as warned:
        try:
            if _is_urdf(path):
                spec = mujoco.MjSpec.from_string(_adapted(path))
                for root in spec.worldbody.bodies:
                    root.add_freejoint()
                for body in spec.bodies[1:]:
                    body.add_site(name=body.name)  # a URDF has none: the link of an IMU stands for it
            else:
                spec = mujoco.MjSpec.from_file(str(path))
            if base is not None:
                spec = rerooted(spec, base, path)
        except (ValueError, UnicodeDecodeError, ElementTree.ParseError) as error:
            remedy = "; no plugin is needed here: take it out of the file" if "plugin" in str(error) else ""
            raise ConfigError(f"{path}: not a valid MJCF or URDF: {' '.join(str(error).split())}{remedy}") from error
    for text in warned:
        warnings.warn(f"{path}: {text}", stacklevel=2)
    for count, body in enumerate(spec.bodies):
        body.name = body.name or f"body{count}"  # sensors need the names of feet
        # So that a foot can be said to have it. Shapes that only show the robot do not count: some may not be at hand.
        for number, geom in enumerate(geom for geom in body.geoms if geom.contype or geom.conaffinity):
            if not geom.name:
                geom.name = f"{body.name}.{number}"
    return spec


def compiled(spec: mujoco.MjSpec, path: str | Path) -> mujoco.MjModel:
    """The model of what was read from `path`. Raises ConfigError where MuJoCo cannot compile it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", EXPECTED)
        try:
            return spec.compile()
        except ValueError as error:
            raise ConfigError(f"{path}: MuJoCo cannot compile it: {' '.join(str(error).split())}") from error


@contextmanager
def heard() -> Iterator[list[str]]:
    """What MuJoCo warns of meanwhile, instead of its standard error and a file in whatever folder this is."""
    import mujoco

    warned: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warned.append)
    try:
        yield warned
    finally:
        mujoco.set_mju_user_warning(before)


def _check(model: mujoco.MjSpec, robot: Robot, path: Path) -> None:
    """Refuse a model that lacks what the robot's file names, or whose base and joints are of another kind."""

    import mujoco

    def need(kind: str, wanted: str, present: list[str]) -> None:
        _need(robot, path, kind, wanted, present)

    need("body", robot.base, [body.name for body in model.bodies])
    base = model.body(robot.base)
    if base.parent.name != "world":
        raise ConfigError(
            f"{path}: body {robot.base!r} is a child of {base.parent.name!r}: "
            "a robot's base must be a child of <worldbody>"
        )
    if [joint.type for joint in base.joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise ConfigError(
            f"{path}: body {robot.base!r} needs <freejoint/> as its only joint: "
            f"it has {', '.join(repr(joint.name) for joint in base.joints) or 'none'}"
        )
    kinds = {joint.name: joint.type for joint in base.find_all("joint")}
    for joint in robot.joints:
        need("joint", joint.name, list(kinds))
        if kinds[joint.name] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ConfigError(f"{path}: joint {joint.name!r} is not a hinge, but a servo turns")
    for name in (name for pair in robot.overlapping for name in pair):
        need("body (that overlaps another)", name, [body.name for body in [base, *base.find_all("body")]])
    for name in robot.loads:
        need("body (that carries a load)", name, [body.name for body in [base, *base.find_all("body")]])
    need("site (the IMU's)", robot.imu_site, [site.name for site in base.find_all("site")])
    geoms = [geom.name for geom in base.find_all("geom")]
    elsewhere = {geom.name for geom in model.geoms} - set(geoms)
    for foot in robot.feet.values():
        for geom in foot.geoms:
            if geom in elsewhere:
                raise ConfigError(f"{path}: geom {geom!r}, of a sole, is no descendant of the base {robot.base!r}")
            need("geom (of a sole)", geom, geoms)
    own = [joint.name for joint in base.joints]
    for name in robot.passive:
        need("joint", name, list(kinds))
    extra = [name for name in kinds if name not in (*robot.names, *robot.passive, *own)]
    if extra:
        raise ConfigError(f"{path}: joints that robot {robot.name!r} does not list: {', '.join(extra)}")


def _need(robot: Robot, path: Path, kind: str, wanted: str, present: list[str]) -> None:
    if wanted not in present:
        near = get_close_matches(wanted, present, 1)
        some = sorted(name for name in present if name)[:_NAMED]
        hint = f"; nearest: {near[0]}" if near else f"; there are {', '.join(some)}" if some else ""
        raise ConfigError(f"{path}: no {kind} named {wanted!r}, which robot {robot.name!r} needs{hint}")


def _is_urdf(path: Path) -> bool:
    return path.suffix.lower() == ".urdf" or re.search(rb"<robot[\s>]", path.read_bytes()[:10_000]) is not None


def _adapted(path: Path) -> str:
    """A URDF as MuJoCo reads it best. A mesh that only shows the robot and that MuJoCo cannot read is left out."""
    text = path.read_text(encoding="utf-8")
    if "<xacro:" in text or "${" in text:
        raise ConfigError(f"{path}: is xacro, of which a URDF is made first: xacro {path.name} > robot.urdf")
    root = ElementTree.fromstring(text)
    for old in root.findall("mujoco"):
        root.remove(old)
    extension = ElementTree.SubElement(root, "mujoco")
    settings = {"fusestatic": "false", "discardvisual": "false", "strippath": "false", "balanceinertia": "true"}
    ElementTree.SubElement(extension, "compiler", settings)
    shapes = [part for link in root.iter("link") for kind in ("visual", "collision") for part in link.findall(kind)]
    named = Counter(part.get("name") for part in shapes)
    for part in shapes:
        if named[part.get("name")] > 1:  # xacro calls each of them `collision`, of which MuJoCo warns one by one
            part.attrib.pop("name", None)
    for link in root.iter("link"):
        for kind in ("visual", "collision"):
            for part in link.findall(kind):
                mesh = part.find("geometry/mesh")
                if mesh is None:
                    continue
                name = mesh.get("filename", "")
                found = _mesh(path, name)
                if found is not None and found.suffix.lower() in _MESHES:
                    mesh.set("filename", str(found))
                elif kind == "visual":
                    link.remove(part)
                else:
                    what = f"MuJoCo reads {', '.join(_MESHES)}"
                    if found is None:
                        what = "no such file beside the URDF or in the four folders above: put its package there"
                    raise ConfigError(f"{path}: link {link.get('name')!r}: collision mesh {name}: {what}")
    return ElementTree.tostring(root, encoding="unicode")


def _mesh(path: Path, name: str) -> Path | None:
    """The file that a URDF calls `name`: as it is, or a package's, which is somewhere above or beside the URDF."""
    plain = re.sub(r"^(package|file|model)://", "", name)
    tails = [Path(plain), Path(*Path(plain).parts[1:])] if "://" in name else [Path(plain)]
    for folder in (path.parent, *list(path.resolve().parents)[:4]):
        for tail in tails:
            if (folder / tail).is_file():
                return (folder / tail).resolve()
    return None
