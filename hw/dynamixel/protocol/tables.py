"""Control tables of Dynamixel models, loaded from `configs/dynamixel/`.

A register that a model lacks is not in its table: what cannot be measured is left invalid, never read as zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any

from servoid.hw.config import CONFIGS, ConfigError, load_marked, nearest

WIDTHS = (1, 2, 4)


@dataclass(frozen=True, slots=True)
class Item:
    """A register. `range` is what a write accepts, raw; `limits` names the registers that hold the range instead.

    A physical value is raw times `scale`, in `unit`; both are trivial for registers that count nothing.
    """

    name: str
    address: int
    width: int  # bytes
    signed: bool
    eeprom: bool  # written with torque off only, and kept over a power cycle
    writable: bool
    unit: str
    scale: float
    range: tuple[int, int] | None
    limits: tuple[str, str] | None  # lower, upper; a leading "-" negates
    default: int | None  # factory value

    @property
    def end(self) -> int:
        """First address after the register."""
        return self.address + self.width

    def encode(self, value: int) -> bytes:
        """Little-endian, two's complement where signed. Raises ValueError naming the register if it does not fit."""
        try:
            return int(value).to_bytes(self.width, "little", signed=self.signed)
        except OverflowError:
            raise ValueError(f"{self.name}: {value} does not fit {self.width} bytes") from None

    def decode(self, data: bytes) -> int:
        """Value of the `width` bytes of the register."""
        return int.from_bytes(data[: self.width], "little", signed=self.signed)


@dataclass(frozen=True, slots=True)
class Indirect:
    """A block of `count` indirect addresses from `address` (2 bytes each) and their data from `data` (1 byte each)."""

    address: int
    data: int
    count: int


@dataclass(frozen=True)
class ControlTable:
    """The registers of a model. Index it by name, or ask `item(name)` for an error with the nearest name."""

    name: str
    number: int
    ram: int  # first address of the RAM area
    modes: tuple[int, ...]  # operating modes
    motor_current: bool  # present_current is that of the motor, so that torque follows from it
    fast_firmware: int | None  # oldest firmware with fast sync read
    indirect: tuple[Indirect, ...]
    items: Mapping[str, Item]
    bauds: tuple[int, ...]  # bit/s by the value of baud_rate

    def __contains__(self, name: object) -> bool:
        return name in self.items

    def item(self, name: str) -> Item:
        """Raises KeyError with the nearest name when the model has no such register."""
        try:
            return self.items[name]
        except KeyError:
            raise KeyError(f"{self.name} has no register '{name}'; {nearest(name, self.items)}") from None

    def at(self, address: int) -> Item | None:
        """The register that begins at `address`."""
        return next((item for item in self.items.values() if item.address == address), None)

    @property
    def size(self) -> int:
        """First address after the last register."""
        return max(item.end for item in self.items.values())


@dataclass(frozen=True)
class _Unit:
    name: str
    scale: float


@dataclass(frozen=True)
class _Register:
    name: str
    address: int
    width: int = 1
    signed: bool = False
    unit: str | None = None
    writable: bool = False
    range: tuple[int, int] | None = None
    limits: tuple[str, str] | None = None
    default: int | None = None

    def __post_init__(self) -> None:
        if self.width not in WIDTHS:
            raise ValueError(f"register {self.name}: a width is one of {WIDTHS} bytes, not {self.width}")


@dataclass(frozen=True)
class _Group:
    ram: int
    registers: tuple[_Register, ...]


@dataclass(frozen=True)
class _Registers:
    bauds: tuple[int, ...]
    units: dict[str, _Unit]
    groups: dict[str, _Group]


@dataclass(frozen=True)
class _Earlier:
    before: int
    indirect: tuple[Indirect, ...]


@dataclass(frozen=True)
class _Family:
    groups: tuple[str, ...]
    modes: tuple[int, ...]
    motor_current: bool
    indirect: tuple[Indirect, ...]
    fast_firmware: int | None = None
    earlier: _Earlier | None = None


@dataclass(frozen=True)
class _Model:
    number: int
    family: str
    defaults: dict[str, int] = field(default_factory=dict)
    ranges: dict[str, tuple[int, int]] = field(default_factory=dict)
    scales: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Models:
    families: dict[str, _Family]
    models: dict[str, _Model]


