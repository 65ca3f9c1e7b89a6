"""A robot's MuJoCo model: its body from the MJCF, its motors and sensors from the robot's and the servos' files."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

import mujoco

from servoid.hw.config import ConfigError
from servoid.hw.contracts.world import Scene
from servoid.hw.robot.description import Robot, Servo
from servoid.sim.multi_robot import add_others, prefix
from servoid.sim.scene import FOUND, PREFIX, add_scene, count_robots

TIMESTEP = 0.004  # s
_FORCE, _NET = 2, 3  # data bit beside FOUND, and reduction, of MuJoCo's contact sensor


def build(robot: Robot, scene: Scene | None = None) -> mujoco.MjModel:
    """Compile the model of `robot` on a floor, with a scene. Actuator i drives joint i of the robot's file.

    The MJCF's own actuators, sensors and keyframes are replaced. Raises ConfigError naming what the MJCF lacks or the
    joint whose servo cannot be simulated beside the others, and for a scene of other robots and obstacles: what a robot
    feels is told by its place among robots alone.
    """
    result = spec(robot, robots := count_robots(scene))
    if scene is not None:
        if robots > 1 and len(scene.pillars) + len(scene.spheres):
            raise ConfigError("a scene has other robots, or pillars and spheres, but not yet both")
        add_scene(result, scene)
    return result.compile()


def spec(robot: Robot, robots: int = 1) -> mujoco.MjSpec:
    """The editable model of so many times `robot`, for scenes that add bodies to it. Raises ConfigError."""
    _check_delays(robot)
    result = _load(robot)
    result.option.timestep = TIMESTEP
    result.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    result.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # 4.0.0's sparse Newton solver has a bug
    result.option.iterations, result.option.ls_iterations = 10, 10
    _add_floor(result)
    if robots > 1:
        add_others(result, robot.base, lambda: _load(robot), robots)
    for number in range(robots):
        for joint, servo in zip(robot.joints, robot.servos, strict=True):
            _add_servo(result, prefix(number) + joint.name, servo)
        _add_sensors(result, robot, number, robots)
    return result


def _load(robot: Robot) -> mujoco.MjSpec:
    """The body of `robot` alone. Raises ConfigError."""
    path = Path(robot.mjcf)
    if not path.is_file():
        raise ConfigError(f"{robot.name}: mjcf: no such file: {path}")
    try:
        result = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigError(f"{path}: not a valid MJCF: {error}") from error
    _check(result, robot, path)
    for element in [*result.actuators, *result.sensors, *result.keys]:
        result.delete(element)
    return result


def _check(model: mujoco.MjSpec, robot: Robot, path: Path) -> None:
    """Refuse a model that lacks what the robot's file names."""

    def need(kind: str, wanted: str, present: list[str]) -> None:
        if wanted not in present:
            near = get_close_matches(wanted, present, 1)
            hint = f"; nearest: {near[0]}" if near else ""
            raise ConfigError(f"{path}: no {kind} named {wanted!r}, which robot {robot.name!r} needs{hint}")

    joints = [joint.name for joint in model.joints]
    for joint in robot.joints:
        need("joint", joint.name, joints)
    need("body", robot.base, [body.name for body in model.bodies])
    need("site (the IMU's)", robot.imu_site, [site.name for site in model.sites])
    geoms = [geom.name for geom in model.geoms]
    for foot in robot.feet.values():
        for geom in foot.geoms:
            need("geom (of a sole)", geom, geoms)
    extra = [name for joint in model.joints if (name := joint.name) not in robot.names and joint.type != 0]
    if extra:
        raise ConfigError(f"{path}: joints that robot {robot.name!r} does not list: {', '.join(extra)}")


def _check_delays(robot: Robot) -> None:
    """Refuse servos that differ in what is simulated, and drawn, once for the whole robot."""
    first = robot.servos[0]
    for joint, servo in zip(robot.joints, robot.servos, strict=True):
        for key in ("command_delay", "position_latency"):
            if getattr(servo, key) != getattr(first, key):
                raise ConfigError(
                    f"{robot.name}: {joint.name}: {key} of its servo {servo.name} is {getattr(servo, key):g} s, "
                    f"that of {robot.names[0]}'s {first.name} {getattr(first, key):g} s: simulation has one for all "
                    "servos of a robot; give both files the same"
                )


def _add_floor(model: mujoco.MjSpec) -> None:
    if any(geom.name == "floor" for geom in model.geoms):
        return
    model.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.78, 0.80, 0.83],
        rgb2=[0.70, 0.72, 0.76],
        width=256,
        height=256,
    )
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    model.add_material(name="floor", textures=textures, texrepeat=[5, 5], texuniform=True)
    model.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.90, 0.94, 0.98],
        rgb2=[0.55, 0.65, 0.78],
        width=128,
        height=128,
    )
    model.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        material="floor",
        contype=1,
        conaffinity=0,
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

    add("gyro", kind.mjSENS_GYRO, obj.mjOBJ_SITE, own + robot.imu_site)
    add("accelerometer", kind.mjSENS_ACCELEROMETER, obj.mjOBJ_SITE, own + robot.imu_site)
    whole = {"reftype": obj.mjOBJ_XBODY, "refname": own + robot.base}
    add("floor", kind.mjSENS_CONTACT, obj.mjOBJ_GEOM, "floor", intprm=[FOUND, 0, 1], **whole)
    for name, foot in robot.feet.items():
        body = model.geom(own + foot.geoms[0]).parent
        site = f"{name}_foot"
        body.add_site(name=own + site, pos=foot.sole, group=4)
        sole = {"reftype": obj.mjOBJ_BODY, "refname": body.name}
        add(f"{name}_contact", kind.mjSENS_CONTACT, obj.mjOBJ_GEOM, "floor", intprm=[FOUND | _FORCE, _NET, 1], **sole)
        add(f"{name}_position", kind.mjSENS_FRAMEPOS, obj.mjOBJ_SITE, own + site)
        add(f"{name}_velocity", kind.mjSENS_FRAMELINVEL, obj.mjOBJ_SITE, own + site)
        add(f"{name}_up", kind.mjSENS_FRAMEZAXIS, obj.mjOBJ_SITE, own + site)
    for other in (i for i in range(robots) if i != number):  # of the scene's sensors: what it touches beside the floor
        base = prefix(other) + robot.base
        add(f"{PREFIX}robot{other}", kind.mjSENS_CONTACT, obj.mjOBJ_XBODY, base, intprm=[FOUND, 0, 1], **whole)
