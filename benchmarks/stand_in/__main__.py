"""A station without hardware, for trying `real.py` and runs with `robot=ur5_real` by hand.

`python -m benchmarks.stand_in FOLDER` says what to type in another terminal. With `--unboxed` there is no station.yaml yet, and
the camera shows a calibration board where there is one. What the other terminal asks of the person at the station, do here.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from benchmarks.stand_in.cell import BRACKET, PLACES, StandInCell
from see2act.robot.real.station import Rg2Modbus
from see2act.robot.types import Split

HELP = f"""  SCENE seen, SCENE unseen       fill the bin; SCENE is the number that a run asks for
  empty                          take everything out of the bin
  lead PLACE                     lead the arm by hand: {", ".join(PLACES)}
  board tool|floor|away          fix the board beside the tool, lay it into the bin, or take it away
  offset                         measure what `real.py touch` asks for
  stop, unlock                   a protective stop, and what clears it
  quit"""


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--host", default="127.0.1.1", help="address of the controller, 127.x.x.x")
    parser.add_argument("--unboxed", action="store_true", help="nothing is set up yet")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration of the simulated robot behind it")
    args = parser.parse_intermixed_args()
    cell = StandInCell(args.host, args.folder, args.overrides, args.unboxed)
    print(
        f"{cell.tool.kind} over a bin, its controller at {args.host}. In another terminal:\n",
        *_commands(cell, args),
        f"\nHere, as the person at the station, type\n{HELP}",
        sep="\n",
    )
    try:
        while (words := input("> ").split()) != ["quit"]:
            try:
                _do(cell, words)
            except (ValueError, KeyError, EOFError) as error:
                print(f"not done: {error}")
    except (EOFError, KeyboardInterrupt):
        pass
    finally:
        cell.close()


def _commands(cell: StandInCell, args: argparse.Namespace) -> Iterator[str]:
    """What to type in the other terminal, in this order."""
    folder, tool = args.folder, cell.tool
    station, camera = f"{folder}/station.yaml", f"camera=files camera.folder={folder}/camera camera.frames=1"
    if args.unboxed:
        new = f"python real.py new --station {station} --host {args.host} --tool {tool.kind} --tip {tool.tip:.4f}"
        if isinstance(tool, Rg2Modbus):
            yield f"{new} --tool-host {args.host}"
            yield f"sed -i 's/port: 502/port: {tool.port}/; s/opening: .*/opening: {tool.opening:.3f}/' {station}"
        else:
            yield new
        yield f"python real.py teach --station {station}"
        for command in (f"calibrate --centre {' '.join(map(str, BRACKET))}", "touch", "background", "check"):
            yield f"python real.py {command} --station {station} {camera}"
    primitive = next((word for word in args.overrides if word.startswith("primitive=")), "primitive=suction")
    yield f"python demo.py robot=ur5_real --dry-run {primitive} robot.station={station} {camera}"
    yield (
        f"python train.py robot=ur5_real robot.station={station} {camera} collect.folder={folder}/observations "
        f"collect.interactions=8 {primitive} task=none transfer=none finetune.attempts=30"
    )


def _do(cell: StandInCell, words: list[str]) -> None:
    match words:
        case [scene, "seen" | "unseen"] if scene.isdigit():
            split: Split = "seen" if words[1] == "seen" else "unseen"
            cell.fill(int(scene), split)
        case ["empty"]:
            cell.empty()
        case ["lead", *place] if " ".join(place) in PLACES:
            cell.lead(" ".join(place))
        case ["board", "tool" | "floor" | "away" as where]:
            cell.put_board(where)
        case ["offset"]:
            print("{:.1f} {:.1f}".format(*(1000 * metres for metres in cell.offset())))
        case ["stop"]:
            cell.protective_stop()
        case ["unlock"]:
            cell.unlock()
        case _:
            raise ValueError(f"type one of\n{HELP}")


if __name__ == "__main__":
    main()