@cache
def _data() -> tuple[_Registers, _Models]:
    folder = CONFIGS / "dynamixel"
    registers, marks = load_marked(folder / "registers.yaml", _Registers)
    for name, group in registers.groups.items():
        for i, register in enumerate(group.registers):
            if register.unit is not None and register.unit not in registers.units:
                key = f"groups.{name}.registers[{i}].unit"
                raise marks.error(key, f"unknown unit '{register.unit}'; {nearest(register.unit, registers.units)}")
    models, marks = load_marked(folder / "models.yaml", _Models)
    for name, family in models.families.items():
        for group_name in family.groups:
            if group_name not in registers.groups:
                hint = nearest(group_name, registers.groups)
                raise marks.error(f"families.{name}.groups", f"unknown group '{group_name}'; {hint}")
    for name, model in models.models.items():
        if model.family not in models.families:
            hint = nearest(model.family, models.families)
            raise marks.error(f"models.{name}.family", f"unknown family '{model.family}'; {hint}")
        for unit in model.scales:
            if unit not in registers.units:
                raise marks.error(f"models.{name}.scales.{unit}", f"unknown unit; {nearest(unit, registers.units)}")
        known = {r.name for g in models.families[model.family].groups for r in registers.groups[g].registers}
        for kind, names in (("defaults", model.defaults), ("ranges", model.ranges)):
            for register_name in names:
                if register_name not in known:
                    key = f"models.{name}.{kind}.{register_name}"
                    raise marks.error(key, f"the model has no such register; {nearest(register_name, known)}")
    return registers, models


def models() -> dict[str, int]:
    """Model number of every known model, the board included."""
    return {name: model.number for name, model in _data()[1].models.items()}


@cache
def table(model: int | str, firmware: int | None = None) -> ControlTable:
    """The control table of a model by number or name; of the newest known firmware, or of the given one.

    Raises ConfigError for a model that is not known, naming the nearest or all.
    """
    registers, known = _data()
    if isinstance(model, int):
        named = [name for name, entry in known.models.items() if entry.number == model]
        if not named:
            raise ConfigError(f"unknown Dynamixel model number {model}; known: {_numbers(known)}")
        name = named[0]
    else:
        name = model
        if name not in known.models:
            raise ConfigError(f"unknown Dynamixel model '{name}': {nearest(name, known.models)}")
    entry = known.models[name]
    family = known.families[entry.family]
    indirect = family.indirect
    if family.earlier is not None and firmware is not None and firmware < family.earlier.before:
        indirect = family.earlier.indirect
    ram = registers.groups[family.groups[0]].ram
    items = [
        _item(register, entry, registers, ram)
        for group in family.groups
        for register in registers.groups[group].registers
    ]
    items += _indirect_items(indirect)
    items.sort(key=lambda item: item.address)
    return ControlTable(
        name=name,
        number=entry.number,
        ram=ram,
        modes=family.modes,
        motor_current=family.motor_current,
        fast_firmware=family.fast_firmware,
        indirect=indirect,
        items=MappingProxyType({item.name: item for item in items}),
        bauds=registers.bauds,
    )


def _item(register: _Register, model: _Model, registers: _Registers, ram: int) -> Item:
    unit = registers.units[register.unit] if register.unit else _Unit("", 1.0)
    default = register.default if register.name != "model_number" else model.number
    return Item(
        name=register.name,
        address=register.address,
        width=register.width,
        signed=register.signed,
        eeprom=register.address < ram,
        writable=register.writable,
        unit=unit.name,
        scale=model.scales.get(register.unit or "", unit.scale),
        range=model.ranges.get(register.name, register.range),
        limits=register.limits,
        default=model.defaults.get(register.name, default),
    )


def _indirect_items(blocks: tuple[Indirect, ...]) -> list[Item]:
    items: list[Item] = []
    number = 1
    common: dict[str, Any] = {
        "signed": False,
        "eeprom": False,
        "writable": True,
        "unit": "",
        "scale": 1.0,
        "limits": None,
    }
    last = max((block.data + block.count - 1 for block in blocks), default=0)  # of the RAM, which they may point to
    for block in blocks:
        for i in range(block.count):
            address, data = block.address + 2 * i, block.data + i
            items.append(Item(f"indirect_address_{number}", address, 2, range=(64, last), default=data, **common))
            items.append(Item(f"indirect_data_{number}", data, 1, range=(0, 255), default=0, **common))
            number += 1
    return items


def _numbers(known: _Models) -> str:
    return ", ".join(f"{name} {model.number}" for name, model in known.models.items())
