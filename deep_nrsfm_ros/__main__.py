# SPDX-License-Identifier: Apache-2.0
"""`python -m deep_nrsfm_ros` is the command `deep-nrsfm`."""

from deep_nrsfm_ros.commands.cli import main

if __name__ == "__main__":
    main()
