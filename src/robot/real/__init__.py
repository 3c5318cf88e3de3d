"""A real UR5 with its tool and its depth camera: a station. It is the one part of :mod:`see2act.robot` that reads a clock."""
