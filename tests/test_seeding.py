from see2act.evaluation import SPLITS, scene_seed
from see2act.seeding import generator, seed_for


def test_seed_depends_on_name_and_keys_only() -> None:
    assert seed_for("scene/finetune", 1, 2) == seed_for("scene/finetune", 1, 2)
    assert len({seed_for("a", 1), seed_for("b", 1), seed_for("a", 2), seed_for("a", 1, 0)}) == 4
    assert generator("explore", 0).random() == generator("explore", 0).random()


def test_seed_zero_is_a_seed() -> None:
    assert generator("explore", 0).random() != generator("explore", 1).random()


def test_training_never_sees_an_evaluation_scene() -> None:
    evaluation = {scene_seed(split, run) for split in SPLITS for run in range(20)}
    training = {seed_for("scene/finetune", seed, episode) for seed in range(10) for episode in range(200)}
    collection = {seed_for("scene/collect", 0, scene) for scene in range(1000)}
    develop = {scene_seed(split, run, "develop") for split in SPLITS for run in range(20)}
    assert len(evaluation) == 40
    assert evaluation.isdisjoint(training | collection | develop)
