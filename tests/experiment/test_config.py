"""Bad input gets one line that names the mend, before any work is done."""

from __future__ import annotations

import copy
import errno
import itertools
import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig, OmegaConf

from see2act.errors import ConfigError, DamagedFile
from see2act.experiment.checks import check_run, impossible_condition, validate
from see2act.experiment.config import composed, register
from see2act.experiment.folder import alone_in, claim, refuse_foreign, set_aside
from see2act.experiment.identity import config_hash, versions
from see2act.experiment.preflight import check_command, check_sweep
from see2act.experiment.single import run_checked
from see2act.experiment.sweep import FAILED, LEFT_OUT, OTHER, Summary, finished_elsewhere, link, run_job
from tests.factory import finished_run

TRAIN = Path(__file__).parents[2] / "train.py"
EXPERIMENTS = TRAIN.parent / "conf" / "experiment"
TASKS = ("none", "edge", "corner", "center", "foreground", "normal")


@pytest.mark.parametrize("primitive", ["suction", "grasp"])
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("transfer", ["none", "backbone", "full", "fixed"])
def test_exactly_the_sensible_conditions_are_possible(config: Callable, task: str, transfer: str, primitive: str) -> None:
    cfg = config(f"task={task}", f"transfer={transfer}", f"primitive={primitive}")
    legal = (task == "none") == (transfer == "none")
    assert (impossible_condition(cfg) is None) is legal
    if legal:
        validate(cfg)
    else:
        with pytest.raises(ConfigError, match="use "):
            validate(cfg)


@pytest.mark.parametrize(
    ("task", "transfer", "model", "mend"),
    [
        ("imagenet", "backbone", "rpn_r50_fpn", None),
        ("imagenet", "full", "rpn_r50_fpn", "use transfer=backbone"),
        ("imagenet", "fixed", "rpn_r50_fpn", "use transfer=backbone"),
        ("imagenet", "backbone", "fcn7", "add model=rpn_r50_fpn"),
        ("coco", "backbone", "rpn_r50_fpn", None),
        ("coco", "full", "rpn_r50_fpn", None),
        ("coco", "fixed", "rpn_r50_fpn", None),
        ("coco", "full", "fcn7", "add model=rpn_r50_fpn or model=nanodet_g"),
        ("coco", "full", "nanodet_g", None),
        ("imagenet", "backbone", "nanodet_g", "add model=rpn_r50_fpn"),
    ],
)
def test_off_the_shelf_weights_fit_one_network(
    config: Callable, task: str, transfer: str, model: str, mend: str | None
) -> None:
    cfg = config(f"task={task}", f"transfer={transfer}", f"model={model}")
    if mend:
        with pytest.raises(ConfigError, match=mend):
            validate(cfg)
    else:
        validate(cfg)


def test_design_numbers_are_the_defaults(config: Callable) -> None:
    for primitive, attempts, angles, at in (("suction", 150, 1, [0, 60, 150, 300]), ("grasp", 150, 16, [0, 150, 350, 400])):
        cfg = config(f"primitive={primitive}")
        assert (cfg.finetune.attempts, cfg.primitive.angles, list(cfg.evaluate.at)) == (attempts, angles, at)
        assert (cfg.collect.interactions, cfg.evaluate.attempts) == (300, {"seen": 25, "unseen": 15})
        assert (cfg.task.name, cfg.transfer.name, cfg.model.name, cfg.policy.name) == ("edge", "full", "fcn7", "suppress")


def test_hash_is_of_what_changes_results(config: Callable) -> None:
    config = partial(config, "precision=fp32")
    base = config_hash(config())
    assert len(base) == 12
    local = ("seed=3", "logger=none", "paths.cache=elsewhere", "collect.workers=1", "force=true", "robot.video=true")
    off = ("camera.randomize=false", "camera.randomization.position=0.01", "robot.latency=0")
    for same in (*local, *off, "trainer.devices=[0]", "evaluate.argmax=true"):
        assert config_hash(config(same)) == base
    for other in (
        "task=corner",
        "model.width=8",
        "finetune.updates=5",
        "policy=argmax",
        "collect.interactions=301",
        "+trainer.gradient_clip_val=1.0",
        "trainer.devices=2",
        "trainer.devices=[0,1]",
        "evaluate.argmax=false",
        "camera.randomize=true",
        "robot.latency=0.04",
    ):
        assert config_hash(config(other)) != base
    on = partial(config, "camera.randomize=true")
    assert config_hash(on("camera.randomization.position=0.01")) != config_hash(on())


