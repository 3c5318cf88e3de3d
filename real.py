"""Set up a station with a real robot: `python real.py check`."""

from see2act.commands.real import main

if __name__ == "__main__":
    main()
