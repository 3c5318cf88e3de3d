"""Real physics of the two tools, one object at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from see2act.robot.gripper import DRIVER, FOLLOWERS, PADS
from see2act.robot.simulated import SimulatedRobot, _Contact
from see2act.robot.simulation import TIMESTEP
from see2act.robot.types import Outcome, Pick


@pytest.fixture(scope="module")
def gripper(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    return make_robot("primitive=grasp")


@pytest.fixture(scope="module")
def suction(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    return make_robot("primitive=suction")


def _place(robot: SimulatedRobot, name: str, at: tuple[float, float, float], scale: float = 1.0, turn: float = 0.0) -> int:
    """An object alone in the bin, turned about the vertical by ``turn`` radians; its body id."""
    robot._build()
    robot._noise = np.random.default_rng(0)
    robot.scene._add(name, scale, at, np.array([0, 0, np.sin(turn / 2), np.cos(turn / 2)]), (1.0, 0.2, 0.2))
    assert robot.scene.settle(480)
    return robot.scene.bodies[0].id


def _pick(robot: SimulatedRobot, x: float, y: float, angle: float = 0.0) -> Outcome:
    heightmap = robot.truth().heightmap
    row, col = robot.workspace.to_pixel(np.array(x), np.array(y))
    return robot.execute(robot.workspace.pick(heightmap, int(row), int(col), angle))


def test_fingers_follow_the_driver_and_open_as_the_formula_says(gripper: SimulatedRobot) -> None:
    gripper._build()
    arm, client = gripper.arm, gripper.simulation.client
    gripper.tool.engage()
    gripper.tool.release()
    arm.wait(40)  # half open, moving
    driver = client.getJointState(arm.body, arm.joint_index[DRIVER])[0]
    for name, sign in FOLLOWERS.items():
        assert client.getJointState(arm.body, arm.joint_index[name])[0] == pytest.approx(sign * driver, abs=0.01)
    pads = [np.array(client.getLinkState(arm.body, arm.link_index[pad], computeForwardKinematics=1)[4]) for pad in PADS]
    assert np.linalg.norm(pads[0] - pads[1]) - 0.00635 == pytest.approx(gripper.tool.opening(driver), abs=0.002)


@pytest.mark.parametrize("k", [0, 5, 11])
def test_grasp_across_a_turned_brick_holds(gripper: SimulatedRobot, k: int) -> None:
    """The jaws close across the brick's short side only at the right angle: a wrong sign of rotation fails."""
    angle = k * np.pi / 16
    _place(gripper, "brick", (0.05, -0.04, 0.03), scale=1.2, turn=angle + np.pi / 2)
    outcome = _pick(gripper, 0.05, -0.04, angle)
    assert (outcome.success, outcome.truth, outcome.cause) == (True, True, "ok")
    assert outcome.reading == pytest.approx(0.045 * 1.2, abs=0.006)
    assert gripper.bin_empty()


def test_grasp_along_a_long_brick_fails(gripper: SimulatedRobot) -> None:
    _place(gripper, "brick", (0.0, 0.0, 0.03), scale=1.2, turn=0.0)
    outcome = _pick(gripper, 0.0, 0.0, 0.0)
    assert (outcome.success, outcome.truth) == (False, False)
    assert not gripper.bin_empty()


def test_grasp_of_thin_air_is_a_miss(gripper: SimulatedRobot) -> None:
    _place(gripper, "cube", (-0.08, 0.08, 0.03))
    outcome = _pick(gripper, 0.08, -0.08, 0.0)
    assert (outcome.success, outcome.truth, outcome.cause) == (False, False, "missed")


def test_jaws_on_the_wall_stop_there(gripper: SimulatedRobot) -> None:
    _place(gripper, "cube", (-0.08, 0.08, 0.03))
    outcome = _pick(gripper, 0.14, 0.0, 0.0)
    assert (outcome.success, outcome.truth, outcome.cause) == (False, False, "wall")


def test_suction_on_a_flat_top_holds(suction: SimulatedRobot) -> None:
    _place(suction, "cube", (0.03, 0.05, 0.03))
    outcome = _pick(suction, 0.03, 0.05)
    assert (outcome.success, outcome.truth, outcome.cause) == (True, True, "ok")
    assert outcome.reading > 50
    assert suction.bin_empty()


def test_no_seal_over_an_edge(suction: SimulatedRobot) -> None:
    _place(suction, "cube", (0.0, 0.0, 0.03))
    outcome = _pick(suction, 0.019, 0.0)
    assert (outcome.success, outcome.truth, outcome.cause) == (False, False, "no_seal")