def test_keys_that_came_later_leave_the_hash_of_earlier_runs(config: Callable) -> None:
    now = config("precision=fp32")
    before = copy.deepcopy(now)
    OmegaConf.set_struct(before, False)
    for group, key in (("camera", "randomize"), ("camera", "randomization"), ("robot", "latency")):
        del before[group][key]
    assert config_hash(before) == config_hash(now)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("task=edges", ["edges", "corner", "foreground"]),
        ("primitive=push", ["push", "grasp", "suction"]),
        ("transfer=head", ["head", "backbone", "full"]),
        ("widht=3", ["widht", "--cfg job"]),
        ("finetune.attemps=3", ["finetune.attemps", "--cfg job"]),
        ("model.widht=3", ["model.widht"]),
        ("finetune.attempts=-1", ["finetune.attempts=-1", "at least 0"]),
        ("finetune.attempts=many", ["many", "finetune.attempts"]),
        ("task=none", ["transfer=none"]),
        ("transfer=none", ["task=none"]),
        ("labels=guess", ["labels=guess", "truth, vision"]),
        ("finetune.batchnorm=off", ["frozen, batch"]),
        ("finetune.temperature=nan", ["finetune.temperature=nan", "a finite number"]),
        ("finetune.logit_scale=nan", ["finetune.logit_scale=nan", "a finite number"]),
        ("pretrain.weight_decay=-1", ["pretrain.weight_decay=-1", "at least 0"]),
        ("objects.kinds=0", ["objects.kinds=0", "at least 1"]),
        ("camera.height=0", ["camera.height=0", "at least 1 pixel"]),
        ("model.width=abc", ["model.network.width=abc", "must be a valid integer"]),
        ("collect.interactions=5", ["collect.interactions=5", "batch_size"]),
        ("objects.scale=[1.0,4.0]", ["does not fit the gripper"]),
        ("workspace.pixel=0", ["must be positive"]),
        ("primitive.footprint=[0.2,0.01]", ["primitive.footprint=[0.2, 0.01]", "between 0 and"]),
        ("policy.radius=4", ["policy.radius=4", "in metres"]),
        ("finetune.replay.shift=1", ["finetune.replay.shift=1", "in metres"]),
        ("policy.radius=big", ["policy.radius=big", "must be a valid number"]),
        ("model.network.width={a: 1}", ["model.network.width=", "must be a valid integer"]),
        ("model.width=0", ["width=0", "at least 1"]),
        ("camera.width=wide", ["camera.width=wide", "must be a valid integer"]),
        ("task.label.low=x", ["task.label.low=x", "must be a valid number"]),
        ("+task.label.lower=3", ["no parameter 'lower'"]),
        ("robot.arm.home=[2,0,0.5]", ["robot.arm.home", "out of the arm's reach"]),
        ("task.weights=nowhere.ckpt", ["nowhere.ckpt", "no file"]),
        (f"task.weights='{EXPERIMENTS}'", ["is no file", "type task=affordance"]),
        ("evaluate.runs=0", ["evaluate.runs=0"]),
        ("+sed=3", ["no configuration key 'sed'", "seed"]),
        ("+evaluate.attempts.unseeen=5", ["unseeen"]),
        ("+figures.scens=3", ["scens"]),
        ("+finetune.attemps=3", ["finetune.attemps", "averaging"]),
        ("+collect.primitive.lrr=3", ["collect.primitive.lrr", "end_effector"]),
        ("+model.widht=64", ["model.widht is read by nothing", "model=fcn7 has name, width"]),
        ("primitive.end_effector.cup_radius=-1", ["primitive.end_effector.cup_radius=-1", "at least 0"]),
        ("camera.noise.sigma=nan", ["camera.noise.sigma=nan", "a finite number"]),
        ("robot.bin.wall_height=-0.1", ["robot.bin.wall_height=-0.1", "at least 0"]),
        ("+trainer.gradient_clip=1", ["trainer has no parameter 'gradient_clip'", "gradient_clip_val"]),
        ("+trainer.max_epochs=50", ["trainer.max_epochs has no place here", "pretrain.epochs"]),
        ("+trainer.limit_train_batches=0", ["trainer.limit_train_batches has no place here", "finetune.attempts"]),
        ("trainer.logger=true", ["trainer.logger has no place here", "use logger="]),
        ("trainer.accelerator=gpuu", ["this machine has no such trainer", "gpuu"]),
        ("trainer.devices=0", ["this machine has no such trainer", "devices=0"]),
        ("logger=null", ["name an option", "logger=none"]),
        ("precision=[0]", ["precision=[0] cannot be composed", "name an option"]),
        ("camera.target=[9,9,9]", ["sees nothing of the bin", "camera.target"]),
        ("camera.target=[0.45,0,0.54]", ["give no view", "position and target apart"]),
        ("camera.randomization.position=3", ["camera.randomization.position=3", "at most 0.05"]),
        ("camera.randomization.ambient=0.5", ["camera.randomization.ambient=0.5", "[least,most]"]),
        ("robot.latency=40", ["robot.latency=40", "at most 1"]),
        ("camera.position=[a,b,c]", ["camera.position=['a', 'b', 'c']", "three numbers"]),
        ("robot.arm.tool_speed=0", ["robot.arm.tool_speed=0", "above 0"]),
        ("workspace.pixel=0.0035", ["102.86 pixels of 0.0035 m", "give 0.3605"]),
        ("objects.density=-5", ["objects.density=-5", "above 0"]),
        ("logger.offline=maybe", ["logger.offline=maybe", "must be a valid boolean"]),
        ("collect.primitive.end_effector.depth=abc", ["collect.primitive.end_effector.depth=abc", "must be a valid number"]),
        ("objects.name=my-parts", ["objects.name=my-parts", "letters, digits and _"]),
        ("policy.name=my-rule", ["policy.name=my-rule", "letters, digits and _"]),
        ("conditions=[suction/edge]", ["suction/edge", "primitive/task/transfer"]),
        ("finetune.replay.floor=0", ["finetune.replay.floor=0", "above 0"]),
        ("finetune.attempts=abc", ["finetune.attempts=abc", "could not be converted to Integer"]),
        ("experiment=smoke", ["experiment=smoke is a sweep", "add -m"]),
    ],
)
def test_refusals_name_the_mend_in_one_line(
    override: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as error:
        check_command([override])
    text = str(error.value)
    assert "\n" not in text
    for word in words:
        assert word in text, text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "overrides",
    [
        ["model.network.width=8"],  # in the place of model.width, which then nothing reads
        ["+model.encoder={width: 8}", "model.network.width=${model.encoder.width}"],
        ["+model.deep=8", "model.network.width=${oc.select:model.deep,4}"],
        ["primitive=grasp", "primitive.end_effector.depth=-0.005"],
        ["primitive.end_effector.contact_limit=inf"],
        ["trainer.logger=null", "+trainer.max_steps=-1"],
        ["workspace.length=0.365"],  # no multiple of the network's stride: it pads its input
        ["task.weights=vision.ckpt", "workspace.length=0.365"],
    ],
)
def test_what_makes_sense_is_let_through(overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "vision.ckpt").touch()
    check_command([*overrides, "precision=fp32"])


