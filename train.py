"""Learn to see, then learn to act: `python train.py task=edge transfer=full`."""

from see2act.commands.train import main

if __name__ == "__main__":
    main()
