"""A vision task: what is tall?"""

import numpy as np

from see2act.datamodules.labels import Task, View


class Tall(Task):
    """Pixels higher than some height.

    Args:
        pixel: Metres a pixel.
        height: Metres above the floor.
    """

    def __init__(self, pixel: float, height: float):
        super().__init__(pixel)
        self._height = height

    def truth(self, view: View) -> np.ndarray:
        return view.clean.height > self._height

    def vision(self, view: View) -> np.ndarray:
        return view.sensed.height > self._height
