"""A trained robot clears a bin before your eyes: `python demo.py primitive=grasp`."""

from see2act.commands.demo import main

if __name__ == "__main__":
    main()
