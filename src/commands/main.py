"""The `see2act` command: `see2act train task=edge transfer=full`."""

from __future__ import annotations

import sys
from importlib import import_module

COMMANDS = {
    "train": "one run, or with -m a sweep of runs",
    "report": "tables and figures of many runs, on one page",
    "predict": "picks in an RGB-D image of your own",
    "demo": "a trained robot clears a bin",
    "heatmaps": "the same scenes through every source model",
    "real": "set up a station with a real robot",
    "coco": "get the COCO weights of model=nanodet_g",
}


def main() -> None:
    """Run the command that the first argument names, with the arguments after it."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        print("usage: see2act COMMAND ...\n")
        for command, purpose in COMMANDS.items():
            print(f"  {command:10}{purpose}")
        print("\n`see2act COMMAND --help` says more.")
        return
    if name not in COMMANDS:
        sys.exit(f"see2act: there is no command {name!r}: choose one of {', '.join(COMMANDS)}")
    sys.argv = [f"see2act {name}", *sys.argv[2:]]
    import_module(f"see2act.commands.{name}").main()


if __name__ == "__main__":
    main()
