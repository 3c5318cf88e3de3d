from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import count

import pytest

from benchmarks.stand_in.process import ControllerProcess
from see2act.robot.real.station import RobotSection, Station, VacuumOutput
from see2act.robot.real.ur import UrArm

WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) + 1
_addresses = count(1)


@pytest.fixture
def address() -> str:
    """A loopback address that no other test uses: a controller's ports are fixed."""
    k = next(_addresses)
    return f"127.{WORKER}.{k // 250}.{k % 250 + 1}"


@pytest.fixture(scope="session")
def process() -> Iterator[ControllerProcess]:
    process = ControllerProcess()
    yield process
    process.close()


@pytest.fixture
def controller(address: str, process: ControllerProcess) -> ControllerProcess:
    process.serve(address)
    return process


@pytest.fixture
def station(address: str) -> Station:
    """A cup over a bin of 36 cm by 36 cm, whose floor is 5 cm above the robot's foot."""
    return Station(
        robot=RobotSection(
            host=address, home=(0.0, -1.57, 1.57, -1.57, -1.57, 0.0), drop=(0.8, -1.57, 1.57, -1.57, -1.57, 0.0)
        ),
        tool=VacuumOutput(tip=0.14, mass=0.5, depth=0.004, analog=0),
        bin=((-0.3, -0.29, 0.05), (-0.3, 0.07, 0.05), (-0.66, -0.29, 0.05)),
    )


@pytest.fixture
def arm(controller: ControllerProcess, station: Station) -> Iterator[UrArm]:
    arm = UrArm(station)
    arm.connect()
    yield arm
    arm.close()


@pytest.fixture
def when() -> Callable[..., None]:
    """Does something a moment later, in another thread."""
    import threading

    def later(seconds: float, what: Callable[..., object], *arguments: object, **named: object) -> None:
        timer = threading.Timer(seconds, what, arguments, named)
        timer.daemon = True
        timer.start()

    return later
