from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.stand_in.cell import PLACES, _Cell
from tests.robot.real.conftest import WORKER


def test_the_arm_is_where_a_hand_leads_it(tmp_path: Path) -> None:
    """It must not rush there by itself with the next motion, through the walls of the bin."""
    cell = _Cell(f"127.{WORKER}.96.1", tmp_path, [], unboxed=True)
    cell.controller.state.freedrive = True
    for place in PLACES:
        cell.lead(place)
        assert np.allclose(cell._joints(), cell.controller.state.q), place
    cell.controller.close()
