"""A device on a Dynamixel bus as its firmware answers: instructions that touch a control table.

Source of the instructions and of what is refused: ROBOTIS e-Manual, protocol 2.0 and the pages of the X series.
"""

from __future__ import annotations

import struct

from servoid.hw.dynamixel.protocol.codec import (
    BROADCAST,
    CLEAR_REVOLUTIONS,
    InstructionCode,
    Reset,
    Status,
    StatusError,
)
from servoid.hw.dynamixel.protocol.tables import ControlTable, Item
from servoid.sim.rig.servo.registers import Registers

BACKUP = 0x20  # the instruction: control table backup
_BACKUP_KEY = b"CTRL"
_STORE, _RESTORE = b"\x01" + _BACKUP_KEY, b"\x02" + _BACKUP_KEY
_BACKED_UP = (  # beside the whole EEPROM and the indirect addresses
    "velocity_i_gain", "velocity_p_gain", "position_d_gain", "position_i_gain", "position_p_gain",
    "feedforward_2nd_gain", "feedforward_1st_gain", "profile_acceleration", "profile_velocity",
)  # fmt: skip
_RAM_RESTORE = 2  # bit of the startup configuration
_SAFE_RESET_FIRMWARE = 42  # from which a factory reset of everything to everybody is not executed
_KEPT = {Reset.ALL: (), Reset.EXCEPT_ID: ("id",), Reset.EXCEPT_ID_AND_BAUD: ("id", "baud_rate")}
_FOR_SHADOWS = (
    InstructionCode.WRITE, InstructionCode.REG_WRITE, InstructionCode.ACTION, InstructionCode.REBOOT,
    InstructionCode.CLEAR,
)  # fmt: skip
LAST_SHADOW = 252  # above it the secondary ID is none
PROTOCOL_1 = 1  # value of the register


