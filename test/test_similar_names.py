# SPDX-License-Identifier: Apache-2.0
"""A name that does not exist is answered with those that may be meant."""

from deep_nrsfm_ros.similar_names import did_you_mean


def test_the_nearest_names_come_first_whatever_their_case() -> None:
    assert did_you_mean("back", ["bakc", "left_wing", "backs"]) == "did you mean 'backs' or 'bakc'?"
    assert did_you_mean("COCO17", ["coco17"]) == "did you mean 'coco17'?"
    assert did_you_mean("zzz", ["coco17"]) == did_you_mean("", ["coco17"]) == ""
