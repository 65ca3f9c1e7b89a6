"""What another program left in the servos, on the virtual rig: in RAM it is put right before torque, in EEPROM it is
found and refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from sdk_tables import shipped

from servoid.hw.contracts.body import BackendError, Command, Mode
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.tables import models, table
from servoid.hw.dynamixel.servos import arming
from servoid.hw.dynamixel.servos.register_check import GRAVE, UNCOMPARED, compare, correct, find_servos
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.in_process import InProcessLine
from servoid.sim.rig.rig import Rig

ROBOT = load_robot("op3")
TICK_NS = 20_000_000
KNEE = ROBOT.names.index("r_knee")
XM430 = table("xm430-w350")
SERVOS = [name for name in models() if name != "opencr"]
# What a program may leave in RAM: the worst that a servo accepts.
LEFT = {
    "goal_pwm": 60,
    "goal_current": 10,
    "goal_velocity": 5,
    "profile_acceleration": 1,
    "profile_velocity": 3,
    "velocity_i_gain": 0,
    "velocity_p_gain": 16383,
    "position_p_gain": 30,
    "position_i_gain": 5000,
    "position_d_gain": 16383,
    "feedforward_2nd_gain": 16383,
    "feedforward_1st_gain": 16383,
    "bus_watchdog": 1,
    "goal_position": 1800,
}


@dataclass
class Found:
    """A rig whose servos have power, and another program that has spoken to them."""

    rig: Rig
    line: InProcessLine
    bus: Bus

    def write(self, id: int, **registers: int) -> None:
        for name, value in registers.items():
            assert self.bus.write_item(id, XM430.item(name), value), name

    def backend(self, **options: bool) -> DynamixelBackend:
        return DynamixelBackend(ROBOT, port=self.line, clock=self.line, **options)

    def stand(self, ticks: int) -> np.ndarray:
        """Stand at home; the joints' angles at the end."""
        sensors, motors = self.backend(exact=True).connect()
        position = ROBOT.home
        for _ in range(ticks):
            self.line.sleep_until((self.line.now_ns() // TICK_NS + 1) * TICK_NS)
            position = sensors.read().position
            motors.write(Command(ROBOT.home, np.ones(20), Mode.ACTIVE))
        return position


@pytest.fixture
def found() -> Found:
    rig = Rig(ROBOT)
    line = InProcessLine(rig)
    bus = Bus(line, line)
    assert bus.write_item(200, table("opencr").item("dynamixel_power"), 1)
    line.sleep_until(line.now_ns() + 500_000_000)
    return Found(rig, line, bus)


@pytest.mark.parametrize("model", SERVOS)
def test_every_register_of_ram_is_written_or_known_to_shape_nothing(model: str) -> None:
    items = table(model)
    written = {*arming.motion(0), *arming.SWITCHES, "goal_current", "goal_pwm", *(n for n in LEFT if "gain" in n)}
    official = {name for name, (address, _) in shipped(model).items() if address >= items.ram}
    for name in {*official, *items.items}:
        item = items.items.get(name)
        if item is None or item.eeprom or not item.writable:
            continue
        assert name in written or name.rstrip("0123456789").rstrip("_") in arming.IDLE or name in arming.IDLE, name


@pytest.mark.parametrize("register", LEFT)
def test_what_another_program_left_in_ram_is_put_right_before_torque(found: Found, register: str) -> None:
    """With goal PWM 60 at one knee the robot fell after 0.7 s, and every check said that all is well."""
    found.write(13, **{register: LEFT[register]})
    position = found.stand(15)
    knee = found.rig.servos[KNEE]
    wanted = {
        "goal_pwm": 885,
        "goal_current": 1193,
        "velocity_i_gain": 1920,
        "velocity_p_gain": 100,
        "position_p_gain": 800,
        "bus_watchdog": 4,
        "goal_position": knee.get("goal_position"),
    }
    assert knee.get(register) == wanted.get(register, 0)
    assert abs(position[KNEE] - ROBOT.home[KNEE]) < 0.15
    assert not found.rig.plant.truth.fallen[0]


def test_a_servo_that_was_told_to_answer_nothing_is_told_to_answer(found: Found) -> None:
    for level in (0, 1):
        found.bus.send(codec.sync_write(68, 1, {13: bytes([level])}))
        found.line.sleep_until(found.line.now_ns() + 1_000_000)
        assert found.rig.servos[KNEE].get("status_return_level") == level
        backend = found.backend(fix=True)
        backend.connect()
        assert found.rig.servos[KNEE].get("status_return_level") == 2
        assert backend.differences == ()


def test_a_servo_that_does_not_take_what_it_is_told_stays_limp(found: Found) -> None:
    knee = found.rig.servos[KNEE]
    _, motors = found.backend().connect()
    allowed = knee.allowed
    knee.allowed = lambda item, value: (  # type: ignore[method-assign]
        codec.StatusError.DATA_LIMIT if item.name == "goal_pwm" else allowed(item, value)
    )
    knee.put("goal_pwm", 60)
    with pytest.raises(BackendError, match=r"r_knee \(ID 13\) did not take .*goal_pwm.*: torque stays off"):
        motors.write(Command(ROBOT.home, np.ones(20), Mode.ACTIVE))
    assert not any(servo.torque for servo in found.rig.servos)


# EEPROM --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", SERVOS)
def test_every_register_of_eeprom_is_compared_or_known_to_change_nothing(model: str) -> None:
    items = table(model)
    official = {name for name, (address, _) in shipped(model).items() if address < items.ram}
    kept = {item.name for item in items.items.values() if item.eeprom and item.writable}
    known_apart = {"model_number", "model_information", "firmware_version"}
    assert official <= kept | known_apart, "a register of the official table that nothing here knows"
    for name in kept - set(UNCOMPARED):
        assert items.item(name).default is not None, name


EEPROM = {
    "secondary_id": 13,
    "startup_configuration": 1,
    "drive_mode": 4,
    "operating_mode": 4,
    "homing_offset": 300,
    "moving_threshold": 900,
    "temperature_limit": 60,
    "max_voltage_limit": 130,
    "min_voltage_limit": 110,
    "pwm_limit": 100,
    "current_limit": 50,
    "velocity_limit": 20,
    "max_position_limit": 2600,
    "min_position_limit": 1900,
    "shutdown": 0,
    "return_delay_time": 250,
}


def test_all_of_eeprom_is_tried_below() -> None:
    """Protocol 1 apart, in which a servo does not answer."""
    kept = {item.name for item in XM430.items.values() if item.eeprom and item.writable}
    assert kept - set(UNCOMPARED) - set(EEPROM) == {"protocol_type"}


@pytest.mark.parametrize("register", EEPROM)
def test_what_another_program_left_in_eeprom_is_found_refused_and_put_right(found: Found, register: str) -> None:
    found.write(14, **{register: EEPROM[register]})
    with pytest.raises(BackendError, match=r"registers differ from what op3 needs, the first on l_knee") as error:
        found.backend(exact=True).connect()
    assert register in error.value.__notes__[0]
    if register in GRAVE:
        with pytest.raises(BackendError, match="registers differ from what op3 needs"):
            found.backend().connect()
    servos = find_servos(found.bus, ROBOT)
    correct(found.bus, servos, compare(ROBOT, servos))
    assert compare(ROBOT, find_servos(found.bus, ROBOT)) == []


def test_a_servo_that_obeys_anothers_id_too_is_cured_before_anything_is_written_to_that(found: Found) -> None:
    """Written first to 13, limits of 13 would land in 14 as well; after two corrections all would look well."""
    found.write(14, secondary_id=13)
    found.write(13, max_position_limit=2100)  # of both, by now
    servos = find_servos(found.bus, ROBOT)
    correct(found.bus, servos, compare(ROBOT, servos))
    assert compare(ROBOT, find_servos(found.bus, ROBOT)) == []
    left, right = (next(s for s in found.rig.servos if s.id == id) for id in (14, 13))
    assert left.get("secondary_id") == 255
    assert left.get("max_position_limit") > 3000 > right.get("max_position_limit")
