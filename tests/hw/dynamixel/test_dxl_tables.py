"""Control tables against those that the official SDK ships, and what a wrong one would cost."""

from __future__ import annotations

import pytest
from sdk_tables import SHIPPED, shipped

from servoid.hw.config import ConfigError
from servoid.hw.dynamixel.protocol.tables import models, table

SERVOS = [name for name in models() if name != "opencr"]


@pytest.mark.parametrize("model", SERVOS)
def test_registers_are_where_the_official_table_has_them(model: str) -> None:
    firmware = 51 if "330" in model else None  # the SDK's plain X330 tables are those before firmware 52
    here = table(model, firmware)
    for name, place in shipped(model).items():
        if name.startswith("indirect_") and name.endswith(("_read", "_write")):
            continue  # the SDK's own choice of blocks
        item = here.item(name)
        assert (item.address, item.width) == place, name
    unknown = set(here.items) - set(shipped(model)) - {"startup_configuration", "backup_ready"}
    assert {name for name in unknown if not name.startswith("indirect_")} == set()


@pytest.mark.parametrize("model", ["xl330-m288", "xc330-t288"])
def test_newer_x330_firmware_moves_the_indirect_data(model: str) -> None:
    fast = shipped(f"{model}_fw52")
    assert table(model, 52).item("indirect_data_1").address == fast["indirect_data_1"][0] == 208
    assert table(model, 51).item("indirect_data_1").address == 224
    assert table(model).item("indirect_data_1").address == 208


@pytest.mark.parametrize("model", SERVOS)
def test_model_numbers_are_the_official_ones(model: str) -> None:
    listing = dict(
        reversed(line.split("\t"))  # type: ignore[arg-type]
        for line in (SHIPPED / "dynamixel.model").read_text().splitlines()[1:]
        if "\t" in line
    )
    number = int(listing[f"{model.replace('-', '_')}.model"])
    assert table(model).number == number == models()[model]
    assert table(number) is not None
    assert table(number).name == model
    assert table(model).item("model_number").default == number


@pytest.mark.parametrize("model", models())
def test_a_table_is_sound(model: str) -> None:
    """Registers do not overlap, a default is inside its range and fits its width, and every limit is a register."""
    here = table(model)
    end = 0
    for item in sorted(here.items.values(), key=lambda item: item.address):
        assert item.address >= end, item.name
        end = item.end
        assert item.eeprom == (item.address < here.ram), item.name
        if item.default is not None:
            assert item.decode(item.encode(item.default)) == item.default, item.name
            if item.range is not None:
                assert item.range[0] <= item.default <= item.range[1], item.name
        for limit in item.limits or ():
            assert limit.removeprefix("-") in here, item.name
        assert item.writable or (item.range is None and item.limits is None), item.name
        for bound in item.range or ():
            item.encode(bound)


def test_what_a_model_does_not_measure_is_absent() -> None:
    """Load is not current: reading it as such would invent torques."""
    for model in ("xl430-w250", "xc430-w150", "2xc430-w250", "2xl430-w250", "mx-28"):
        here = table(model)
        assert "present_current" not in here
        assert "goal_current" not in here
        assert not here.motor_current
        assert here.item("present_load").address == 126
        assert 0 not in here.modes
    assert not table("xc330-t288").motor_current  # measures its supply
    assert table("xm540-w270").motor_current
    assert "present_load" not in table("xm430-w350")


def test_units_follow_the_model() -> None:
    assert table("xm430-w350").item("present_current").scale == pytest.approx(0.00269)
    assert table("xc330-m288").item("present_current").scale == pytest.approx(0.001)
    assert table("mx-64").item("goal_current").scale == pytest.approx(0.00336)
    velocity = table("xm430-w350").item("present_velocity")
    assert velocity.unit == "rad/s"
    assert velocity.scale == pytest.approx(0.229 * 2 * 3.141592653589793 / 60)
    assert table("xm430-w350").item("present_position").scale * 4096 == pytest.approx(6.283185307179586)


def test_signed_registers_keep_their_sign() -> None:
    item = table("xm430-w350").item("present_current")
    assert item.encode(-1) == b"\xff\xff"
    assert item.decode(b"\xff\xff") == -1
    signed = {name for name, item in table("xm430-w350").items.items() if item.signed}
    assert signed >= {
        *("homing_offset", "goal_pwm", "goal_current", "goal_velocity", "goal_position"),
        *("present_pwm", "present_current", "present_velocity", "present_position"),
    }
    assert not table("xm430-w350").item("realtime_tick").signed


def test_a_value_that_does_not_fit_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="torque_enable: 256"):
        table("xm430-w350").item("torque_enable").encode(256)
    with pytest.raises(ValueError, match="profile_velocity: -1"):
        table("xm430-w350").item("profile_velocity").encode(-1)


def test_unknown_names_are_answered_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean 'xm430-w350'"):
        table("xm430-w35")
    with pytest.raises(ConfigError, match=r"number 999; known: .*xm430-w350 1020"):
        table(999)
    with pytest.raises(KeyError, match="did you mean 'goal_position'"):
        table("xm430-w350").item("gaol_position")


def test_the_board_has_its_own_table() -> None:
    board = table("opencr")
    assert table(0x7400) is board or table(0x7400) == board
    assert (board.item("dynamixel_power").address, board.item("present_input_voltage").address) == (24, 31)
    assert [board.item(f"gyro_{axis}").address for axis in "xyz"] == [32, 34, 36]
    assert board.item("acceleration_z").scale * 32768 == pytest.approx(2 * 9.80665, rel=1e-3)
    assert board.item("gyro_z").scale == pytest.approx(2000 / 32800 * 3.141592653589793 / 180, rel=1e-3)
