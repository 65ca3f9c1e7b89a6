"""The robot description: joints, servos, legs and limits, loaded from `configs/robots/*.yaml`."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import yaml

from servoid.hw.config import ConfigError, load_marked, resolve
from servoid.hw.contracts.body import Array
from servoid.hw.robot.body import with_body
from servoid.hw.robot.checks import check_robot, check_servo
from servoid.hw.robot.plausible import check_geometry, check_plausible

_GRAVITY = 9.81  # m/s2
GAIT = "gait.yaml"  # in a robot's own folder


@dataclass(frozen=True)
class Servo:
    """A servo model. Torques N m, speeds rad/s, times s, at `voltage`; stiffness is that of gain scale 1."""

    name: str
    model_number: int
    ticks_per_turn: int
    center_tick: int
    velocity_unit: float  # rad/s
    current_unit: float  # A
    torque_per_ampere: float  # N m/A
    voltage_unit: float  # V
    position_p_gain: int
    voltage: float
    stiffness: float
    stall_torque: float
    no_load_speed: float
    braking_torque: float
    damping: float
    friction: float
    armature: float
    command_delay: float
    position_latency: float
    max_temperature: float
    voltage_range: tuple[float, float]
    # Beyond `friction`, which is Coulomb's: what more of it a gear has at rest [N m], the speed [rad/s] at which that
    # has faded to 1/e, and the share of the motor's torque that the gear loses.
    stribeck_friction: float = 0.0
    stribeck_speed: float = 0.1
    load_friction: float = 0.0


@dataclass(frozen=True)
class Payload:
    """A known weight [kg] on a body of the MJCF, at a point of that body's frame [m]."""

    mass: float
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Joint:
    """A joint. `zero` is added to the servo's angle, `direction` is 1 or -1; angles rad."""

    name: str
    servo: str  # a name in configs/servos, or a .yaml file: relative to the robot's file, absolute once loaded
    id: int
    direction: int
    zero: float
    range: tuple[float, float]
    home: float
    mirror: str
    mirror_sign: int
    gear: float = 1.0  # turns of the servo's horn for one of the joint: a belt, or gears between the two


@dataclass(frozen=True)
class Link:
    """A joint on the way from the base to a foot: its offset [m] from the joint before it, and its axis, both in the
    frame of that joint, which is the base's at zero angles."""

    joint: str
    offset: tuple[float, float, float]
    axis: tuple[float, float, float]


Axes = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
_UNTURNED: Axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Foot:
    """A foot: its collision geoms, and its sole's centre [m] in the frame of their body and half length and width.

    What a file leaves out of these is NaN until `load_robot` reads it from the MJCF; so are the last three, rotations
    being rows of a matrix: the sole's axes (forward, left, up) as columns in the body's frame, and where the body is in
    the frame of the leg's last joint.
    """

    geoms: tuple[str, ...]
    sole: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    half_size: tuple[float, float] = (math.nan, math.nan)
    axes: Axes = _UNTURNED
    body_place: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    body_axes: Axes = _UNTURNED


@dataclass(frozen=True)
class Limits:
    """What the guard enforces. Speeds rad/s, angles rad, temperatures degrees C, voltages V, `stale` in ticks.

    From `derate_temperature` and `derate_voltage` on gains go down, until at `temperature` and `voltage` the robot is
    lowered. None: no such limit, only the servos' own.
    """

    joint_speed: float
    margin: float
    homing_speed: float
    tilt: float
    stale: int
    temperature: float
    derate_temperature: float | None = None
    voltage: float | None = None
    derate_voltage: float | None = None


@dataclass(frozen=True)
class Imu:
    """The IMU: where it is and how it is mounted, and its errors: standard deviation of a sample's noise, half-width of
    the bias at power-on.

    `average` [s] is the span that its low-pass filter averages over: samples at the loop's rate alone would alias.
    `signs` are those of the sensor's axes against the mounted ones, `mounting` [rad] the roll, pitch and yaw that then
    turn these into the base's (hw/imu/mounting.py). The board's (`opencr`) is on the servo bus; another has a `port`,
    and with `none` the robot is taken to be upright.
    """

    gyro_noise: float
    gyro_bias: float
    accelerometer_noise: float
    accelerometer_bias: float
    average: float
    latency: float
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kind: Literal["opencr", "witmotion", "bno08x", "none"] = "opencr"
    port: str | None = None
    baud: int = 115200  # of that port
    yaw_sign: float = 1.0  # of a bno08x: -1 if its yaw counts clockwise


