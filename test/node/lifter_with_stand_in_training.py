# SPDX-License-Identifier: Apache-2.0
"""The lifter, whose trainings are played by stand_in_training.py."""

import functools
import sys
from pathlib import Path

from deep_nrsfm_ros.node import lifter, training_service
from deep_nrsfm_ros.training.job import TrainingJob

STAND_IN = (sys.executable, str(Path(__file__).parents[1] / "training" / "stand_in_training.py"))
setattr(training_service, "TrainingJob", functools.partial(TrainingJob, command=STAND_IN))  # noqa: B010

if __name__ == "__main__":
    lifter.main()
