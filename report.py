"""Tables and figures of many runs, on one page: `python report.py multirun/sweep`."""

from see2act.report.main import main

if __name__ == "__main__":
    main()
