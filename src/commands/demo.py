"""A trained robot clears a bin of objects it never saw, and leaves a film and a strip of pictures.

`python demo.py primitive=grasp objects=random_urdfs seed=5`
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from see2act.commands import user_errors_end_the_program
from see2act.errors import ConfigError
from see2act.experiment.checks import check_parts, validate
from see2act.experiment.config import composed
from see2act.experiment.preflight import leave_unmeasured
from see2act.files import writable

MODELS = Path(str(resources.files("see2act.models")))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, metavar="F", help="default: models/<primitive>.safetensors")
    parser.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="default: demo/")
    parser.add_argument("--no-film", action="store_true", help="pictures only, which is several times faster")
    parser.add_argument("--dry-run", action="store_true", help="with a real robot: stop 10 cm above each pick")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration, as for train.py")
    args = parser.parse_intermixed_args(arguments)
    with user_errors_end_the_program():
        overrides = [*args.overrides, "robot.dry_run=true"] if args.dry_run else args.overrides
        clear(overrides, args.checkpoint, args.out, not args.no_film)


def clear(overrides: Sequence[str], checkpoint: Path | None, out: Path, film: bool) -> tuple[int, int]:
    """Clear one bin of unseen objects; successes and attempts.

    Raises:
        ConfigError: The configuration is impossible, or its heightmaps have another resolution than the model's.
        ModelFileError: The checkpoint is none, or of another primitive.
    """
    import torch

    from see2act.experiment import build, figures, model_file
    from see2act.experiment.evaluation import one_test_run
    from see2act.seeding import seed_for

    cfg = composed(["task=none", "transfer=none", *overrides])
    if "video" in cfg.robot and not any(override.startswith("robot.video=") for override in overrides):
        cfg.robot.video = film
    leave_unmeasured(cfg)  # a trained model decides in fp32
    validate(cfg)
    check_parts(cfg)
    torch.set_num_threads(cfg.threads)
    model = model_file.load(checkpoint or MODELS / f"{cfg.primitive.name}.safetensors", cfg.primitive.name)
    if cfg.primitive.end_effector != model.config.primitive.end_effector:
        raise ConfigError(
            f"{checkpoint or 'models/'} did not learn with this end effector: give --checkpoint of a run that did, and the "
            "primitive= that was typed for it"
        )
    if cfg.workspace.pixel != model.pixel:
        raise ConfigError(
            f"workspace={cfg.workspace.name} has {cfg.workspace.pixel} m a pixel, the model learned from {model.pixel}"
        )
    robot = build.robot_factory(cfg, cfg.primitive)()
    folder = out / f"{cfg.primitive.name}-{cfg.objects.name}-seed{cfg.seed}"
    if not writable(folder):
        raise ConfigError(f"--out {out} cannot be written: give a folder that you may write to")
    folder.mkdir(parents=True, exist_ok=True)
    done = []
    try:
        with robot.film(folder / "clearing.mp4"):
            scene, most = seed_for("scene/demo", cfg.seed), cfg.evaluate.attempts.unseen
            for attempt in one_test_run(robot, model.affordances, build.policy(cfg), scene, "unseen", most):
                done.append(attempt)
                pick, outcome = attempt.pick, attempt.outcome
                turn = f", {math.degrees(pick.angle):3.0f} degrees" if cfg.primitive.angles > 1 else ""
                place = f"x {pick.x:+.3f} y {pick.y:+.3f} z {pick.z:.3f} m{turn}"
                print(f"pick {len(done):2}  {place}  score {attempt.choice.score:.2f}  {outcome.cause}", flush=True)
        emptied = robot.bin_empty()
    finally:
        robot.close()
    causes = Counter(attempt.outcome.cause for attempt in done)
    title = f"{cfg.primitive.name}, {cfg.objects.name}, unseen: {causes['ok']} of {len(done)} picks"
    figures.strip(done, model.affordances, robot, title, folder / "strip.png")
    print(f"{causes['ok']} of {len(done)} picks succeeded; the bin is {'empty' if emptied else 'not empty'}")
    for name in ("clearing.mp4", "strip.png"):
        if (folder / name).is_file():
            print(folder / name)
    return causes["ok"], len(done)
