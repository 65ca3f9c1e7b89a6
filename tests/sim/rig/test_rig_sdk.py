"""The official SDK as a client, over a real serial port: what it reads and writes agrees with the control table."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from rig_host import BOARD, XM430
from waiting import until

from servoid.sim.rig.process.control import RigProcess

sdk = pytest.importorskip("dynamixel_sdk")
OK = sdk.COMM_SUCCESS
PATIENCE = 300  # ms: the SDK's share of a busy machine, not a matter of the bus


class Client:
    """An SDK port and packet handler on a rig with power."""

    def __init__(self, rig: RigProcess) -> None:
        self.rig = rig
        self.ids = [joint.id for joint in rig.robot.joints]
        self.port = sdk.PortHandler(rig.port)
        self.packet = sdk.PacketHandler(2.0)
        assert self.port.openPort()
        assert self.port.setBaudRate(rig.robot.bus.baud)
        assert self.packet.write1ByteTxRx(self.port, BOARD, 24, 1) == (OK, 0)
        self.boot()

    def boot(self) -> None:
        """Wait until every servo has started."""
        until(lambda: all(servo["online"] for servo in self.rig.control.servos()))

    def read(self, id: int, register: str) -> int:
        item = XM430.item(register)
        data, result, error = self.packet.readTxRx(self.port, id, item.address, item.width)
        assert (result, error) == (OK, 0), f"{register}: {self.packet.getTxRxResult(result)}, error {error}"
        return item.decode(bytes(data))

    def write(self, id: int, register: str, value: int) -> None:
        item = XM430.item(register)
        answer = self.packet.writeTxRx(self.port, id, item.address, item.width, list(item.encode(value)))
        assert answer == (OK, 0), register


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    sdk.port_handler.LATENCY_TIMER = PATIENCE
    with RigProcess(clock="real", linger=5.0) as rig:
        client = Client(rig)
        yield client
        client.port.closePort()


def test_ping_and_broadcast_ping(client: Client) -> None:
    assert client.packet.ping(client.port, 1) == (1020, OK, 0)
    found, result = client.packet.broadcastPing(client.port)
    assert result == OK
    assert {id: model for id, (model, _) in found.items()} == {**dict.fromkeys(client.ids, 1020), BOARD: 29696}


def test_every_ram_register_is_read_and_written(client: Client) -> None:
    for item in XM430.items.values():
        if item.eeprom or item.name.startswith("indirect"):
            continue
        value = client.read(3, item.name)
        if item.default is not None and item.writable:
            assert value == item.default, item.name
        if item.writable and item.name not in ("torque_enable", "status_return_level", "goal_position"):
            wanted = (item.range or (0, 100))[1] // 2
            client.write(3, item.name, wanted)
            assert client.read(3, item.name) == wanted, item.name
    client.write(3, "bus_watchdog", 0)


@pytest.mark.parametrize("fast", [False, True])
def test_group_reads_agree_with_single_ones(client: Client, fast: bool) -> None:
    sync = sdk.GroupSyncRead(client.port, client.packet, 0, 10)
    bulk = sdk.GroupBulkRead(client.port, client.packet)
    for id in client.ids:
        assert sync.addParam(id)
        # Lengths that are no ID in use: the SDK looks for the ID in its parameters and may find a length instead.
        assert bulk.addParam(id, *((0, 24) if id % 2 else (126, 21)))
    assert (sync.fastSyncRead() if fast else sync.txRxPacket()) == OK
    assert (bulk.fastBulkRead() if fast else bulk.txRxPacket()) == OK
    for id in client.ids:
        assert sync.getData(id, 0, 2) == 1020
        assert sync.getData(id, 7, 1) == id
        if id % 2:
            assert bulk.getData(id, 7, 1) == id
        else:
            assert bulk.getData(id, 132, 4) == client.read(id, "present_position")


def test_a_goal_in_bytes_moves_the_joint_in_the_physics(client: Client) -> None:
    """r_sho_pitch: sync write of goals by the SDK, seen in the truth."""
    truth = client.rig.truth()
    joint = [j.name for j in client.rig.robot.joints].index("r_sho_pitch")
    before = float(truth.fetch().joints[0, joint])
    start = client.read(1, "present_position")
    client.rig.control.accepted()
    client.write(1, "goal_position", start)
    client.write(1, "torque_enable", 1)
    group = sdk.GroupSyncWrite(client.port, client.packet, 116, 4)
    assert group.addParam(1, list((start + 300).to_bytes(4, "little")))
    assert group.txPacket() == OK
    goal = before + 300 * XM430.item("goal_position").scale
    until(lambda: abs(float(truth.fetch().joints[0, joint]) - goal) < 0.03)
    goals = [entry for entry in client.rig.control.accepted() if entry["register"] == "goal_position"]
    assert [entry["value"] for entry in goals] == [start, start + 300]
    assert goals[1]["position"] == pytest.approx(before + 0.46, abs=0.02)
    client.write(1, "torque_enable", 0)


def test_reboot(client: Client) -> None:
    client.write(2, "led", 1)
    assert client.packet.reboot(client.port, 2) == (OK, 0)
    client.boot()
    assert client.read(2, "led") == 0


def test_a_baud_change_is_followed_by_changing_the_port(client: Client) -> None:
    client.write(4, "baud_rate", 3)
    assert client.packet.ping(client.port, 4)[1] != OK
    assert client.port.setBaudRate(1_000_000)
    assert client.packet.ping(client.port, 4) == (1020, OK, 0)
    client.write(4, "baud_rate", 4)
    assert client.port.setBaudRate(2_000_000)
    assert client.packet.ping(client.port, 4) == (1020, OK, 0)