def test_the_trainer_is_checked_where_nothing_is_learned_beforehand() -> None:
    with pytest.raises(ConfigError, match="this machine has no such trainer"):
        check_command(["task=none", "transfer=none", "+trainer.gradient_clip_algorithm=foo", "+trainer.gradient_clip_val=1.0"])
    if not torch.cuda.is_available():  # deciding and learning need it too
        with pytest.raises(ConfigError, match="this machine has no such trainer"):
            check_command(["task=none", "transfer=none", "trainer=gpu"])
    check_command(
        ["task=none", "transfer=none", "trainer=ddp", "trainer.accelerator=cpu"]
    )  # robots learn on one device of them


def test_robots_side_by_side_need_counts_that_they_can_make(config: Callable) -> None:
    validate(config("finetune.robots=2"))
    with pytest.raises(ConfigError, match=r"finetune\.attempts=152 'evaluate\.at=\[0, 60, 152\]'"):
        validate(config("finetune.robots=4"))
    validate(config("finetune.robots=4", "finetune.attempts=152", "evaluate.at=[0,60,152]"))
    with pytest.raises(ConfigError, match=r"finetune\.robots=0"):
        validate(config("finetune.robots=0"))


@pytest.mark.parametrize("override", ["model.backbone=resnet7", "model.depth=late", "model.anchors=0"])
def test_a_network_that_cannot_be_is_refused_before_work(override: str) -> None:
    with pytest.raises(ConfigError, match=override.removeprefix("model.")):
        check_command(["task=coco", "model=rpn_r50_fpn", override])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["seeds=0,1"], "there is no configuration key 'seeds'"),
        (["task=edge,corner,edgee"], "Could not find 'task/edgee' choose from the options of 'task': affordance center coco"),
        (["+sed=range(0,3)"], "there is no configuration key 'sed'"),
        (["experiment=transfer_part"], "options of 'experiment': off_the_shelf off_the_shelf_small"),
        (["task=glob(*)", "finetune.attemps=3"], "there is no configuration key 'finetune.attemps'"),
        (["seed=range(0,"], "range(0,"),
        (["seed=range(0,0)"], "seed=range(0,0) names no value"),
        (["seed=interval(0,1)"], "Can only enumerate"),
        (["finetune.backbone_lr=${nope}"], "Interpolation key 'nope' not found"),
        (["paths.cache=/dev/null/x"], "/dev/null/x cannot be written"),
    ],
)
def test_a_sweep_s_misspelt_keys_and_options_are_refused_in_one_line(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_sweep(overrides)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_sweep_that_makes_sense_is_let_through() -> None:
    check_sweep(
        ["experiment=transfer_parts", "seed=range(5,10)", "+trainer.gradient_clip_val=0.5,1.0", "hydra.launcher.n_jobs=1"]
    )
    check_sweep(["task=glob(*)", "transfer=glob(*)", "primitive=suction,grasp", "finetune.attempts=0,5"])


def test_damage_in_a_job_s_folder_is_named_and_ends_that_job_alone(config: Callable, tmp_path: Path) -> None:
    cfg, folder = config("seed=3"), tmp_path / "sweep" / "seed3"
    folder.mkdir(parents=True)
    duplicate = tmp_path / "other" / "seed3"
    duplicate.mkdir(parents=True)
    (duplicate / "result.json").write_text('{"half":')  # of another experiment's sweep
    claim(folder, cfg)
    (folder / "result.json").write_text('{"half":')
    assert run_job(cfg, folder, tmp_path / "sweep") is None
    assert f"{folder}/result.json is damaged" in (folder / FAILED).read_text()
    assert "delete it and type the same command again" in (folder / FAILED).read_text()
    (folder / "run.json").write_text("{")
    with pytest.raises(DamagedFile, match=r"run\.json is damaged"):
        refuse_foreign(folder, cfg)
    assert finished_elsewhere(tmp_path / "sweep" / "seed3" / "new", tmp_path / "sweep", cfg) is None


@pytest.mark.parametrize("shared", range(5))
def test_a_link_that_was_cut_short_is_made_anew(
    shared: int, config: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cfg = config("seed=3")
    duplicate, folder = tmp_path / "other" / "seed3", tmp_path / "sweep" / "seed3"
    (duplicate / "checkpoints").mkdir(parents=True)
    files = ("run.json", "attempts.csv", "checkpoints/last.ckpt", "checkpoints/model.safetensors")
    for name in files:
        (duplicate / name).write_text(name)
    _finish(duplicate, cfg)
    folder.mkdir(parents=True)
    left = iter(range(shared))

    def cut(path: Path, there: Path) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt
        os.link(path, there)

    with monkeypatch.context() as patched:
        patched.setattr("see2act.experiment.sweep._share", cut)
        with pytest.raises(KeyboardInterrupt):
            link(duplicate, folder)
    if not (folder / "result.json").exists():  # else it counts as finished
        assert finished_elsewhere(folder, tmp_path / "sweep", cfg) == duplicate
    link(duplicate, folder)
    assert [(folder / name).read_text() for name in files] == list(files)
    assert (folder / "result.json").samefile(duplicate / "result.json")


def test_another_run_at_the_same_place_of_another_sweep_is_not_taken_for_this_one(config: Callable, tmp_path: Path) -> None:
    """As with hydra.sweep.subdir=${hydra.job.num}, where a place says nothing of the run."""
    duplicate, folder = tmp_path / "other" / "0", tmp_path / "sweep" / "0"
    duplicate.mkdir(parents=True)
    cfg = config("seed=3")
    for other in (config("seed=4"), config("seed=3", "finetune.temperature=3")):
        _finish(duplicate, other)
        assert finished_elsewhere(folder, tmp_path / "sweep", cfg) is None
    _finish(duplicate, cfg)
    assert finished_elsewhere(folder, tmp_path / "sweep", cfg) == duplicate


def _finish(folder: Path, cfg: DictConfig) -> None:
    record = {"versions": versions(), "config_hash": config_hash(cfg), "choices": {"seed": cfg.seed}}
    (folder / "result.json").write_text(json.dumps(record))


def test_a_note_that_finds_no_room_is_logged_and_ends_no_sweep(
    config: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    folder = tmp_path / "sweep" / "seed3"
    folder.mkdir(parents=True)
    monkeypatch.setattr("see2act.experiment.sweep.run_checked", full)
    monkeypatch.setattr(Path, "write_text", full)
    assert run_job(config("seed=3"), folder, tmp_path / "sweep") is None
    assert "failed.txt could not be written" in caplog.text
    assert not (folder / FAILED).exists()


def _claimed_yesterday(folder: Path, cfg: DictConfig) -> None:
    claim(folder, cfg)
    known = json.loads((folder / "run.json").read_text())
    known["versions"]["code"] = "of yesterday"
    (folder / "run.json").write_text(json.dumps(known))


def test_half_a_run_of_another_version_is_named_and_left(config: Callable, tmp_path: Path) -> None:
    cfg, folder = config("seed=3"), tmp_path / "sweep" / "seed3"
    folder.mkdir(parents=True)
    _claimed_yesterday(folder, cfg)
    assert run_job(cfg, folder, tmp_path / "sweep") is None
    assert (folder / OTHER).read_text() == "begun, and not finished"
    assert not (folder / FAILED).exists()


def test_a_sweep_of_which_no_job_ran_says_so(
    config: Callable, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Summary, "failures", 0)
    summary, sweep = Summary(), OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})
    summary.on_multirun_start(sweep)
    for seed in (0, 1):
        folder = tmp_path / f"seed{seed}"
        (folder / ".hydra").mkdir(parents=True)
        (folder / ".hydra" / "config.yaml").touch()
        cfg = config("task=edge", f"seed={seed}", "conditions=[suction/normal/full]")
        assert run_job(cfg, folder, tmp_path) is None
        for path in (folder / ".hydra" / "config.yaml", folder / LEFT_OUT):
            os.utime(path, (1e9, 1e9))  # the clock was set back meanwhile
    with caplog.at_level("INFO"):
        summary.on_multirun_end(sweep)
    assert "1 conditions were left out, since the experiment does not name them: conditions=[]" in caplog.text
    assert "suction/edge/full" in caplog.text
    assert "not one job ran" in caplog.text
    assert Summary.failures == 1


def test_an_unwritable_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"hydra\.run\.dir=.* cannot be written: choose another"):
        check_command([f"hydra.run.dir={tmp_path}/file/run"])