@dataclass(frozen=True)
class Walking:
    """What a controller may ask of the robot at most, and how high it walks.

    What a file leaves out is NaN until `load_robot` derives it from the standing height.
    """

    forward: float = math.nan  # m/s
    backward: float = math.nan  # m/s
    sideways: float = math.nan  # m/s
    turning: float = math.nan  # rad/s
    height: float = math.nan  # m of the base above the ground while it walks

    @property
    def lower(self) -> Array:
        """The least twist to ask for `(3,)`: m/s forward, m/s left, rad/s."""
        return -np.array([self.backward, self.sideways, self.turning])

    @property
    def upper(self) -> Array:
        """The greatest twist to ask for `(3,)`."""
        return np.array([self.forward, self.sideways, self.turning])

    @property
    def scale(self) -> Array:
        """Top speed in any direction, and of turning `(3,)`: by shares of it robots of any size are asked alike."""
        return np.array([self.forward, self.forward, self.turning])

    @property
    def relative(self) -> Array:
        """Top speeds as multiples of the shipped robot's, forward, to the sides and turning `(3,)`."""
        result: Array = self.upper / shipped_robot().walking.upper
        return result

    def derived(self, standing_height: float) -> Walking:
        """With what is NaN derived from the standing height [m], as alike robots of any size walk alike.

        Forward they reach a Froude number v^2 / (g h) of 0.1, backward and sideways 0.3 and 0.26 of that speed. They
        turn by half a radian while they walk as far as they are tall.
        """
        height = standing_height if math.isnan(self.height) else self.height
        forward = math.sqrt(0.1 * _GRAVITY * height) if math.isnan(self.forward) else self.forward
        found = {"height": height, "forward": forward, "backward": 0.3 * forward, "sideways": 0.26 * forward}
        found["turning"] = 0.5 * forward / height
        return replace(self, **{key: value for key, value in found.items() if math.isnan(getattr(self, key))})


Button = Literal["mode", "start", "user"]


@dataclass(frozen=True)
class BusSettings:
    """The servo bus. Any of the board's `stop_buttons` is an emergency stop. With `board` none the servos are on an
    adapter such as a U2D2 and have a supply of their own. `supply_resistance` is that of the battery and its wires, by
    which a virtual rig's voltage sags."""

    baud: int
    board_id: int = 200
    board: Literal["opencr", "none"] = "opencr"
    stop_buttons: tuple[Button, ...] = ("mode", "start", "user")
    supply_resistance: float = 0.04  # Ohm: a 3S pack of the size that fits an OP3, with its wires
    supply_voltage: float | None = None  # V in simulation, the servos idle; None: what the servos' figures hold for


@dataclass(frozen=True)
class Robot:
    """A robot, as its file and its MJCF describe it. Joint arrays below are `(n_joints,)` in the file's order.

    `legs` and a standing height that the file leaves out are read from the MJCF by `load_robot`.
    """

    name: str
    mjcf: str  # relative to the robot's file; absolute once loaded
    base: str
    imu_site: str
    rate: int
    bus: BusSettings
    limits: Limits
    imu: Imu
    feet: dict[str, Foot]
    joints: tuple[Joint, ...]
    standing_height: float = math.nan  # m of the base above the ground at the home pose
    legs: dict[str, tuple[Link, ...]] = field(default_factory=dict)  # of each foot, from the base on
    walking: Walking = Walking()
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, of the base's frame, in that of its body in the MJCF
    passive: tuple[str, ...] = ()  # joints that no servo drives: not commanded, not read
    overlapping: tuple[tuple[str, str], ...] = ()  # bodies of the MJCF, drawn into each other, that pass through
    held: tuple[
        str, ...
    ] = ()  # joints of the MJCF that do not turn: a servo's horn beside the joint that it is geared to
    weight: float | None = None  # N; None: the file does not say it
    floor_friction: float = 0.8  # of what it walks on, in simulation
    loads: dict[str, Payload] = field(default_factory=dict)  # what the MJCF lacks, by the body that carries it
    # Settings of its gait: a name in configs/policies/, or a .yaml file beside the robot's; empty: none of its own.
    gait: str = ""
    folder: str = ""  # of its networks and its gait; absolute once loaded
    arms: dict[str, float] = field(
        default_factory=dict
    )  # joints that swing arms, and the sign of swinging the left back

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def home(self) -> Array:
        return np.array([joint.home for joint in self.joints])

    @cached_property
    def lower(self) -> Array:
        return np.array([joint.range[0] for joint in self.joints])

    @cached_property
    def upper(self) -> Array:
        return np.array([joint.range[1] for joint in self.joints])

    @cached_property
    def mirror(self) -> tuple[Array, Array]:
        """Index and sign such that `q[..., index] * sign` is the pose seen in a mirror (left and right swapped)."""
        index = np.array([self.names.index(joint.mirror) for joint in self.joints])
        return index, np.array([float(joint.mirror_sign) for joint in self.joints])

    @cached_property
    def leg_index(self) -> Array:
        """Joint numbers of each leg, `(n_legs, joints of a leg)`, hip to ankle."""
        return np.array([[self.names.index(link.joint) for link in leg] for leg in self.legs.values()])

    @cached_property
    def bare_servos(self) -> tuple[Servo, ...]:
        """The servo of each joint by itself."""
        models = {name: load_servo(name) for name in {joint.servo for joint in self.joints}}
        return tuple(models[joint.servo] for joint in self.joints)

    @cached_property
    def servos(self) -> tuple[Servo, ...]:
        """The servo of each joint as it acts there, behind the joint's gear; ticks alone are the servo's own."""
        pairs = zip(self.joints, self.bare_servos, strict=True)
        return tuple(servo if joint.gear == 1.0 else geared(servo, joint.gear) for joint, servo in pairs)

    @cached_property
    def tick_angles(self) -> Array:
        """How far each joint turns for a tick of its servo [rad]."""
        return 2.0 * np.pi / np.array([servo.ticks_per_turn for servo in self.servos]) / self.gears

    @cached_property
    def gears(self) -> Array:
        return np.array([joint.gear for joint in self.joints])

    @cached_property
    def extended(self) -> Array:
        """Whether each joint's range is wider than the one turn that its servo has in position mode `(n_joints,)`."""
        turn = np.array([servo.ticks_per_turn - 1 for servo in self.servos])
        return (self.upper - self.lower) / self.tick_angles > turn

    @property
    def dt(self) -> float:
        """Length of a tick [s]."""
        return 1.0 / self.rate


