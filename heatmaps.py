"""One scene through many models, side by side: `python heatmaps.py --run outputs/.../seed0 primitive=grasp`."""

from see2act.commands.heatmaps import main

if __name__ == "__main__":
    main()
