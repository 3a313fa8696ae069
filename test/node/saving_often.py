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
        training_service.TrainingJob = functools.partial(TrainingJob, command=itself)
        lifter.main()
    else:
        from deep_nrsfm_ros.commands.train import main
        from deep_nrsfm_ros.training import loop as training

        training.Checkpointing = functools.partial(training.Checkpointing, seconds=0.2)
        main()