def test_no_seal_on_a_steep_side(suction: SimulatedRobot) -> None:
    _place(suction, "arch", (0.0, 0.0, 0.03))
    body = suction.scene.bodies[0].id
    lying = suction.simulation.client.getQuaternionFromEuler((np.pi / 2, 0, 0))
    suction.simulation.client.resetBasePositionAndOrientation(body, (0, 0, 0.02), lying)
    suction.scene.settle(480)
    outcome = _pick(suction, 0.024, 0.0)
    assert not outcome.success
    assert not outcome.truth


def test_the_floor_cannot_be_lifted(suction: SimulatedRobot) -> None:
    """The cup seals on the flat floor as on any body; what it cannot do is lift it."""
    _place(suction, "cube", (-0.08, 0.08, 0.03))
    engage, sealed_on = suction.tool.engage, []
    suction.tool.engage = lambda: (engage(), sealed_on.append(suction.tool._sealed_body))
    outcome = _pick(suction, 0.08, -0.08)
    suction.tool.engage = engage
    assert sealed_on == [suction.scene.floor]
    assert (outcome.success, outcome.truth, outcome.cause) == (False, False, "missed")


@pytest.mark.parametrize(("kilograms", "held"), [(0.3, True), (4.0, False)])
def test_the_seal_holds_a_limited_force(suction: SimulatedRobot, kilograms: float, held: bool) -> None:
    """60 kPa on a cup of 18 mm are 15 N."""
    body = _place(suction, "cube", (0.0, 0.0, 0.03))
    suction.simulation.client.changeDynamics(body, -1, mass=kilograms)
    outcome = _pick(suction, 0.0, 0.0)
    assert (outcome.success, outcome.truth) == (held, held)
    assert outcome.cause == ("ok" if held else "slipped")


def test_the_seal_holds_a_limited_moment(suction: SimulatedRobot) -> None:
    """The same weight hangs from its middle and peels off at its end."""
    outcomes = []
    for x in (0.0, 0.026):
        body = _place(suction, "brick", (0.0, 0.0, 0.03))
        suction.simulation.client.changeDynamics(body, -1, mass=0.6)
        outcomes.append(_pick(suction, x, 0.0))
    assert [outcome.success for outcome in outcomes] == [True, False]
    assert [outcome.truth for outcome in outcomes] == [True, False]


def test_what_is_held_does_not_creep_out_of_the_fingers(gripper: SimulatedRobot) -> None:
    """Held off its centre and a little askew, a brick crept 2.5 mm where the solver stopped early."""
    body = _place(gripper, "brick", (0.05, -0.05, 0.035), scale=1.1, turn=np.pi / 2 + 0.15)
    path = []

    def look() -> None:
        if body in gripper.scene.positions():
            path.append(gripper.scene.positions()[body])

    gripper.simulation.after_step = look
    assert _pick(gripper, 0.05, -0.035).success
    gripper.simulation.after_step = None
    high = [at for at in path if at[2] > max(at[2] for at in path) - 0.004]
    assert len(high) > 40
    assert np.linalg.norm((high[-1] - high[0])[:2]) < 0.0005


def test_fingers_that_squeeze_something_are_soon_at_rest(make_robot: Callable[..., SimulatedRobot]) -> None:
    """They tremble as long as they squeeze: waiting for a speed of nought used all the time that closing is allowed."""
    robot = make_robot("primitive=grasp")
    _place(robot, "cube", (0.0, 0.0, 0.03))
    waits, wait = [], robot.arm.wait

    def counted(*args: object, **options: object) -> None:
        before = robot.simulation.steps
        wait(*args, **options)
        if robot.simulation.steps > before:  # without latency there is no wait for it
            waits.append(robot.simulation.steps - before)

    robot.arm.wait = counted
    assert _pick(robot, 0.0, 0.0).success
    assert waits[0] < 100, "of 180 that closing may take"
    assert len(waits) == 2, "after closing and holding, sensing has nothing to wait for"


@pytest.mark.parametrize("primitive", ["suction", "grasp"])
@pytest.mark.parametrize("x", [0.0, 0.08])  # on the cube; beside it
def test_fast_motion_ends_as_full_motion_does_and_counts_the_same_time(
    make_robot: Callable[..., SimulatedRobot], primitive: str, x: float
) -> None:
    outcomes = {}
    for motion in ("fast", "full"):
        robot = make_robot(f"primitive={primitive}", f"robot.motion={motion}")
        _place(robot, "cube", (0.0, 0.0, 0.03))
        home = robot.arm.tool_position()
        _pick(robot, -0.1, -0.1)  # the second pick: the fingers of the first are still open
        row, col = robot.workspace.to_pixel(np.array(x), np.array(0.0))
        pick = robot.workspace.pick(robot.truth().heightmap, int(row), int(col), 0.0)
        # In the middle: both fingers meet the cube at once, so that none pushes it about and they are at rest equally soon.
        outcomes[motion] = robot.execute(replace(pick, x=x, y=0.0))
        assert np.linalg.norm(robot.arm.tool_position() - home) < 1e-3
    fast, full = outcomes["fast"], outcomes["full"]
    assert (fast.success, fast.truth, fast.cause) == (full.success, full.truth, full.cause)
    assert fast.robot_seconds == pytest.approx(full.robot_seconds, abs=0.02)
    assert full.steps >= full.robot_seconds * 240 - 1
    assert fast.steps < 0.7 * full.steps


