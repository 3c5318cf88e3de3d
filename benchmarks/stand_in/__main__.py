"""A station without hardware, for trying a run with `robot=ur5_real` by hand.

`python -m benchmarks.stand_in FOLDER` writes FOLDER/station.yaml and says what to type in another terminal. What that terminal
asks of the person at the station, type here.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.stand_in.cell import StandInCell
from see2act.robot.types import Split

HELP = "type SCENE seen, SCENE unseen (the number that the run asks for), stop (a protective stop), unlock, or quit"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--host", default="127.0.1.1", help="address of the controller, 127.x.x.x")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration of the simulated robot behind it")
    args = parser.parse_intermixed_args()
    cell = StandInCell(args.host, args.folder, args.overrides)
    folder = args.folder
    print(
        f"a cup over a bin, its controller at {args.host}. In another terminal:\n\n"
        f"python train.py robot=ur5_real robot.station={folder}/station.yaml camera=files camera.folder={folder}/camera "
        "camera.frames=1 collect.interactions=8 "
        "task=none transfer=none finetune.attempts=30 'evaluate.at=[30]'\n"
    )
    try:
        while (words := input(f"{HELP}\n> ").split()) != ["quit"]:
            if words == ["stop"]:
                cell.protective_stop()
            elif words == ["unlock"]:
                cell.unlock()
            elif len(words) == 2 and words[0].isdigit() and words[1] in ("seen", "unseen"):
                split: Split = "seen" if words[1] == "seen" else "unseen"
                cell.fill(int(words[0]), split)
    except (EOFError, KeyboardInterrupt):
        pass
    finally:
        cell.close()


if __name__ == "__main__":
    main()
