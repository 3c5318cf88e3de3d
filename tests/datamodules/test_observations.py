"""Observations that a person made possible: none is lost, made twice, or taken for one of another grid."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from see2act.datamodules.observations import Observations
from see2act.errors import ConfigError
from see2act.policy import Policy
from see2act.robot.workspace import Workspace
from tests.attended import Killed, Table

WORKSPACE = Workspace("table", 0.1, 0.1, 0.0025)
MARGIN = 0.01
"""Metres that the tool needs to the walls."""


@pytest.fixture
def observations(tmp_path: Path) -> Observations:
    Table.prepare()
    return Observations(tmp_path / "observations")


def interact(observations: Observations, interactions: int, per_scene: int = 4) -> None:
    tool = type("Tool", (), {"primitive": "suction"})
    policy = Policy("argmax", False, WORKSPACE.pixel, footprint=(MARGIN, MARGIN))
    observations.add(Table(WORKSPACE, None, None, tool), interactions, per_scene, 5, seed=0, policy=policy, angles=1)


def files(observations: Observations) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in observations.folder.iterdir()}


def test_each_interaction_is_a_file_beside_the_empty_table(observations: Observations) -> None:
    interact(observations, 6)
    assert sorted(files(observations)) == sorted(
        [
            "background.npz",
            "grid.json",
            *(f"scene-00000-{k:03}.npz" for k in range(4)),
            *(f"scene-00001-{k:03}.npz" for k in (0, 1)),
        ]
    )
    collection = observations.first(6)
    assert len(collection) == 6
    assert collection.background.height.max() == 0
    assert collection.arrays["height"].max() > 0
    assert np.array_equal(collection.arrays["clean_height"], collection.arrays["height"]), "nobody knows the truth"
    assert collection.arrays["body"].max() == -1


def test_picks_are_where_the_tool_has_room(observations: Observations) -> None:
    interact(observations, 40, per_scene=20)
    picks = np.array([[int(word) for word in call.split()[1:]] for call in Table.calls if call.startswith("pick")])
    rows = WORKSPACE.shape[0]
    assert picks.min() >= 3
    assert picks.max() <= rows - 4
    assert len(np.unique(picks, axis=0)) > 35


def test_a_later_run_takes_the_first_ones_and_adds_what_it_needs(observations: Observations) -> None:
    interact(observations, 5)
    before = files(observations)
    assert Table.count("fill") == 2
    interact(observations, 9)
    assert {name: data for name, data in files(observations).items() if name in before} == before
    assert (len(observations), Table.count("fill")) == (9, 3), "the scene under way goes on"
    first = observations.first(5)
    assert len(first) == 5
    assert np.array_equal(first.arrays["height"], observations.first(9).arrays["height"][:5])


@pytest.mark.parametrize("as_it_was", [True, False])
def test_a_killed_run_loses_and_repeats_nothing(observations: Observations, as_it_was: bool) -> None:
    Table.killed_in = 6
    with pytest.raises(Killed):
        interact(observations, 8)
    before = files(observations)
    assert len(observations) == 6
    Table.killed_in, Table.as_it_was = -1, as_it_was
    Table.calls.clear()
    interact(observations, 8)
    assert Table.calls[0] == "resume after 2"
    assert Table.count("fill") == (0 if as_it_was else 1)
    assert Table.count("pick") == 2
    assert {name: data for name, data in files(observations).items() if name in before} == before


def test_how_often_the_bin_must_be_filled_is_known_beforehand(observations: Observations) -> None:
    assert observations.scenes_left(9, 4) == 3
    interact(observations, 5)
    assert [observations.scenes_left(count, 4) for count in (3, 5, 8, 9, 13)] == [0, 0, 0, 1, 2]


def test_a_folder_of_another_grid_is_refused(observations: Observations) -> None:
    observations.check(WORKSPACE)
    interact(observations, 1)
    observations.check(Workspace("same", 0.1, 0.1, 0.0025))
    with pytest.raises(
        ConfigError, match=r"holds observations with workspace\.width=0\.1, not .*: choose another collect\.folder="
    ):
        observations.check(Workspace("wider", 0.2, 0.1, 0.0025))


def test_the_digest_is_of_the_content_alone(observations: Observations, tmp_path: Path) -> None:
    interact(observations, 4)
    copied = Observations(tmp_path / "copied")
    shutil.copytree(observations.folder, copied.folder)
    digest = observations.digest(4)
    assert copied.digest(4) == digest
    assert observations.digest(3) != digest
    interact(observations, 5)
    assert observations.digest(4) == digest, "later ones change nothing"
    shutil.copy(copied.folder / "scene-00000-000.npz", copied.folder / "scene-00000-003.npz")
    assert copied.digest(4) != digest
