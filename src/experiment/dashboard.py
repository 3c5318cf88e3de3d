"""What a logger is given beside the curves: configuration, evaluations, figures, attempts."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from matplotlib.image import imread
from omegaconf import DictConfig, OmegaConf

from see2act.errors import ConfigError
from see2act.experiment import attempts
from see2act.experiment.config import one_line


@dataclass(frozen=True)
class Dashboard:
    """The logger of a run, for all of its stages; without one, nothing happens."""

    logger: Logger | None = None

    @classmethod
    def of(cls, cfg: DictConfig, folder: Path, name: str) -> Dashboard:
        """The one that was configured, with the configuration in it; it writes into ``folder``."""
        if not cfg.logger:
            return cls()
        logger: Logger = instantiate(cfg.logger)(save_dir=str(folder), name=name.replace(" ", "-"))
        if isinstance(logger, WandbLogger):
            import wandb
            from wandb.analytics.opentelemetry.opentelemetry_proxy import disable as disable_analytics

            # Otherwise it is silent only after it has warned of a setting that Lightning always passes.
            if cfg.logger.get("offline"):
                os.environ["WANDB_MODE"] = "offline"  # as Lightning does, later
            for name in ("WANDB_CACHE_DIR", "WANDB_DATA_DIR"):  # by default they are at home, where a service may have none
                os.environ.setdefault(name, str(Path(cfg.paths.cache).absolute() / "wandb"))
            # It is not wanted here. And if wandb's service cannot start, reporting that waits for ever for a lock.
            disable_analytics()
            try:
                wandb.setup()
            except wandb.Error as error:
                raise ConfigError(
                    f"wandb cannot start ({one_line(error)}): mend that, or add logger=tensorboard or none"
                ) from None
        config: Any = OmegaConf.to_container(cfg, resolve=True)
        logger.log_hyperparams(config)
        return cls(logger)

    def log(self, numbers: dict[str, float]) -> None:
        """Numbers of this moment."""
        if self.logger:
            self.logger.log_metrics(numbers)

    def show(self, folder: Path) -> None:
        """The figures of a run, and its attempts as a table, where the logger can take them."""
        pictures = sorted((folder / "figures").glob("*.png"))
        match self.logger:
            case WandbLogger():
                for picture in pictures:
                    self.logger.log_image(f"figures/{picture.stem}", [str(picture)])
                rows = [list(row.texts().values()) for row in attempts.read(folder / "attempts.csv")]
                self.logger.log_table("attempts", list(attempts.COLUMNS), rows)
            case TensorBoardLogger():
                for picture in pictures:
                    image = imread(picture)[..., :3]
                    self.logger.experiment.add_image(f"figures/{picture.stem}", image, dataformats="HWC")

    def close(self, failed: bool = False) -> None:
        """Everything is on disk, and the next run of this process gets a dashboard of its own.

        Args:
            failed: The run was interrupted or ended with an error.
        """
        if self.logger:
            self.logger.finalize("failed" if failed else "success")
        if "wandb" in sys.modules:
            sys.modules["wandb"].finish(exit_code=int(failed))
