# SPDX-License-Identifier: Apache-2.0
"""`python -m deep_nrsfm_ros.commands.demo`."""

from deep_nrsfm_ros.commands.demo import main

if __name__ == "__main__":
    main()
