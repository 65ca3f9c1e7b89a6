"""A robot's MuJoCo model: its body from the MJCF, its motors and sensors from the robot's and the servos' files."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import mujoco
import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import Scene
from servoid.hw.robot.description import Axes, Robot, Servo
from servoid.hw.robot.mjcf import EXPECTED, compiled, heard, read_body
from servoid.sim.multi_robot import ADDED, prefix, tell_apart
from servoid.sim.scene import FOUND, SCENE, add_scene, count_robots

TIMESTEP = 0.004  # s
FLOOR = f"{ADDED}floor"
_FORCE, _NET = 2, 3  # data bit beside FOUND, and reduction, of MuJoCo's contact sensor


def build(robot: Robot, scene: Scene | None = None) -> mujoco.MjModel:
    """Compile the model of `robot` on a floor, with a scene. Actuator i drives joint i of the robot's file.

    Raises ConfigError like `spec`, where MuJoCo cannot compile the body, and for a scene of other robots and obstacles:
    what a robot feels is told by its place among robots alone.
    """
    result = spec(robot, robots := count_robots(scene))
    if scene is not None:
        if robots > 1 and len(scene.pillars) + len(scene.spheres) + len(scene.objects):
            raise ConfigError("a scene has other robots, or pillars, spheres and objects, but not yet both")
        add_scene(result, scene)
    model = compiled(result, robot.mjcf)
    _check_soles(model, robot)
    for number in range(robots):
        _align_imu(model, robot, number)
    return model


def spec(robot: Robot, robots: int = 1) -> mujoco.MjSpec:
    """The editable model of so many times `robot`, for scenes that add bodies to it.

    Of the MJCF only the robot's base and what hangs on it are taken: its actuators, sensors, keyframes, options, floor
    and other bodies are left out, its defaults hold for its own elements alone. Raises ConfigError naming what the MJCF
    lacks.
    """
    result = mujoco.MjSpec()
    result.modelname = robot.name
    result.option.timestep = TIMESTEP
    result.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    result.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # 4.0.0's sparse Newton solver has a bug
    result.option.iterations, result.option.ls_iterations = 10, 10
    for number in range(robots):
        _add_body(result, robot, number)
    if robots > 1:
        tell_apart(result, robot.base, robots)
    _add_floor(result)
    for number in range(robots):
        for joint, servo in zip(robot.joints, robot.servos, strict=True):
            _add_servo(result, prefix(number) + joint.name, servo)
        _add_sensors(result, robot, number, robots)
    return result


def _add_body(model: mujoco.MjSpec, robot: Robot, number: int) -> None:
    """Put the body of the robot with this number into the world. Raises ConfigError."""
    path = Path(robot.mjcf)
    body = read_body(robot)
    for element in [*body.actuators, *body.sensors, *body.keys]:
        body.delete(element)
    with heard() as warned:
        model.worldbody.add_frame().attach_body(body.body(robot.base), prefix(number), "")
    for text in warned:
        if not re.match(EXPECTED, text):
            warnings.warn(f"{path}: {text}", stacklevel=2)
    for pair in robot.overlapping:
        first, second = (prefix(number) + name for name in pair)
        model.add_exclude(name=f"{prefix(number)}{ADDED}{'_'.join(pair)}", bodyname1=first, bodyname2=second)
    for name, load in robot.loads.items():
        carried = model.body(prefix(number) + name).add_body(name=f"{prefix(number)}{ADDED}{name}_load", pos=load.at)
        carried.mass, carried.ipos, carried.inertia = load.mass, [0, 0, 0], [1e-6, 1e-6, 1e-6]
        carried.explicitinertial = True
    base = model.body(prefix(number) + robot.base)
    for part in [base, *base.find_all("body")]:
        part.gravcomp = 0.0


def _check_soles(model: mujoco.MjModel, robot: Robot) -> None:
    """Refuse soles that the robot cannot stand on."""
    for geom in (model.geom(name) for foot in robot.feet.values() for name in foot.geoms):
        if not (int(geom.contype[0]) | int(geom.conaffinity[0])) & 1:
            raise ConfigError(
                f"{robot.mjcf}: geom {geom.name!r}, of a sole, passes through the floor: "
                "give its contype or conaffinity the bit 1"
            )


def _align_imu(model: mujoco.MjModel, robot: Robot, number: int) -> None:
    """Turn the IMU's site as the base is, whatever its axes in the file: what an IMU says is in the base's frame, as
    `imu.signs` and `imu.mounting` make it on a robot."""
    site = model.site(prefix(number) + robot.imu_site)
    turn, body = np.array([1.0, 0.0, 0.0, 0.0]), int(site.bodyid[0])
    while model.body(body).name != prefix(number) + robot.base:  # fixed to it: `load_robot` has checked
        mujoco.mju_mulQuat(turn, model.body_quat[body].copy(), turn.copy())
        body = int(model.body_parentid[body])
    mujoco.mju_negQuat(turn, turn.copy())
    if not np.allclose(site.quat, turn, atol=1e-9):
        site.quat[:], model.site_sameframe[site.id] = turn, mujoco.mjtSameFrame.mjSAMEFRAME_NONE


def _add_floor(model: mujoco.MjSpec) -> None:
    model.add_texture(
        name=FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.78, 0.80, 0.83],
        rgb2=[0.70, 0.72, 0.76],
        width=256,
        height=256,
    )
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
    model.add_material(name=FLOOR, textures=textures, texrepeat=[5, 5], texuniform=True)
    model.add_texture(
        name=f"{ADDED}sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.90, 0.94, 0.98],
        rgb2=[0.55, 0.65, 0.78],
        width=128,
        height=128,
    )
    model.worldbody.add_geom(
        name=FLOOR,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        material=FLOOR,
        contype=1,
        conaffinity=1,  # some models' soles have a type alone, some an affinity alone
        friction=[0.8, 0.005, 0.0001],
        priority=1,  # the floor's friction counts, so that randomising one number is enough
        solref=[0.008, 1.0],
    )
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    model.worldbody.add_light(pos=[0.5, -0.5, 3.0], dir=[-0.15, 0.15, -1.0], type=sun)


def _add_servo(model: mujoco.MjSpec, name: str, servo: Servo) -> None:
    """A DC motor under the firmware's law: position error times gain is a voltage, clipped at the supply.

    MuJoCo's controller compensates back-EMF; its velocity gain K^2/R takes that out again, since the firmware's does
    not. `saturation` is the braking limit, which the torque-speed line alone would exceed.
    """
    joint = model.joint(name)
    joint.damping = [servo.damping, 0, 0]
    joint.frictionloss = servo.friction
    joint.armature = servo.armature
    # Springs, ends and force limits of the file are those of another motor, or of its defaults.
    joint.stiffness, joint.springref = [0, 0, 0], 0.0
    joint.limited = joint.actfrclimited = False
    joint.range = joint.actfrcrange = [0, 0]
    joint.ref = 0.0  # zero is the pose that the file draws
    joint.actgravcomp = False
    k = servo.voltage / servo.no_load_speed
    r = k * servo.voltage / servo.stall_torque
    actuator = model.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_dcmotor(
        motorconst=[k, k],
        resistance=r,
        saturation=[servo.braking_torque, 0, 0],
        controller=[servo.stiffness, 0, k * k / r, 0, 0, servo.voltage],
        ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_POS),
    )


def _add_sensors(model: mujoco.MjSpec, robot: Robot, number: int, robots: int) -> None:
    """Sensors of one of the robots: IMU for the estimator; soles and contacts for the truth."""
    kind, obj, own = mujoco.mjtSensor, mujoco.mjtObj, prefix(number)

    def add(name: str, sensor: int, objtype: int, objname: str, **more: object) -> None:
        model.add_sensor(name=own + name, type=sensor, objtype=objtype, objname=objname, **more)

    add(f"{ADDED}gyro", kind.mjSENS_GYRO, obj.mjOBJ_SITE, own + robot.imu_site)
    add(f"{ADDED}accelerometer", kind.mjSENS_ACCELEROMETER, obj.mjOBJ_SITE, own + robot.imu_site)
    whole = {"reftype": obj.mjOBJ_XBODY, "refname": own + robot.base}
    add(FLOOR, kind.mjSENS_CONTACT, obj.mjOBJ_GEOM, FLOOR, intprm=[FOUND, 0, 1], **whole)
    for name, foot in robot.feet.items():
        body = model.geom(own + foot.geoms[0]).parent
        site = f"{own}{ADDED}{name}_foot"
        body.add_site(name=site, pos=foot.sole, quat=_quaternion(foot.axes), group=4)
        sole = {"reftype": obj.mjOBJ_XBODY, "refname": _moving(body).name}  # studs may be bodies of their own
        add(
            f"{ADDED}{name}_contact",
            kind.mjSENS_CONTACT,
            obj.mjOBJ_GEOM,
            FLOOR,
            intprm=[FOUND | _FORCE, _NET, 1],
            **sole,
        )
        add(f"{ADDED}{name}_position", kind.mjSENS_FRAMEPOS, obj.mjOBJ_SITE, site)
        add(f"{ADDED}{name}_velocity", kind.mjSENS_FRAMELINVEL, obj.mjOBJ_SITE, site)
        add(f"{ADDED}{name}_up", kind.mjSENS_FRAMEZAXIS, obj.mjOBJ_SITE, site)
    for other in (i for i in range(robots) if i != number):  # of the scene's sensors: what it touches beside the floor
        base = prefix(other) + robot.base
        add(f"{SCENE}robot{other}", kind.mjSENS_CONTACT, obj.mjOBJ_XBODY, base, intprm=[FOUND, 0, 1], **whole)


def _moving(body: mujoco.MjsBody) -> mujoco.MjsBody:
    """The body that carries this one, maybe over others, and moves by a joint."""
    while not body.joints:
        body = body.parent
    return body


def _quaternion(axes: Axes) -> Array:
    """A rotation, given by its rows, as a unit quaternion w x y z `(4,)`."""
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.array(axes).ravel())
    return result
