"""Picks in an RGB-D image of your own: `python predict.py --help`."""

from see2act.commands.predict import main

if __name__ == "__main__":
    main()
