"""Set up a station with a real robot: its file, its places, its camera. Each command says what to do next.

Start with `python real.py new`. After it come check, board, teach, calibrate, touch and background.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate

from see2act.commands import user_errors_end_the_program
from see2act.errors import ConfigError
from see2act.experiment.config import composed
from see2act.files import writable
from see2act.robot.real import board as boards
from see2act.robot.real import station as stations
from see2act.robot.real.board import Board
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.operator import Terminal
from see2act.robot.real.setup import background, calibrate, check, new, teach, touch

ROUTES = ("clearance", "joint_speed", "tool_speed", "descent_speed")


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    typed = sys.argv[1:] if arguments is None else list(arguments)
    overview = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="%(prog)s COMMAND ...",
        epilog="\n".join(["commands:", *(f"  {name:12}{purpose}" for name, (_, purpose) in COMMANDS.items())]),
    )
    overview.add_argument("command", choices=COMMANDS, help=argparse.SUPPRESS)
    name = overview.parse_args(typed[:1]).command
    args = _parser(name, f"{overview.prog} {name}").parse_intermixed_args(typed[1:])
    with user_errors_end_the_program():
        COMMANDS[name][0](args)


def _new(args: argparse.Namespace) -> None:
    if not writable(args.station.parent):
        raise ConfigError(f"--station {args.station} cannot be written: choose a folder that you may write to")
    new.new(args.station, args.host, args.tool, args.tip, args.tool_host, args.mass)
    print(
        f"{args.station} is written: read it, and put right what is different at your station. Then type `python real.py check`"
    )


def _check(args: argparse.Namespace) -> None:
    cfg = _config(args)
    verdicts = []
    for verdict in check.check(args.station, stations.load(args.station), _camera(cfg), _routes(cfg)):
        verdicts.append(verdict)
        if not args.json:
            print(f"{verdict.verdict:7} {verdict.part:22} {verdict.text}", flush=True)
    if args.json:
        print(json.dumps([asdict(verdict) for verdict in verdicts], indent=2))
    if any(verdict.verdict == "FAILED" for verdict in verdicts):
        sys.exit(1)


def _board(args: argparse.Namespace) -> None:
    if not writable(args.out.parent):
        raise ConfigError(f"--out {args.out} cannot be written: choose a folder that you may write to")
    boards.pdf(_of(args), args.out)
    print(f"{args.out}: print it at 100 %, and measure the ruler on it")


def _teach(args: argparse.Namespace) -> None:
    places = args.places.split(",")
    if unknown := [place for place in places if place not in teach.PLACES]:
        raise ConfigError(f"--places {unknown[0]} is unknown: choose of {','.join(teach.PLACES)}")
    station = teach.teach(args.station, stations.load(args.station), Terminal(), places)
    width, length = station.bin_size()
    print(f"the bin is {1000 * width:.0f} mm deep, seen from the robot, and {1000 * length:.0f} mm wide")


def _calibrate(args: argparse.Namespace) -> None:
    station = stations.load(args.station)
    if args.views:
        recording = calibrate.Recording.load(args.views)
    else:
        centre = np.array(args.centre or (0.0, 0.0, station.tool.tip))
        camera = _camera(_config(args))
        recording = calibrate.record(args.station, station, camera, _of(args), centre, Terminal(), _say)
    station, found = calibrate.use(args.station, station, recording)
    for index, reason in found.dropped.items():
        print(f"view {index + 1} was not used: {reason}")
    print(
        f"{found.views} views, whose corners are {found.pixel_rms:.2f} pixels off\n"
        f"depth: times {found.depth_scale:.4f}, plus {1000 * found.depth_offset:.1f} mm\n"
        f"squares: {1000 * found.square:.2f} mm by the arm's motions, {1000 * recording.board.square:.2f} stated\n"
        f"predicted error of a point in the bin: {1000 * found.error:.2f} mm, {found.verdict}\n"
        "Then type `python real.py touch`"
    )


def _touch(args: argparse.Namespace) -> None:
    cfg = _config(args)
    arguments = args.station, stations.load(args.station), _camera(cfg), _of(args), Terminal(), _routes(cfg)
    station = touch.touch(*arguments, contact_limit=cfg.robot.contact_limit)
    assert station.touch is not None
    off = f"the largest offset is {1000 * station.touch.offset:.1f} mm"
    if not station.trusted:
        sys.exit(f"see2act: {off}, more than {1000 * stations.CLEAN:g}: all motion stays slow. Calibrate again")
    print(f"{off}: clean, so the arm moves at full speed from now on. Then type `python real.py background`")


def _background(args: argparse.Namespace) -> None:
    cfg = _config(args)
    station = stations.load(args.station)
    workspace = instantiate(cfg.workspace)
    station, floor = background.background(args.station, station, _camera(cfg), workspace, Terminal(), _routes(cfg))
    print(
        f"{station.background}: {floor.seen:.0%} of the floor seen, {1000 * floor.height:+.1f} mm from where it was taught, "
        f"uneven by {1000 * floor.spread:.1f} mm"
    )
    if objection := floor.objection():
        print(f"warning: {objection}")
    print("Then try `python demo.py robot=ur5_real --dry-run`, with the same camera=")


COMMANDS = {
    "new": (_new, "write a station's file"),
    "check": (_check, "read everything, move nothing, and say what is missing or wrong"),
    "board": (_board, "a calibration board to print"),
    "teach": (_teach, "lead the arm to home, the drop and three corners of the bin by hand"),
    "calibrate": (_calibrate, "find out where the camera is: the arm shows it the board from many sides"),
    "touch": (_touch, "try the calibration: the tip goes to points that the camera sees"),
    "background": (_background, "take images of the empty bin"),
}


def _parser(command: str, prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=prog, description=f"{COMMANDS[command][1].capitalize()}.")
    add = parser.add_argument
    add("--station", type=Path, default=Path("station.yaml"), metavar="FILE", help="default: station.yaml")
    if command in ("check", "calibrate", "touch", "background"):
        add("overrides", nargs="*", metavar="KEY=VALUE", help="configuration, as for train.py: camera=, workspace=, robot.*")
    if command == "new":
        add("--host", required=True, help="address of the arm's controller")
        add("--tool", required=True, choices=sorted(new.TOOLS), help="what is at the flange")
        add(
            "--tip",
            required=True,
            type=float,
            metavar="M",
            help="metres from the flange to the tool's lowest point, fingers closed",
        )
        add("--tool-host", metavar="HOST", help="address of OnRobot's Compute Box, where the tool has one")
        add("--mass", type=float, metavar="KG", help="of tool and cables (default: a data sheet's)")
    elif command == "check":
        add("--json", action="store_true", help="for a bug report")
    elif command == "teach":
        add("--places", default=",".join(teach.PLACES), metavar="PLACE,PLACE", help="teach only these of %(default)s")
    elif command == "calibrate":
        add("--views", type=Path, metavar="FILE", help="compute again from an earlier calibration's views; nothing moves")
        add(
            "--centre",
            type=float,
            nargs=3,
            metavar=("X", "Y", "Z"),
            help="of the board in the frame of the flange, metres, to 2 cm (default: at the tool's tip)",
        )
    elif command == "board":
        add("--out", type=Path, default=Path("board.pdf"), metavar="FILE", help="default: board.pdf")
    if command in ("board", "calibrate", "touch"):
        add("--columns", type=int, default=Board.columns, metavar="N", help="squares (default %(default)s)")
        add("--rows", type=int, default=Board.rows, metavar="N", help="squares (default %(default)s)")
        add("--square", type=float, default=Board.square, metavar="M", help="side of a square, metres (default %(default)s)")
    return parser


def _config(args: argparse.Namespace) -> Any:
    typed = ["task=none", "transfer=none", "robot=ur5_real", "camera=realsense", *args.overrides]
    return composed([*typed, f"robot.station={args.station}"])


def _camera(cfg: Any) -> DepthCamera:
    camera = instantiate(cfg.camera)
    if not isinstance(camera, DepthCamera):
        raise ConfigError(f"camera={cfg.camera.name} is simulated: use camera=realsense or camera=files")
    return camera


def _routes(cfg: Any) -> dict[str, float]:
    return {key: float(cfg.robot[key]) for key in ROUTES}


def _of(args: argparse.Namespace) -> Board:
    return Board(args.columns, args.rows, args.square)


def _say(line: str) -> None:
    print(line, flush=True)