@pytest.mark.parametrize("gap", [0.0025, 0.006])
def test_a_cup_that_stops_short_of_the_surface_does_not_seal(suction: SimulatedRobot, gap: float) -> None:
    """When the sensed height is too high, the cup hangs in the air above the object."""
    _place(suction, "cube", (0.0, 0.0, 0.03))
    heightmap = suction.truth().heightmap
    pick = suction.workspace.pick(heightmap, 72, 72, 0.0)
    outcome = suction.execute(replace(pick, z=pick.z + suction.tool.press + gap))
    assert (outcome.success, outcome.truth) == (False, False)
    assert suction.execute(pick).success


def test_the_cup_s_holder_on_the_wall_stops_there(suction: SimulatedRobot) -> None:
    _place(suction, "cube", (-0.08, 0.08, 0.03))
    outcome = _pick(suction, 0.178, 0.0)
    assert (outcome.success, outcome.truth, outcome.cause) == (False, False, "wall")


def test_a_pick_out_of_reach_is_a_failed_attempt(suction: SimulatedRobot) -> None:
    """Also where only the lift would be out of reach."""
    _place(suction, "cube", (-0.08, 0.08, 0.03))
    for pick in (Pick(0, 0, 0.0, 2.0, 0.0, 0.0), Pick(0, 0, 0.0, 0.38, 0.0, 0.18)):
        outcome = suction.execute(pick)
        assert (outcome.success, outcome.cause, outcome.steps) == (False, "unreachable", 0)


@pytest.mark.parametrize("primitive", ["suction", "grasp"])
def test_the_descent_jumps_to_just_above_the_first_thing_under_the_tool(
    make_robot: Callable[..., SimulatedRobot], primitive: str
) -> None:
    robot = make_robot(f"primitive={primitive}")
    _place(robot, "cube", (0.0, 0.0, 0.03))
    jumped, enter = [], robot.arm.enter

    def watched(*args: object) -> np.ndarray:
        left = enter(*args)
        robot.simulation.client.performCollisionDetection()
        jumped.append(
            (robot.arm.tool_position()[2] - robot.tool.length(), robot.simulation.client.getContactPoints(robot.arm.body))
        )
        return left

    robot.arm.enter = watched
    _pick(robot, 0.0, 0.0)  # open jaws straddle the cube, and go on down to the floor
    _pick(robot, 0.0, 0.1)
    (on_cube, touched), (beside, nothing) = jumped
    assert not touched
    assert not nothing
    assert beside < 0.04
    if primitive == "suction":
        assert 0.045 < on_cube < 0.058


@pytest.mark.parametrize("seconds", [0.0, 0.05])
def test_a_descent_goes_on_for_the_latency_after_contact(make_robot: Callable[..., SimulatedRobot], seconds: float) -> None:
    robot = make_robot("primitive=grasp", f"robot.latency={seconds}", "robot.arm.tool_speed=0.1", "robot.motion=full")
    robot._build()
    robot.scene._block((0.06, 0.02, 0.03), (0.0, 0.0, 0.03), (1, 0, 0))  # both jaws meet it
    heights, over = [], []
    note = robot._note_contact

    def watch(contact: _Contact) -> float:
        force = note(contact)
        heights.append(robot.arm.commanded_position[2])
        over.append(force > robot.tool.contact_limit)
        return force

    robot._note_contact = watch  # type: ignore[method-assign]
    assert robot.execute(Pick(72, 72, 0.0, 0.0, 0.0, 0.0)).cause == "missed"  # it is no object
    first, last = over.index(True), len(over) - 2  # the very last look is after the fingers have closed
    assert last - first == round(seconds / TIMESTEP)
    assert heights[first] - heights[last] == pytest.approx(0.1 * seconds, abs=5e-4)


def test_the_tool_takes_hold_the_latency_after_its_command(make_robot: Callable[..., SimulatedRobot]) -> None:
    took = []
    for seconds in (0.0, 0.05):
        robot = make_robot("primitive=suction", f"robot.latency={seconds}")
        _place(robot, "cube", (0.0, 0.0, 0.03))
        outcome = _pick(robot, 0.0, 0.0)
        assert outcome.truth
        took.append(outcome.robot_seconds)
    assert took[1] - took[0] == pytest.approx(0.05, abs=1e-6)
