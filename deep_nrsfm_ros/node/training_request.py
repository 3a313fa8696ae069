"""What the service ~/train is asked for, checked, as the command line of the training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from deep_nrsfm_ros.configuration import option, to_arguments
from deep_nrsfm_ros.nrsfm.keypoints import layout
from deep_nrsfm_ros.nrsfm.model_file import check_name
from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.observations.curation import Curation


@dataclass(frozen=True)
class TrainingOptions:
    """What ~/train trains on, and what becomes of it."""

    bags: tuple[str, ...] = option((), "rosbag2 folders or files to train on")
    topic: str = option("", "topic in the bags; empty: the one that the lifter listens to")
    object: str = option("", "layout of the new model; empty: that of the present one")
    name: str = option("trained", "name of the new model; an old one of this name is replaced")
    threads: int = option(1, "threads that the training may use", low=1, high=1024)
    activate: bool = option(True, "switch to the new model when the training has finished")


@dataclass(frozen=True)
class TrainingRequest:
    """Everything that a training is told."""

    options: TrainingOptions
    recipe: Recipe
    topic: str
    source_layout: str
    target_layout: str
    min_confidence: float
    output: Path
    curation: Curation = Curation()

    def check(self) -> None:
        """Raise ValueError that says what is missing or wrong."""
        if not self.options.bags:
            raise ValueError("no bags to train on; set the parameter train.bags")
        for bag in self.options.bags:
            if not Path(bag).expanduser().exists():
                raise ValueError(f"train.bags names {bag}, which does not exist")
        check_name("train.name", self.options.name)
        for name in (self.source_layout, self.target_layout):
            layout(name)

    def arguments(self) -> list[str]:
        """Return the arguments of the training command."""
        named = {
            "--topic": self.topic,
            "--keypoint-layout": self.source_layout,
            "--object": self.target_layout,
            "--min-confidence": str(self.min_confidence),
            "--name": self.options.name,
            "--output": str(self.output),
            "--threads": str(self.options.threads),
        }
        words = [word for pair in named.items() for word in pair]
        for bag in self.options.bags:
            words += ["--bag", str(Path(bag).expanduser())]
        return [*words, *to_arguments(self.recipe), *to_arguments(self.curation), "--json-progress"]