def geared(servo: Servo, gear: float) -> Servo:
    """A servo seen through a gear: `gear` turns of its own for one of the joint."""
    return replace(
        servo,
        velocity_unit=servo.velocity_unit / gear,
        torque_per_ampere=servo.torque_per_ampere * gear,
        stiffness=servo.stiffness * gear**2,
        stall_torque=servo.stall_torque * gear,
        no_load_speed=servo.no_load_speed / gear,
        braking_torque=servo.braking_torque * gear,
        damping=servo.damping * gear**2,
        friction=servo.friction * gear,
        armature=servo.armature * gear**2,
        stribeck_friction=servo.stribeck_friction * gear,
        stribeck_speed=servo.stribeck_speed / gear,
    )


def load_servo(name: str) -> Servo:
    """Load a servo model by name, checked. Raises ConfigError naming file, line and key."""
    servo, marks = load_marked(resolve("servos", name), Servo)
    check_servo(servo, marks)
    return servo


def save_servo(servo: Servo, path: Path, head: str = "") -> None:
    """Write a servo's file, after lines of comment. Numbers have six digits."""
    values = {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(servo).items()}
    values = {key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in values.items()}
    path.write_text(head + yaml.safe_dump(values, sort_keys=False, default_flow_style=None))


def load_robot(name: str | Path = "op3") -> Robot:
    """Load a robot by name or file, with what its MJCF says, checked. Raises ConfigError naming file, line and key."""
    if Path(name).suffix.lower() in (".urdf", ".xml") and Path(name).is_file():
        raise ConfigError(f"{name}: is a model; a robot's file is YAML, and servoid robot import {name} drafts it")
    path = resolve("robots", name)
    robot, marks = load_marked(path, Robot)
    check_robot(robot, marks)
    folder = path.parent.resolve()
    joints = tuple(
        replace(joint, servo=str(folder / joint.servo)) if joint.servo.endswith((".yaml", ".yml")) else joint
        for joint in robot.joints
    )
    own = (folder / (robot.folder or path.stem)).resolve()
    gait = str(folder / robot.gait) if robot.gait.endswith((".yaml", ".yml")) else robot.gait
    if not gait and (own / GAIT).is_file():
        gait = str(own / GAIT)
    robot = replace(robot, mjcf=str((folder / robot.mjcf).resolve()), joints=joints, gait=gait, folder=str(own))
    check_plausible(robot, marks)  # loads the servos' files: one that cannot be used is found now
    robot = with_body(robot, marks)
    check_geometry(robot, marks)
    return replace(robot, walking=robot.walking.derived(robot.standing_height))


@cache
def shipped_robot() -> Robot:
    """The robot that numbers of a task or a policy hold for, where they hold for one."""
    return load_robot()


def save_robot(robot: Robot, path: Path) -> None:
    """Write a file that `load_robot` reads as the same robot, on this machine: its paths are absolute."""
    path.write_text(yaml.safe_dump(asdict(robot), sort_keys=False))


__all__ = ["ConfigError", "Joint", "Robot", "Servo", "load_robot", "load_servo", "save_robot", "shipped_robot"]