def test_a_refusal_ends_the_program_without_work(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, TRAIN, "task=edges"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert done.stderr.strip().count("\n") == 0
    assert "choose from" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_folder_of_another_run_is_refused(config: Callable, tmp_path: Path) -> None:
    cfg = config("seed=1")
    refuse_foreign(tmp_path, cfg)
    claim(tmp_path, cfg)
    refuse_foreign(tmp_path, cfg)
    for other in (("seed=2",), ("seed=1", "task=normal")):
        with pytest.raises(ConfigError, match=r"holds a run of another configuration.*hydra\.run\.dir="):
            refuse_foreign(tmp_path, config(*other))
    (tmp_path / "run.json").unlink()
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(ConfigError, match="another configuration"):
        refuse_foreign(tmp_path, cfg)


def test_a_run_that_a_report_kept_is_known_by_its_result(config: Callable, tmp_path: Path) -> None:
    cfg = config("seed=1")
    kept = finished_run(config_hash=config_hash(cfg), seed=1, versions=versions(), unseen=[(1, 4)])
    (tmp_path / "result.json").write_text(kept.model_dump_json())
    assert run_checked(cfg, tmp_path) == 0.25
    with pytest.raises(ConfigError, match="another configuration"):
        refuse_foreign(tmp_path, config("seed=2"))


def test_a_run_that_is_made_anew_has_the_folder_to_itself(config: Callable, tmp_path: Path) -> None:
    folder = tmp_path / "seed1"
    (folder / ".hydra").mkdir(parents=True)
    (folder / "result.json").write_text("{}")
    with alone_in(folder):
        set_aside(folder)
    with alone_in(folder):
        assert not (folder / "result.json").exists()
        with pytest.raises(ConfigError, match="another process is at work"), alone_in(folder):
            pass


def test_force_keeps_the_earlier_run(tmp_path: Path) -> None:
    folder = tmp_path / "seed0"
    (folder / ".hydra").mkdir(parents=True)
    (folder / "figures").mkdir()
    (folder / "result.json").write_text("{}")
    set_aside(folder)
    assert [item.name for item in folder.iterdir()] == [".hydra"]
    (earlier,) = tmp_path.glob("seed0.*")
    assert {item.name for item in earlier.iterdir()} == {".hydra", "figures", "result.json"}


def test_force_begins_a_log_anew(tmp_path: Path) -> None:
    folder = tmp_path / "seed0"
    (folder / ".hydra").mkdir(parents=True)
    (folder / "result.json").write_text("{}")
    handler = logging.FileHandler(folder / "train.log")  # as Hydra has opened it
    logging.getLogger().addHandler(handler)
    try:
        logging.getLogger("see2act").warning("before")
        set_aside(folder)
        logging.getLogger("see2act").warning("after")
    finally:
        logging.getLogger().removeHandler(handler)
        handler.close()
    assert (folder / "train.log").read_text() == "after\n"
    (earlier,) = tmp_path.glob("seed0.*/train.log")
    assert earlier.read_text().startswith("before\n")


def test_help_does_not_wait_for_torch() -> None:
    code = "import sys, see2act.commands.train; sys.exit('torch' in sys.modules or 'lightning' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def test_the_precision_is_part_of_the_hash_and_so_is_a_gpu(config: Callable) -> None:
    precise = config("precision=fp32")
    assert config_hash(precise) != config_hash(config("precision=bf16"))
    assert config_hash(precise) != config_hash(config("precision=fp32", "trainer=gpu"))
    assert config("trainer=gpu").precision == "bf16"


def test_values_out_of_their_range_are_refused(config: Callable) -> None:
    with pytest.raises(ConfigError, match="use precision=bf16"):
        validate(config("+trainer.precision=bf16-mixed"))
    with pytest.raises(ConfigError, match="logit_scale=0"):
        validate(config("finetune.logit_scale=0"))
    with pytest.raises(ConfigError, match="scenes=test"):
        validate(config("evaluate.scenes=test"))
    with pytest.raises(ConfigError, match=r"precision/fp16.*auto bf16 fp32"):
        config("precision=fp16")


@pytest.mark.parametrize(("launcher", "jobs"), [("workers", -1), ("joblib", -1), ("basic", None)])
def test_hydra_s_launchers_compose(launcher: str, jobs: int | None) -> None:
    register()
    with initialize_config_module("see2act.conf", version_base="1.3"):
        default = compose("train", return_hydra_config=True)
        cfg = compose("train", [f"hydra/launcher={launcher}"], return_hydra_config=True)
    assert default.hydra.launcher.n_jobs == -1
    assert cfg.hydra.launcher.get("n_jobs") == jobs


def test_the_hash_knows_what_is_in_a_folder_of_objects(config: Callable, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0")
    hashes = [
        config_hash(config("objects=folder", f"objects.path={path}")) for path in (tmp_path, f"{tmp_path}/../{tmp_path.name}")
    ]
    assert hashes[0] == hashes[1]
    (tmp_path / "a.obj").write_text("v 0 0 1")
    assert config_hash(config("objects=folder", f"objects.path={tmp_path}")) != hashes[0]


def test_a_network_that_gives_another_shape_is_refused(config: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("see2act.modules.fcn7.FCN7.forward", lambda self, x: x[:, :1, ::2])
    with pytest.raises(ConfigError, match=r"gives \(1, 1, 72, 144\) for a heightmap of 144 x 144.*a logit for every pixel"):
        check_run(config("task=edge", "transfer=full"))


def test_what_follows_from_the_seed_leaves_the_hash_as_it_is(config: Callable[..., DictConfig]) -> None:
    own = [config("pretrain.seed=${seed}", f"seed={seed}") for seed in (0, 3)]
    assert [cfg.collect.seed for cfg in own] == [0, 3]
    assert config_hash(own[0]) == config_hash(own[1])
    shared = [config(f"seed={seed}") for seed in (0, 3)]
    assert config_hash(shared[0]) == config_hash(shared[1]) != config_hash(own[0])


def test_experiments_share_the_runs_they_have_in_common(config: Callable[..., DictConfig]) -> None:
    condition = ("primitive=grasp", "task=foreground", "transfer=full")
    runs = [config(f"experiment={name}", *condition) for name in ("transfer_parts", "vision_tasks")]
    assert config_hash(runs[0]) == config_hash(runs[1])
    assert "grasp/foreground/full" in runs[0].conditions
    assert (runs[0].finetune.attempts, runs[0].collect.interactions, runs[0].evaluate.runs) == (400, 1000, 3)


@pytest.mark.parametrize("experiment", sorted(path.stem for path in EXPERIMENTS.glob("*.yaml")))
def test_experiments_reach_each_of_their_conditions_once(config: Callable[..., DictConfig], experiment: str) -> None:
    file = OmegaConf.load(EXPERIMENTS / f"{experiment}.yaml")
    params, wanted = file.hydra.sweeper.params, file.get("conditions") or ()
    met = []
    for primitive, task, transfer in itertools.product(*(params[key].split(",") for key in ("primitive", "task", "transfer"))):
        if wanted and f"{primitive.split('_')[0]}/{task}/{transfer}" not in wanted:
            continue  # to compose a configuration takes long
        cfg = config(f"experiment={experiment}", f"primitive={primitive}", f"task={task}", f"transfer={transfer}")
        condition = f"{cfg.primitive.name}/{task}/{transfer}"
        if condition in (cfg.conditions or [condition]) and impossible_condition(cfg) is None:
            validate(cfg)
            met.append(condition)
    assert len(set(met)) == len(met)
    assert set(met) == set(cfg.conditions or met)
    assert {condition.split("/")[0] for condition in met} == {name.split("_")[0] for name in params.primitive.split(",")}


def test_off_the_shelf_gives_each_primitive_its_real_workspace(config: Callable[..., DictConfig]) -> None:
    for primitive in ("suction", "grasp_rg2"):
        cfg = config("experiment=off_the_shelf", f"primitive={primitive}")
        assert (cfg.workspace.name, cfg.camera.name) == (f"{primitive}_real", "d415")


def test_half_a_run_of_another_version_is_not_continued(tmp_path: Path) -> None:
    cfg = composed(["seed=3"])
    claim(tmp_path, cfg)
    refuse_foreign(tmp_path, cfg)
    _claimed_yesterday(tmp_path, cfg)
    with pytest.raises(ConfigError, match="force=true moves it aside"):
        refuse_foreign(tmp_path, cfg)
    refuse_foreign(tmp_path, composed(["seed=3", "force=true"]))
    (tmp_path / "result.json").touch()  # a finished one is only looked at
    refuse_foreign(tmp_path, cfg)
    with pytest.raises(ConfigError, match="another configuration"):
        refuse_foreign(tmp_path, composed(["seed=4"]))