class VirtualDevice(Registers):
    """Instructions common to servos and boards. Times are the rig's, in nanoseconds."""

    BOOT_NS = 300_000_000

    def __init__(self, table: ControlTable, eeprom: dict[str, int]) -> None:
        """`eeprom` holds what differs from the factory's values. Raises KeyError for a register that is not there."""
        super().__init__(table)
        self._registered: tuple[int, bytes] | None = None
        self._backup: dict[str, int] | None = None
        self.powered = True
        self.dead = False
        self._silent_until = 0
        self.load(lambda item: True)
        for name, value in eeprom.items():
            self.put(name, value)

    @property
    def id(self) -> int:
        return self.memory[7]  # as in every model, like the two below

    @property
    def baud(self) -> int:
        """Bits per second that the device listens at."""
        return self.table.bauds[min(self.memory[8], len(self.table.bauds) - 1)]

    @property
    def return_delay_ns(self) -> int:
        return self.memory[9] * 2000

    @property
    def old_protocol(self) -> bool:
        """Whether it speaks protocol 1.0 and hears no packet of 2.0."""
        return self.memory[13] == PROTOCOL_1 and "protocol_type" in self.table

    def answers_to(self, id: int) -> bool:
        return id == self.memory[7]

    def shadow(self, id: int) -> bool:
        """Whether the device obeys this ID too, without answering."""
        return "secondary_id" in self.table and id == self.get("secondary_id") and id <= LAST_SHADOW and id != self.id

    @property
    def _level(self) -> int:
        return self.get("status_return_level") if "status_return_level" in self._places else 2

    @property
    def talkative(self) -> bool:
        """Whether it answers every instruction that is sent to it alone."""
        return self._level == 2

    def fast(self) -> bool:
        """Whether the firmware is of those that know the fast reads, and with them backup and startup configuration
        where the model has them."""
        oldest = self.table.fast_firmware
        return oldest is not None and self.get("firmware_version") >= oldest

    def online(self, now_ns: int) -> bool:
        """Whether the device has power, lives and has booted."""
        return self.powered and not self.dead and now_ns >= self._silent_until

    # What a kind of device adds

    def refresh(self, now_ns: int) -> None:
        """Bring the registers that measure something up to date."""

    def allowed(self, item: Item, value: int) -> StatusError:
        """Whether a write of `value` is accepted in the present state."""
        return StatusError.NONE

    def changed(self, item: Item, value: int, now_ns: int) -> None:
        """A write to `item` was accepted and is in memory."""

    def alert(self) -> bool:
        return False

    def clear(self, now_ns: int) -> StatusError:
        return StatusError.INSTRUCTION

    def heard(self, now_ns: int) -> None:
        """An intact instruction packet went by, for whomever."""

    def restarted(self, now_ns: int) -> None:
        """RAM was just lost."""

    # Instructions

    def execute(self, instruction: int, params: bytes, now_ns: int, *, to: int | None = None) -> Status | None:
        """Execute an instruction that was sent `to` the device's own ID, if to no other; the reply, if the status level
        wants one. It carries the ID that was asked, whatever the instruction made of it."""
        id, level = self.id, self._level
        error, data = self._execute(instruction, params, now_ns, id if to is None else to)
        if instruction == InstructionCode.PING:
            wanted = 0
        elif instruction == InstructionCode.READ:
            wanted = 1
        else:
            wanted = 2
        return self.status(error, data)._replace(id=id) if level >= wanted else None

    def execute_as_shadow(self, instruction: int, params: bytes, now_ns: int) -> None:
        """Execute what was sent to the secondary ID: nobody answers, and EEPROM cannot be written that way."""
        if instruction in (InstructionCode.WRITE, InstructionCode.REG_WRITE):
            self.write_as_shadow(int.from_bytes(params[:2], "little"), params[2:], now_ns, instruction)
        elif instruction in _FOR_SHADOWS:
            self._execute(instruction, params, now_ns, self.id)

    def write_as_shadow(self, address: int, data: bytes, now_ns: int, instruction: int = InstructionCode.WRITE) -> None:
        writes = self.resolve(address, data)
        if not isinstance(writes, StatusError) and not any(item.eeprom for item, _ in writes):
            self._execute(instruction, struct.pack("<H", address) + data, now_ns, self.id)

    def sample(self, address: int, length: int, now_ns: int) -> Status | None:
        """The answer to a read within a group, if the status level wants one."""
        if not self._level:
            return None
        return self.status(*self.read(address, length, now_ns))

    def status(self, error: int, data: bytes = b"") -> Status:
        return Status(self.id, int(error), self.alert(), data)

    def _execute(self, instruction: int, params: bytes, now_ns: int, to: int) -> tuple[StatusError, bytes]:
        word = int.from_bytes(params[:2], "little")
        if instruction == InstructionCode.PING:
            return StatusError.NONE, struct.pack("<HB", self.get("model_number"), self.get("firmware_version"))
        if instruction == InstructionCode.READ:
            if len(params) != 4:
                return StatusError.DATA_LENGTH, b""
            return self.read(word, int.from_bytes(params[2:4], "little"), now_ns)
        if instruction in (InstructionCode.WRITE, InstructionCode.REG_WRITE):
            if len(params) < 3:
                return StatusError.DATA_LENGTH, b""
            if instruction == InstructionCode.WRITE:
                return self.write(word, params[2:], now_ns), b""
            error = self._check(self.resolve(word, params[2:]))
            if error is StatusError.NONE:
                self._registered = word, params[2:]
                self._mark_registered()
            return error, b""
        if instruction == InstructionCode.ACTION:
            return self._action(now_ns), b""
        if instruction == InstructionCode.REBOOT:
            self.reboot(now_ns)
            return StatusError.NONE, b""
        if instruction == InstructionCode.FACTORY_RESET:
            return self._factory_reset(params, now_ns, to), b""
        if instruction == InstructionCode.CLEAR:
            if params != CLEAR_REVOLUTIONS:
                return StatusError.DATA_RANGE, b""
            return self.clear(now_ns), b""
        if instruction == BACKUP:
            return self._back_up(params, now_ns), b""
        return StatusError.INSTRUCTION, b""

    def read(self, address: int, length: int, now_ns: int) -> tuple[StatusError, bytes]:
        """Bytes of the table from a register on."""
        if length == 0:
            return StatusError.DATA_RANGE, b""
        self.refresh(now_ns)
        data = self.peek(address, length)
        return (StatusError.ACCESS, b"") if data is None else (StatusError.NONE, data)

    def write(self, address: int, data: bytes, now_ns: int) -> StatusError:
        """Write registers, all or none."""
        writes = self.resolve(address, data)
        error = self._check(writes)
        if error is StatusError.NONE:
            assert not isinstance(writes, StatusError)
            for item, value in writes:
                self.memory[item.address : item.end] = item.encode(value)
                self.changed(item, value, now_ns)
        return error

    def _check(self, writes: list[tuple[Item, int]] | StatusError) -> StatusError:
        if isinstance(writes, StatusError):
            return writes
        for item, value in writes:
            if not item.writable:
                return StatusError.ACCESS
            error = self.allowed(item, value)
            if error is not StatusError.NONE:
                return error
        return StatusError.NONE

    def _action(self, now_ns: int) -> StatusError:
        if self._registered is None:
            return StatusError.INSTRUCTION
        (address, data), self._registered = self._registered, None
        self._mark_registered()
        return self.write(address, data, now_ns)

    def _mark_registered(self) -> None:
        if "registered_instruction" in self.table:
            self.put("registered_instruction", int(self._registered is not None))

    def _factory_reset(self, params: bytes, now_ns: int, to: int) -> StatusError:
        if len(params) != 1 or params[0] not in _KEPT:
            return StatusError.DATA_RANGE
        spared = Reset(params[0])
        careless = self.table.modes and self.get("firmware_version") < _SAFE_RESET_FIRMWARE  # servos of old
        if spared is Reset.ALL and to == BROADCAST and not careless:
            return StatusError.NONE  # or every servo of a robot would have ID 1
        values = {name: self.get(name) for name in ("firmware_version", "model_number", *_KEPT[spared])}
        self.load(lambda item: True)
        for name, value in values.items():
            self.put(name, value)
        self.reboot(now_ns)
        return StatusError.NONE

    def _back_up(self, params: bytes, now_ns: int) -> StatusError:
        """Store what can be backed up, or restore the EEPROM from it and reboot."""
        if not (self.fast() and "backup_ready" in self.table):
            return StatusError.INSTRUCTION
        if params not in (_STORE, _RESTORE):
            return StatusError.DATA_RANGE
        if self.get("torque_enable") or (params == _RESTORE and self._backup is None):
            return StatusError.RESULT
        if params == _STORE:
            items = self.table.items.values()
            kept = [i.name for i in items if i.eeprom or i.name in _BACKED_UP or i.name.startswith("indirect_address")]
            self._backup = {name: self.get(name) for name in kept}
            self.put("backup_ready", 1)
        else:
            self._restore(eeprom=True)
            self.reboot(now_ns)
        return StatusError.NONE

    def _restore(self, *, eeprom: bool) -> None:
        for name, value in (self._backup or {}).items():
            if self.table.item(name).eeprom is eeprom:
                self.put(name, value)

    def reboot(self, now_ns: int) -> None:
        """Lose RAM and be silent while starting."""
        self._silent_until = now_ns + self.BOOT_NS
        self._lose_ram(now_ns)

    def power(self, on: bool, now_ns: int) -> None:
        """Switch the supply; RAM is lost with it."""
        if on and not self.powered:
            self._silent_until = now_ns + self.BOOT_NS
        if on is not self.powered:
            self.powered = on
            self._lose_ram(now_ns)

    def _lose_ram(self, now_ns: int) -> None:
        self.load(lambda item: not item.eeprom)
        self._registered = None
        if self._backup is not None:
            self.put("backup_ready", 1)
            if self.startup & _RAM_RESTORE:
                self._restore(eeprom=False)
        self.restarted(now_ns)

    @property
    def startup(self) -> int:
        """The startup configuration, as far as the firmware knows one."""
        return self.get("startup_configuration") if "startup_configuration" in self.table and self.fast() else 0
