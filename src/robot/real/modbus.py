"""The connection to an OnRobot Compute Box: Modbus TCP. The box serves one client at a time."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

from see2act.robot.real import station
from see2act.robot.real.tools import ToolError

if TYPE_CHECKING:
    from pymodbus.client import ModbusTcpClient
    from pymodbus.pdu import ModbusPDU

TIMEOUT, RETRIES = 1.0, 1
"""Seconds until an answer must be there, and how often a question is asked again. Asking twice does no harm: a gripper that
moves ignores commands."""


class Link:
    """Modbus TCP to a Compute Box. Once it is lost it stays lost until :meth:`connect`: never a move after a silent gap.

    Args:
        kind: Of the tool, for messages.
        section: With the address.
    """

    def __init__(self, kind: str, section: station.ComputeBoxSection):
        self.name = f"the {kind} at {section.host}:{section.port}, unit {section.unit}"
        self._host, self._port, self._unit = section.host, section.port, section.unit
        self._client: ModbusTcpClient | None = None

    def connect(self) -> None:
        """Connect.

        Raises:
            ToolError: Nothing listens there, or pymodbus is not installed.
        """
        try:
            from pymodbus.client import ModbusTcpClient
        except ImportError:
            raise ToolError(f"{self.name} needs the package pymodbus: pip install 'see2act[real]'") from None
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # it would print what our errors say
        self.close()
        client = ModbusTcpClient(self._host, port=self._port, timeout=TIMEOUT, retries=RETRIES)
        if not client.connect():
            raise ToolError(
                f"nothing listens where {self.name} should be: look at the power and network cable of the Compute Box, and at "
                "tool.host and tool.port in the station"
            )
        self._client = client

    def close(self) -> None:
        """Disconnect. Safe to call twice."""
        if self._client is not None:
            self._client.close()
        self._client = None

    def read(self, address: int, count: int) -> list[int]:
        """Registers, 16 bits each.

        Raises:
            ToolError: The tool does not answer, or has no such registers.
        """
        return list(
            self._ask(lambda client: client.read_holding_registers(address, count=count, device_id=self._unit)).registers
        )

    def write(self, address: int, values: list[int]) -> None:
        """Write registers, all in one message.

        Raises:
            ToolError: The tool does not answer, or refuses.
        """
        self._ask(lambda client: client.write_registers(address, values, device_id=self._unit))

    def _ask(self, question: Callable[[ModbusTcpClient], ModbusPDU]) -> ModbusPDU:
        from pymodbus.exceptions import ModbusException

        if self._client is None:
            raise ToolError(f"{self.name} is not connected: start again")
        try:
            answer = question(self._client)
        except (ModbusException, OSError):
            self.close()
            raise ToolError(
                f"{self.name} does not answer: look at its power, at the cables of the Compute Box, at tool.unit in the "
                "station, and whether another program is connected to the box; then start again"
            ) from None
        if answer.isError():
            raise ToolError(
                f"{self.name} refuses a message (Modbus exception {answer.exception_code}): look whether another tool is there"
            )
        return answer
