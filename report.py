"""Tables and figures of many runs, on one page: `python report.py multirun/sweep`."""

from see2act.commands.report import main

if __name__ == "__main__":
    main()
