# SPDX-License-Identifier: Apache-2.0
"""The lifter, and the training that it starts, which saves itself several times a second.

Started without --ros-args it is the training.
"""

import functools
import sys

from deep_nrsfm_ros.node import lifter, training_service
from deep_nrsfm_ros.training.job import TrainingJob

if __name__ == "__main__":
    if "--ros-args" in sys.argv:
        itself = (sys.executable, __file__)
        setattr(training_service, "TrainingJob", functools.partial(TrainingJob, command=itself))  # noqa: B010
        lifter.main()
    else:
        from deep_nrsfm_ros.commands.train import main
        from deep_nrsfm_ros.training import loop as training

        often = functools.partial(training.Checkpointing, seconds=0.2)
        setattr(training, "Checkpointing", often)  # noqa: B010
        main()
